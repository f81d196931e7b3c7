"""`disable` as a client asks for it: the gateway's verb in front of the real loop and the device models."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest
from rtcp.gateway.carrier import Carrier, CommandFailed
from rtcp.gateway.commander import Commander
from rtcp.gateway.picture import Picture

from rtcp.config.model import ArmConfig, GripperConfig, Joint, Range
from rtcp.fieldbus.al_state import AlState
from rtcp.gateway import commander
from rtcp.ipc.machine import Code, State
from rtcp.ipc.session import Session

from .bench import CONFIG, CONTROLWORD, LOST_CYCLES, PERIOD_S, QUICK_STOP, VOLTAGE_OFF, Bench

FINGER = Joint("finger", "drive2", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=3.0)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not come is not waited for longer than the drives need here."""
    monkeypatch.setattr(commander, "_CONFIRM_S", 0.2)


def disable(bench: Bench, config: ArmConfig = CONFIG) -> dict[str, Any]:
    """Ask for it while the loop's cycles go on."""

    async def both() -> dict[str, Any]:
        session = Session(config, "eth0", "eth0", 0, bench.now_ns)
        carrier = Carrier(bench.observer, Picture(bench.observer, session, {}), config)
        asked = asyncio.ensure_future(Commander(carrier).disable("a test"))
        while not asked.done():
            bench.cycle()
            await asyncio.sleep(PERIOD_S)
        return await asked

    return asyncio.run(both())


def refusal(bench: Bench) -> str:
    """Ask for what cannot be confirmed; return why."""
    with pytest.raises(CommandFailed) as failed:
        disable(bench)
    assert failed.value.kind == "fault"
    return str(failed.value)


def powered(bench: Bench) -> list[bool]:
    return [model.powered for model in bench.models]


def press_in_motion(bench: Bench) -> None:
    bench.set_in_motion()
    for model in bench.models:
        model.objects[0x6085, 0].value = 10_000
    bench.press()
    assert bench.state is State.EMERGENCY_STOP


def fault_in_motion(bench: Bench) -> None:
    bench.set_in_motion()
    bench.service.lost_slave = 3
    bench.run(0.01)
    assert bench.state is State.FAULT


def reset_that_waits(bench: Bench) -> None:
    bench.bring_to(State.RESETTING)


@pytest.mark.parametrize("brought", [press_in_motion, fault_in_motion, reset_that_waits, Bench.set_in_motion])
def test_disabled_is_said_when_no_drive_has_torque_and_not_before(bench: Bench, brought: Any) -> None:
    brought(bench)
    assert powered(bench) == [True, True]
    assert disable(bench) == {"unseen": []}
    assert powered(bench) == [False, False]


def test_a_drive_that_keeps_its_torque_in_a_fault_is_named_with_what_it_shows(bench: Bench) -> None:
    bench.data.deaf[1, CONTROLWORD] = {VOLTAGE_OFF: QUICK_STOP}
    bench.bring_to(State.FAULT)
    bench.run(0.5)
    said = refusal(bench)
    assert powered(bench) == [False, True]
    assert said.startswith("told to give up their torque, not confirmed: joint2 (drive2) shows 0x")
    assert said.endswith(", quick stop active")
    assert "joint1" not in said


def test_a_drive_that_keeps_its_torque_in_an_emergency_stop_is_named(bench: Bench) -> None:
    bench.data.deaf[0, CONTROLWORD] = {VOLTAGE_OFF: QUICK_STOP}
    press_in_motion(bench)
    said = refusal(bench)
    assert "not confirmed: joint1 (drive1) shows 0x" in said
    assert "joint2" not in said


def test_a_statusword_that_the_standard_does_not_know_confirms_nothing(bench: Bench) -> None:
    bench.bring_to(State.FAULT)
    seen = bench.data.input
    bench.data.input = lambda index: b"\x01\x00" + seen(index)[2:] if index == 2 else seen(index)  # type: ignore[method-assign]
    assert "joint2 (drive2) shows 0x0001, a state that the standard does not know" in refusal(bench)


def test_where_no_frame_comes_back_nothing_is_known_of_any_joint(bench: Bench) -> None:
    bench.hold()
    bench.data.carries = False
    bench.run(LOST_CYCLES * PERIOD_S)
    assert "no frame comes back, and nothing is known of joint1 (drive1), joint2 (drive2)" in refusal(bench)


def test_where_a_slave_is_missing_nothing_is_known_of_any_joint(bench: Bench) -> None:
    bench.hold()
    receive = bench.data.receive
    bench.data.receive = lambda: receive() - 3  # type: ignore[method-assign]
    bench.run(LOST_CYCLES * PERIOD_S)
    said = refusal(bench)
    assert "slaves are missing (working counter 6 of 9), and nothing is known of joint1 (drive1), joint2" in said


def test_what_was_shown_before_the_frames_stayed_away_confirms_nothing(bench: Bench) -> None:
    bench.start()
    bench.data.carries = False
    bench.run(LOST_CYCLES * PERIOD_S)
    assert bench.state is State.FAULT
    assert "no frame comes back" in refusal(bench)


def park(bench: Bench) -> None:
    """Let the emergency stop come to its end: slaves in PRE-OP take part in no frame."""
    bench.wait(lambda: Code.PARKED in bench.codes)
    for position in (1, 2, 3):
        bench.board.slave(position, AlState.PREOP, 0)
    bench.data.receive = lambda: 0  # type: ignore[method-assign]
    bench.run(0.1)


def test_drives_that_were_parked_without_torque_are_without_it(bench: Bench) -> None:
    press_in_motion(bench)
    park(bench)
    assert disable(bench) == {"unseen": []}


def test_drives_that_were_parked_and_showed_torque_last_are_not_confirmed(bench: Bench) -> None:
    bench.data.deaf[0, CONTROLWORD] = {VOLTAGE_OFF: QUICK_STOP}
    press_in_motion(bench)
    park(bench)
    said = refusal(bench)
    assert "joint1 (drive1) shows 0x" in said
    assert said.endswith(", quick stop active; the slaves are in PRE-OP since")


def test_the_grippers_drive_which_no_record_shows_is_named_as_not_seen(bench: Bench) -> None:
    gripper = GripperConfig(joint=FINGER, open_position=1.4, closed_position=0.0)
    fault_in_motion(bench)
    assert disable(bench, replace(CONFIG, gripper=gripper)) == {"unseen": ["finger (drive2)"]}
