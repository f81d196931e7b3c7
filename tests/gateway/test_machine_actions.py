"""Torque, reset, modes, gripper, zero and homing as clients call them; the loop is fake."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.config.drive_limits import BEYOND_RANGE_RAD
from rtcp.config.model import LARGEST, GripperConfig, Joint, Range
from rtcp.config.zero import read_zeros, state_directory, zero_file
from rtcp.ipc import commands
from rtcp.ipc.events import (
    Disabled,
    GripperAtRest,
    GripperCloses,
    Homed,
    HomedElsewhere,
    HomingFailed,
    OverSpeed,
    ZeroSet,
)
from rtcp.ipc.layout import EVENTS
from rtcp.ipc.refusals import GripperDisabled, Refusal, TorquePresent, WrongState
from rtcp.ipc.schema import Field
from rtcp.ipc.states import ControlMode, DriveMode, State
from tests.gateway import fake_loop
from tests.gateway.fake_platform import FakePlatform, fake_platform
from tests.two_boxes import two_boxes

ABSENT_OBJECT = {"error": "no such object", "kind": "refused", "fields": {"code": 0x06020000}}
Q = [0.25, 0.2, 1.0, 0.0, 0.4, 0.0]
AXIS = 6
CONFIG = load(default_config())
FINGER = Joint("finger", "drive6", Range(-0.1, 1.5), velocity=1.0, acceleration=4.0, jerk=40.0, torque=3.0)
DRIVEN = replace(CONFIG, gripper=GripperConfig(joint=FINGER, open_position=1.4, closed_position=0.0))


@pytest.fixture(scope="module")
def driven_platform(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FakePlatform]:
    with fake_platform(tmp_path_factory.mktemp("arm"), Q, config=DRIVEN) as made:
        yield made


@pytest.fixture
def driven(driven_platform: FakePlatform, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakePlatform:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    driven_platform.reset(Q)
    return driven_platform


# -- commands, and where they need no more than an answer -------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "params", "command"),
    [
        ("set_output", {"output": 3, "value": False}, commands.SetOutput(3, False)),
        ("mode", {"name": "cartesian"}, commands.SetControlMode(ControlMode.CARTESIAN)),
        ("mode", {"name": "csv"}, commands.SetDriveMode(DriveMode.CSV)),
        ("set_drive_mode", {"mode": "cst"}, commands.SetDriveMode(DriveMode.CST)),
        ("move_gripper", {"open": True}, commands.MoveGripper(True)),
    ],
)
def test_a_command_reaches_the_loop_as_it_was_sent(
    arm: FakePlatform, method: str, params: dict[str, Any], command: object
) -> None:
    arm.ask(method, **params)
    assert arm.loop.commands == [command]


@pytest.mark.parametrize(
    ("method", "params", "message"),
    [
        ("set_output", {"output": 1.9, "value": True}, "output: found 1.9, allowed is an integer"),
        ("set_output", {"output": 2**70, "value": True}, "output"),
        ("set_output", {"output": 1}, "the key value is missing; it must be true or false"),
        ("mode", {"name": "fast"}, 'name: found the text "fast", allowed is one of joint, cartesian, joystick'),
        ("set_drive_mode", {"mode": "CSP"}, 'mode: found the text "CSP", allowed is one of csp, csv, cst'),
        ("zero", {"joint": "joint9"}, 'joint: found the text "joint9", allowed is one of joint1, joint2'),
        ("zero", {"joint": "9" * 5000}, "allowed is one of joint1, joint2"),
        ("home", {"joint": "0"}, 'joint: found the text "0", allowed is one of joint1'),
        ("sdo_read", {"slave": True, "index": 1, "subindex": 0}, "slave: found true, allowed is an integer"),
        ("sdo_write", {"slave": 2, "index": 1, "subindex": 0, "hex": 12}, "hex: found 12, allowed is a text"),
    ],
)
def test_a_wrong_parameter_is_named_and_nothing_is_commanded(
    arm: FakePlatform, method: str, params: dict[str, Any], message: str
) -> None:
    arm.show(state=State.READY)
    error = arm.error(method, **params)
    assert error.kind == "invalid"
    assert message in str(error)
    assert arm.loop.commands == []
    assert arm.loop.requests == []


def test_an_output_of_two_boxes_is_switched_at_the_named_one(tmp_path: Path) -> None:
    with fake_platform(tmp_path, Q, config=load(two_boxes(tmp_path / "config"))) as arm:
        arm.ask("set_output", output=3, value=True, box="desk")
        for box, problem in ({}, "the key is missing"), ({"box": "shelf"}, 'found the text "shelf"'):
            error = arm.error("set_output", output=3, value=True, **box)
            assert (error.kind, str(error)) == ("invalid", f"box: {problem}, allowed is one of io, desk")
        assert arm.loop.commands == [commands.SetOutput(3, True, 1)]


def test_a_wait_ends_with_the_level_and_needs_no_lease(arm: FakePlatform) -> None:
    async def pressed() -> None:
        waiting = asyncio.create_task(arm.call("wait_io", {"name": "arm_toggle", "timeout_s": 5.0}))
        await asyncio.sleep(0.05)
        assert not waiting.done()
        assert arm.observer.holder() == ""
        arm.loop.inputs = 1 << 8
        await waiting

    arm.run(pressed)
    arm.ask("wait_io", name="io.9", timeout_s=0.0)


def test_a_level_that_does_not_come_is_a_timeout_with_its_fields(arm: FakePlatform) -> None:
    error = arm.error("wait_io", name="io.12", value=True, timeout_s=0.05)
    assert (error.kind, error.reason) == ("timeout", "level_not_reached")
    assert error.fields == {"name": "io.12", "value": True, "timeout_s": 0.05}
    assert str(error) == "io.12 was not high within 0.05 s"


def test_terminals_are_read_by_the_names_of_their_functions_or_by_box_and_number(arm: FakePlatform) -> None:
    arm.loop.inputs, arm.loop.outputs = 1 << 9 | 1 << 15, 1 << 3
    arm.show()
    answer = arm.ask("read_io")
    levels = {
        which: {channel["name"]: channel["value"] for channel in answer[which]} for which in ("inputs", "outputs")
    }
    assert (len(levels["inputs"]), len(levels["outputs"])) == (16, 16)
    assert [name for name, value in levels["inputs"].items() if value] == ["emergency_stop", "io.16"]
    assert [name for name, value in levels["outputs"].items() if value] == ["gripper"]


def test_an_output_that_the_file_names_is_set_at_its_own_box(tmp_path: Path) -> None:
    file = two_boxes(tmp_path / "config")
    named = "outputs:\n  named: [{name: blower, number: 5, box: io}]\n"
    file.write_text(file.read_text().replace("outputs:\n", named))
    with fake_platform(tmp_path, Q, config=load(file)) as arm:
        arm.ask("write_io", name="blower", value=True)
        arm.ask("write_io", name="io.5", value=False)
        assert arm.loop.commands == [commands.SetOutput(5, True, 0), commands.SetOutput(5, False, 0)]


VALVES = """
name: Valves
kind: generic
vendor_id: 1
product_id: 2
rpdo:
  - index: 0x1600
    channels:
      - {index: 0x7000, sub_index: 1, type: bool, name: open}
      - {index: 0x7000, sub_index: 2, type: float32, name: level, unit: m, min: 0.5, safe: 0.5}
      - {index: 0, sub_index: 0, type: bits, bits: 7}
