"""Disabling, confirmed by the records of the real loop and the device models."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

import pytest

from rtcp.config.model import ArmConfig, GripperConfig, Joint, Range
from rtcp.fieldbus.al_state import AlState
from rtcp.gateway.command_channel import Caller, CommandChannel
from rtcp.gateway.machine_actions import MachineActions
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc.errors import Faulted
from rtcp.ipc.events import SlavesParked
from rtcp.ipc.session import Session
from rtcp.ipc.states import State
from tests import simulated_time
from tests.control.conftest import new_rig, rig
from tests.control.rig import CONFIG, CONTROLWORD, LOST_CYCLES, PERIOD_S, QUICK_STOP, VOLTAGE_OFF, LoopRig

__all__ = ["new_rig", "rig"]

FINGER = Joint("finger", "drive2", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=3.0)


def disable(rig: LoopRig, config: ArmConfig = CONFIG) -> dict[str, Any]:
    """Request it while the loop's cycles continue."""

    async def both() -> dict[str, Any]:
        session = Session(config, "eth0", "eth0", 0, rig.now_ns)
        channel = CommandChannel(rig.observer, StatusSnapshot(rig.observer, session, {}), config)
        following = asyncio.create_task(channel.follow())
        asked = asyncio.ensure_future(MachineActions(channel).disable(Caller("a test", 1)))
        while not asked.done():
            rig.cycle()
            await asyncio.sleep(PERIOD_S)
        following.cancel()
        return await asked

    return simulated_time.run(both())


def failure(rig: LoopRig) -> str:
    """Request what cannot be confirmed; return the reason of the error."""
    with pytest.raises(Faulted) as raised:
        disable(rig)
    return str(raised.value)


def powered(rig: LoopRig) -> list[bool]:
    return [model.powered for model in rig.models]


def press_in_motion(rig: LoopRig) -> None:
    rig.set_in_motion()
    for model in rig.models:
        model.objects[0x6085, 0].value = 10_000
    rig.press()
    assert rig.state is State.EMERGENCY_STOP


def fault_in_motion(rig: LoopRig) -> None:
    rig.set_in_motion()
    rig.service.lost_slave = 3
    rig.run(0.01)
    assert rig.state is State.FAULT


def reset_that_waits(rig: LoopRig) -> None:
    rig.lead_to(State.RESETTING)


@pytest.mark.parametrize("brought", [press_in_motion, fault_in_motion, reset_that_waits, LoopRig.set_in_motion])
def test_disabling_is_done_when_no_drive_has_torque_and_not_before(rig: LoopRig, brought: Any) -> None:
    brought(rig)
    assert powered(rig) == [True, True]
    assert disable(rig) == {"unconfirmed": []}
    assert powered(rig) == [False, False]


def test_a_drive_that_keeps_its_torque_in_a_fault_is_named_with_its_statusword(rig: LoopRig) -> None:
    rig.misunderstood[1, CONTROLWORD] = {VOLTAGE_OFF: QUICK_STOP}
    rig.lead_to(State.FAULT)
    rig.run(0.5)
    message = failure(rig)
    assert powered(rig) == [False, True]
    assert message.startswith("drives were commanded to remove their torque, not confirmed: joint2 (drive2) shows 0x")
    assert message.endswith(", quick stop active")
    assert "joint1" not in message


def test_a_drive_that_keeps_its_torque_in_an_emergency_stop_is_named(rig: LoopRig) -> None:
    rig.misunderstood[0, CONTROLWORD] = {VOLTAGE_OFF: QUICK_STOP}
    press_in_motion(rig)
    message = failure(rig)
    assert "not confirmed: joint1 (drive1) shows 0x" in message
    assert "joint2" not in message


def test_a_statusword_that_the_standard_does_not_know_confirms_nothing(rig: LoopRig) -> None:
    rig.lead_to(State.FAULT)
    seen = rig.data.input
    rig.data.input = lambda index: b"\x01\x00" + seen(index)[2:] if index == 2 else seen(index)  # type: ignore[method-assign]
    assert "joint2 (drive2) shows 0x0001, a state that the standard does not know" in failure(rig)


def test_without_frames_nothing_is_known_of_any_joint(rig: LoopRig) -> None:
    rig.hold()
    rig.lose_frames()
    rig.run(LOST_CYCLES * PERIOD_S)
    assert "no frame returns, and nothing is known of joint1 (drive1), joint2 (drive2)" in failure(rig)


def test_with_a_slave_missing_nothing_is_known_of_any_joint(rig: LoopRig) -> None:
    rig.hold()
    receive = rig.data.receive
    rig.data.receive = lambda: receive() - 3  # type: ignore[method-assign]
    rig.run(LOST_CYCLES * PERIOD_S)
    message = failure(rig)
    assert "slaves are missing (working counter 6 of 9), and nothing is known of joint1 (drive1), joint2" in message


def test_what_was_shown_before_frames_were_lost_confirms_nothing(rig: LoopRig) -> None:
    rig.start()
    rig.lose_frames()
    rig.run(LOST_CYCLES * PERIOD_S)
    assert rig.state is State.FAULT
    assert "no frame returns" in failure(rig)


def park(rig: LoopRig) -> None:
    """Let the emergency stop come to its end: slaves in PRE-OP take part in no frame."""
    rig.wait(lambda: SlavesParked in rig.kinds)
    for position in (1, 2, 3):
        rig.board.slave(position, AlState.PREOP, 0)
    rig.data.receive = lambda: 0  # type: ignore[method-assign]
    rig.run(0.1)


def test_drives_that_were_parked_without_torque_are_confirmed(rig: LoopRig) -> None:
    press_in_motion(rig)
    park(rig)
    assert disable(rig) == {"unconfirmed": []}


def test_drives_that_were_parked_and_showed_torque_last_are_not_confirmed(rig: LoopRig) -> None:
    rig.misunderstood[0, CONTROLWORD] = {VOLTAGE_OFF: QUICK_STOP}
    press_in_motion(rig)
    park(rig)
    message = failure(rig)
    assert "joint1 (drive1) shows 0x" in message
    assert message.endswith(", quick stop active; the slaves are in PRE-OP since")


def test_the_drive_of_the_gripper_which_no_record_shows_is_unconfirmed(rig: LoopRig) -> None:
    gripper = GripperConfig(joint=FINGER, open_position=1.4, closed_position=0.0)
    fault_in_motion(rig)
    assert disable(rig, replace(CONFIG, gripper=gripper)) == {"unconfirmed": ["finger (drive2)"]}