tpdo:
  - index: 0x1A00
    channels:
      - {index: 0x6000, sub_index: 1, type: bool, name: closed}
      - {index: 0x6000, sub_index: 2, type: int16, name: depth, unit: m}
"""


def test_channels_of_a_slave_are_read_and_set_by_name_and_those_of_one_bit_are_terminals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ("closed", "depth", "open", "level")
    more = tuple(Field(f"valves_{name}", "float64", part="valves") for name in names)
    monkeypatch.setattr("tests.gateway.fake_loop.BOX", (*fake_loop.BOX, *more))
    shutil.copytree(default_config().parent, tmp_path / "config")
    (tmp_path / "config/devices/valves.yaml").write_text(VALVES)
    file = tmp_path / "config/assistive_arm.yaml"
    drive6 = "  - {name: drive6, device: cubemars-orh}\n"
    file.write_text(file.read_text().replace(drive6, f"{drive6}  - {{name: valves, device: valves}}\n"))
    with fake_platform(tmp_path, Q, config=load(file)) as arm:
        answer = arm.ask("read_io")
        assert [channel["name"] for channel in answer["inputs"]][-1] == "valves.closed"
        assert [(output["name"], output["number"]) for output in answer["outputs"]][-1] == ("valves.open", 1)
        still = {"value": 0.0, "unit": "m"}
        assert answer["channels"] == [
            {"name": "valves.depth", **still, "is_output": False, "settable": False, "range": None},
            {"name": "valves.level", **still, "is_output": True, "settable": True, "range": [0.5, LARGEST["float32"]]},
        ]
        arm.ask("write_io", name="valves.open", value=True)
        arm.ask("set_channel", name="valves.level", value=1.25)
        assert arm.loop.commands == [commands.SetChannel(8, 0, 1.0), commands.SetChannel(8, 1, 1.25)]
        arm.ask("wait_io", name="valves.closed", value=False, timeout_s=1.0)
        arm.ask("set_channel", name="valves.open", value=1)
        arm.ask("set_channel", name="io.gripper", value=0)
        assert arm.loop.commands[2:] == [commands.SetChannel(8, 0, 1.0), commands.SetOutput(4, False, 0)]
        assert arm.error("set_channel", name="valves.open", value=0.5).reason == "wrong_level"
        assert arm.error("write_io", name="valves.level", value=True).reason == "wrong_level"
        error = arm.error("set_channel", name="valves.closed", value=1.0)
        assert (error.reason, error.fields["allowed"][-2:]) == ("unknown_terminal", ["valves.open", "valves.level"])


def test_a_terminal_that_is_none_is_refused_with_those_there_are(arm: FakePlatform) -> None:
    error = arm.error("write_io", name="emergency_stop", value=True)  # an input
    assert (error.kind, error.reason, error.fields["name"]) == ("invalid", "unknown_terminal", "emergency_stop")
    assert error.fields["allowed"][:5] == ["state_lamp", "motion_lamp", "heartbeat", "gripper", "io.5"]
    assert arm.error("wait_io", name="io.17").reason == "unknown_terminal"
    assert arm.loop.commands == []


def test_objects_are_read_at_any_time_and_written_in_state_ready_only(arm: FakePlatform) -> None:
    address = {"slave": 2, "index": 0x6065, "subindex": 0}
    assert arm.ask("sdo_read", **address) == {"hex": "2a"}
    error = arm.error("sdo_write", **address, hex="0b")
    assert str(error) == "objects are written in state ready only, not in holding: `rtcp disable` first"
    arm.show(state=State.READY)
    arm.ask("sdo_write", **address, hex="0b")
    assert arm.loop.requests == [{"do": "sdo_read", **address}, {"do": "sdo_write", **address, "hex": "0b"}]


def test_what_holds_already_is_not_enabled_again_and_what_is_well_not_reset(arm: FakePlatform) -> None:
    assert arm.ask("enable") == {}
    assert arm.ask("reset") == {"from": "holding"}
    assert arm.loop.commands == []


def test_a_reset_of_a_stop_by_a_limit_waits_for_no_other_state(arm: FakePlatform) -> None:
    arm.show(state=State.STOPPED_BY_LIMIT)
    assert arm.ask("reset") == {"from": "stopped_by_limit"}
    assert arm.loop.commands == [commands.Reset()]


def test_a_refusal_in_a_fault_ends_with_the_fault(arm: FakePlatform) -> None:
    arm.loop.board.event(OverSpeed(0, 1.7, 1.5))
    arm.show(state=State.FAULT)
    arm.loop.refusals[commands.Enable] = WrongState(commands.Enable.number, State.FAULT)
    error = arm.error("enable")
    assert error.reason == "wrong_state"
    assert "`rtcp reset` first; the fault: joint1: measured speed 1.7 rad/s" in str(error)


def test_a_halt_in_state_ready_reaches_the_loop_and_is_no_failure(arm: FakePlatform) -> None:
    arm.show(state=State.READY)
    arm.ask("halt")
    assert arm.loop.kinds == [commands.Halt]


def test_a_halt_while_drives_are_enabled_ends_without_torque(arm: FakePlatform) -> None:
    arm.show(state=State.ENABLING)
    assert arm.ask("halt") == {}


def test_disabling_that_another_command_ends_is_no_success(arm: FakePlatform) -> None:
    arm.show(state=State.RESETTING)
    arm.loop.refusals[commands.Disable] = WrongState(commands.Disable.number, State.RESETTING)
    assert arm.error("disable").kind == "refused"


# -- the gripper ------------------------------------------------------------------------------------------------------

HELD, CLOSED = GripperAtRest(AXIS, 0.5, True), GripperAtRest(AXIS, 0.0, False)


@pytest.mark.parametrize(
    ("events", "answer"),
    [
        ([GripperCloses(), CLOSED], {"position": 0.0, "holds": False}),
        ([GripperCloses(), HELD], {"position": 0.5, "holds": True}),
        ([GripperAtRest(AXIS, 1.4, False), GripperCloses(), CLOSED], {"position": 0.0, "holds": False}),
    ],
    ids=["closed", "holds something", "after the end of an earlier motion"],
)
def test_a_driven_gripper_returns_where_it_rests(driven: FakePlatform, events: Any, answer: dict[str, Any]) -> None:
    driven.loop.reports[commands.MoveGripper] = events
    assert driven.ask("move_gripper", open=False) == answer
    assert driven.loop.commands == [commands.MoveGripper(False)]


@pytest.mark.parametrize(
    ("events", "kind", "message"),
    [
        ([GripperCloses(), GripperAtRest(AXIS, 0.71234, False)], "refused", "finger was stopped at 0.7123 rad, before"),
        ([GripperCloses(), OverSpeed(AXIS, 1.7, 1.5), CLOSED], "fault", "finger: measured speed 1.7 rad/s"),
        ([GripperCloses(), Disabled()], "refused", "the gripper was stopped by another command"),
    ],
)
def test_a_driven_gripper_that_does_not_arrive_fails(
    driven: FakePlatform, events: Any, kind: str, message: str
) -> None:
    driven.loop.reports[commands.MoveGripper] = events
    error = driven.error("move_gripper", open=False)
    assert error.kind == kind
    assert str(error).startswith(message)


def test_a_gripper_without_torque_is_refused(driven: FakePlatform) -> None:
    driven.loop.refusals[commands.MoveGripper] = GripperDisabled()
    assert driven.error("move_gripper", open=False).reason == "gripper_disabled"


# -- zero and homing --------------------------------------------------------------------------------------------------


def test_the_present_position_becomes_the_zero_or_what_it_is_reported_to_be(arm: FakePlatform) -> None:
    answer = arm.ask("zero", joint="joint1")
    assert (answer["joint"], answer["offset"], answer["before"]) == ("joint1", 0.25, 0.0)
    assert arm.ask("zero", joint="2", at=0.05)["joint"] == "joint2"
    # The fake loop still shows 0.2, now with the new offset.
    arm.ask("zero", joint="joint2", at=0.1)
    offsets = [(command.axis, pytest.approx(command.offset)) for command in arm.loop.received(commands.SetZero)]
    assert offsets == [(0, 0), (0, 0.25), (1, 0), (1, 0.15), (1, 0.15), (1, 0.25)]
    assert read_zeros(arm.config) == (0.25, pytest.approx(0.25), 0, 0, 0, 0)


def test_the_position_limits_inside_the_drive_move_with_the_zero(arm: FakePlatform) -> None:
    arm.ask("zero", joint="joint1")
    low, high = arm.config.joints[0].position.min, arm.config.joints[0].position.max
    ends = (low - BEYOND_RANGE_RAD + 0.25, high + BEYOND_RANGE_RAD + 0.25)
    assert [request for request in arm.loop.requests if request["do"] == "sdo_write"] == [
        {
            "do": "sdo_write",
            "slave": 2,
            "index": 0x607D,
            "subindex": subindex,
            "hex": round(end * 1e4).to_bytes(4, "little", signed=True).hex(),
        }
        for subindex, end in enumerate(ends, 1)
    ]


def test_a_zero_that_the_loop_refuses_is_in_no_file(arm: FakePlatform) -> None:
    arm.loop.refusals[commands.SetZero] = TorquePresent()
    assert arm.error("zero", joint="joint1").reason == "torque_present"
    assert not zero_file(arm.config.name).exists()


def test_a_zero_that_cannot_be_kept_in_the_file_is_taken_back_from_the_loop(arm: FakePlatform, tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where the folder should be")
    error = arm.error("zero", joint="joint1")
    assert error.kind == "refused"
    assert str(tmp_path / "state") in str(error)
    assert [command.offset for command in arm.loop.received(commands.SetZero)] in ([], [0.0, 0.25, 0.0])


@pytest.mark.interpreted
def test_a_zero_whose_answer_does_not_come_is_taken_back_from_the_loop(
    arm: FakePlatform, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtcp.gateway.command_channel._ANSWER_S", 0.1)
    loop, answer = arm.loop, arm.loop.board.answer

    def withheld(number: int, refusal: Refusal | None = None) -> None:
        if loop.commands[-1] != commands.SetZero(0, 0.25):
            answer(number, refusal)

    monkeypatch.setattr(loop.board, "answer", withheld)
    assert arm.error("zero", joint="joint1").kind == "timeout"
    assert loop.commands == [commands.SetZero(0, 0.0), commands.SetZero(0, 0.25), commands.SetZero(0, 0.0)]
    assert not zero_file(arm.config.name).exists()


def test_a_zero_is_taken_from_the_event_of_its_own_joint_and_of_no_other(arm: FakePlatform) -> None:
    arm.loop.reports[commands.SetZero] = [ZeroSet(3, 0.0, 9.0)]
    assert arm.ask("zero", joint="joint1")["offset"] == 0.25
    arm.loop.reports[commands.SetZero] = [Disabled()] * EVENTS
    error = arm.error("zero", joint="joint1")
    assert (error.kind, "was overwritten" in str(error)) == ("fault", True)


def test_the_gripper_with_a_drive_has_a_zero_too(driven: FakePlatform) -> None:
    answer = driven.ask("zero", joint="finger", at=0.1)
    assert (answer["joint"], answer["offset"]) == ("finger", pytest.approx(0.3))
    assert read_zeros(driven.config)[6] == pytest.approx(0.3)


def test_what_homing_will_do_is_read_from_the_drive(arm: FakePlatform) -> None:
    objects = arm.loop.objects
    objects[0x6098], objects[0x607C] = {"hex": "23"}, {"hex": "f0d8ffff"}
    assert arm.ask("homing_method", joint="2") == {
        "joint": "joint2",
        "method": 35,
        "text": "does not move: it declares the present position to be its home",
        "declares_present": True,
        "home_offset": pytest.approx(-1.0),
        "unit": "rad",
    }
    objects[0x6098] = {"hex": "12"}
    answer = arm.ask("homing_method", joint="joint2")
    assert (answer["method"], answer["declares_present"]) == (18, False)
    assert answer["text"] == (
        "turns in positive direction to the positive limit switch, then back: its home is the edge of the positive "
        "limit switch, approached from the negative side"
    )
    objects[0x6098], objects[0x607C] = ABSENT_OBJECT, ABSENT_OBJECT
    answer = arm.ask("homing_method", joint="joint2")
    assert (answer["method"], answer["declares_present"], answer["home_offset"]) == (None, True, 0.0)
    assert {request["slave"] for request in arm.loop.requests} == {3}
    assert arm.loop.commands == []


def test_homing_gives_the_loop_the_home_offset_and_fails_where_the_drive_shows_another_position(
    arm: FakePlatform,
) -> None:
    arm.loop.objects[0x607C] = {"hex": "f0d8ffff"}
    arm.loop.reports[commands.Home] = [HomedElsewhere(1, 0.5, -1.0)]
    error = arm.error("home", joint="joint2")
    assert arm.loop.received(commands.Home) == [commands.Home(1, -1.0)]
    assert (error.kind, error.reason) == ("fault", "homed_elsewhere")
    assert "it shows 0.5 rad and its home offset (0x607C) is -1 rad, allowed are homing.tolerance = 0.2 rad" in str(
        error
    )


def test_homing_returns_the_position_or_fails_with_the_drives_answer(arm: FakePlatform) -> None:
    arm.loop.reports[commands.Home] = [Homed(1, 0.2)]
    assert arm.ask("home", joint="joint2") == {"joint": "joint2", "position": 0.2}
    arm.loop.reports[commands.Home] = [HomingFailed(1, 0x2637, 6)]
    error = arm.error("home", joint="joint2")
    assert (error.kind, error.reason, error.fields["statusword"]) == ("fault", "homing_failed", 0x2637)
    arm.loop.reports[commands.Home] = []
    assert "homing was interrupted" in str(arm.error("home", joint="joint2"))


def test_no_test_keeps_offsets_where_the_arm_at_this_host_has_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    assert state_directory().is_relative_to(tmp_path_factory.getbasetemp())
