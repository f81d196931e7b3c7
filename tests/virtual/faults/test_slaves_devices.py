"""Faults of drives and of the IO box's input terminals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import pytest

from rtcp.testing.bus import InProcessBus
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.faults.fault import DeviceFault, End, FaultRefused, Position
from rtcp.virtual.faults.slaves import (
    DriveError,
    DriveErrorFault,
    InputsFrozen,
    JoystickCode,
    PowerFault,
    TerminalFault,
)
from rtcp.virtual.models import DiewuIoBox
from rtcp.virtual.models.cubemars import CubemarsOrh40, CubemarsOrh70
from tests.virtual.line import MS, Line, begin

CODES: dict[DriveError, int] = {
    "over-current": 0x2310,
    "over-voltage": 0x3210,
    "under-voltage": 0x3220,
    "over-temperature": 0x4310,
    "encoder": 0x7305,
    "over-speed": 0x8400,
    "following-error": 0x8611,
}
AT_ONCE = {"over-current", "over-voltage", "under-voltage", "encoder"}


@dataclass(frozen=True)
class Trusting(DeviceFault):
    """A fault of another package, whose base class checks the slave's position."""

    name = "trusting"
    slave: Position

    def begin(self, devices: Sequence[DeviceModel]) -> End:
        assert devices[self.slave - 1] is not None
        return lambda _: None


def test_a_slave_that_is_not_there_is_refused_for_a_kind_of_a_package_outside_too() -> None:
    line = Line([DiewuIoBox()])
    begin(line.segment, Trusting(1), 0)
    with pytest.raises(FaultRefused, match="there is no slave 2: the segment has slaves 1 to 1"):
        begin(line.segment, Trusting(2), 0)


class Joint:
    """A drive at 1 rad/s as slave 2 behind an IO box; tests set its outputs directly."""

    def __init__(self) -> None:
        drive = CubemarsOrh70()
        self.line = Line([DiewuIoBox(), drive])
        self.drive = drive
        drive.set_outputs_valid(True)
        self.put(0x6060, 9)
        self.enable()
        self.put(0x60FF, 10000)
        self.line.pass_time(500 * MS)
        assert drive.mechanics.velocity == pytest.approx(1.0, abs=0.05)

    def put(self, index: int, value: int) -> None:
        self.drive.objects[index, 0].value = value

    def get(self, index: int) -> int:
        return int(self.drive.objects[index, 0].value)

    def enable(self) -> None:
        for word in (0, 6, 7, 15):
            self.put(0x6040, word)
            self.line.pass_time(150 * MS)
        assert self.state == "OPERATION_ENABLED"

    def reset(self) -> str:
        for word in (0, 0x80, 0):
            self.put(0x6040, word)
            self.line.pass_time(5 * MS)
        return self.state

    @property
    def state(self) -> str:
        return self.drive.state.name

    def emergencies(self) -> list[int]:
        codes = [each.error_code for each in self.drive.emergencies]
        self.drive.emergencies.clear()
        return codes


@pytest.mark.parametrize("error", CODES)
def test_a_drive_reports_its_error_stops_and_can_be_reset_when_the_cause_is_gone(error: DriveError) -> None:
    joint = Joint()
    end = begin(joint.line.segment, DriveErrorFault(2, error), joint.line.now, lasts=2.0)
    assert not end.over
    assert joint.drive.powered is (error not in AT_ONCE), "by a ramp, or at once"
    joint.line.pass_time(1000 * MS)
    assert joint.state == "FAULT"
    assert joint.drive.mechanics.velocity == 0.0
    assert joint.get(0x603F) == CODES[error]
    assert joint.get(0x6041) & 0x4F == 0x08
    assert joint.emergencies() == [CODES[error]]
    assert joint.reset() == "FAULT"
    assert joint.emergencies() == [CODES[error]], "the drive tells again why it does not go on"
    end(joint.line.now)
    assert joint.state == "FAULT"
    assert joint.reset() == "SWITCH_ON_DISABLED"
    assert joint.emergencies() == [0]
    joint.enable()


def test_without_a_time_the_error_of_a_drive_is_a_single_occurrence_that_a_reset_clears() -> None:
    joint = Joint()
    undo = begin(joint.line.segment, DriveErrorFault(2, "over-current"), joint.line.now)
    assert undo.over
    joint.line.pass_time(1000 * MS)
    assert joint.state == "FAULT"
    assert joint.reset() == "SWITCH_ON_DISABLED"
    assert joint.emergencies() == [0x2310, 0]


def test_the_reaction_to_an_error_is_the_one_chosen() -> None:
    joint = Joint()
    joint.put(0x605E, 0)
    begin(joint.line.segment, DriveErrorFault(2, "over-temperature"), joint.line.now)
    assert not joint.drive.powered


def test_an_error_that_lasts_is_met_again_after_a_loss_of_supply() -> None:
    joint = Joint()
    begin(joint.line.segment, DriveErrorFault(2, "encoder"), joint.line.now, lasts=9.0)
    begin(joint.line.segment, PowerFault(2), joint.line.now)(joint.line.now)
    assert joint.state == "NOT_READY_TO_SWITCH_ON"
    joint.line.pass_time(150 * MS)
    assert joint.state == "FAULT"
    assert joint.emergencies() == [0x7305]


def test_a_drive_without_supply_meets_an_error_when_it_is_back() -> None:
    joint = Joint()
    back = begin(joint.line.segment, PowerFault(2), joint.line.now)
    joint.line.pass_time(5 * MS)
    begin(joint.line.segment, DriveErrorFault(2, "over-voltage"), joint.line.now, lasts=9.0)
    joint.line.pass_time(5 * MS)
    assert (joint.state, joint.emergencies()) == ("NOT_READY_TO_SWITCH_ON", [])
    back(joint.line.now)
    joint.line.pass_time(150 * MS)
    assert (joint.state, joint.emergencies()) == ("FAULT", [0x3210])


def test_who_is_no_drive_has_no_errors_of_a_drive() -> None:
    joint = Joint()
    with pytest.raises(FaultRefused, match=r"slave 1 \(DIEWU 16DI16DO\) is no drive"):
        begin(joint.line.segment, DriveErrorFault(1, "encoder"), joint.line.now)
    with pytest.raises(FaultRefused, match="no slave 3: the segment has slaves 1 to 2"):
        begin(joint.line.segment, DriveErrorFault(3, "encoder"), joint.line.now)


# -- the IO box -------------------------------------------------------------------------------------------------------


@pytest.fixture
def box() -> DiewuIoBox:
    return DiewuIoBox(inputs=0x003F)


def shown_inputs(line: Line) -> int:
    line.pass_time(MS)
    return int(line.devices[0].objects[0x6000, 1].value)


def test_an_input_stuck_high_or_low_wins_over_the_world_and_over_what_is_forced(box: DiewuIoBox) -> None:
    line = Line([box])
    high = begin(line.segment, TerminalFault(16, "high"), line.now)
    low = begin(line.segment, TerminalFault(1, "low"), line.now)
    assert shown_inputs(line) == 0x803E
    box.inputs = 0x7FFF
    assert shown_inputs(line) == 0xFFFE
    box.objects[0x2000, 1].value = 0xFFFF
    box.objects[0x2000, 2].value = 0x0001
    assert shown_inputs(line) == 0x8000
    high(line.now)
    low(line.now)
    assert shown_inputs(line) == 0x0001


@pytest.mark.parametrize("level", [0x0004, 0x0000])
def test_an_input_that_bounces_changes_with_each_half_period_and_begins_with_the_wrong_level(
    box: DiewuIoBox, level: int
) -> None:
    box.inputs = level
    line = Line([box])
    end = begin(line.segment, TerminalFault(3, "bounce", 3.0), line.now)
    shown = [shown_inputs(line) == level for _ in range(18)]
    edges = [n for n in range(1, 18) if shown[n] != shown[n - 1]]
    assert shown[0] is False
    assert {after - before for before, after in pairwise(edges)} == {3}
    end(line.now)
    assert [shown_inputs(line) for _ in range(9)] == [level] * 9


def test_the_joystick_s_lines_show_a_code_whatever_its_lever_does(box: DiewuIoBox) -> None:
    line = Line([box])
    end = begin(line.segment, JoystickCode(0b010101), line.now)
    box.inputs = 0xFFC0
    assert shown_inputs(line) == 0xFFD5
    end(line.now)
    assert shown_inputs(line) == 0xFFC0


def test_frozen_inputs_keep_their_value_whatever_is_done_to_the_terminals(box: DiewuIoBox) -> None:
    line = Line([box])
    box.inputs = 0xFFFF
    assert shown_inputs(line) == 0xFFFF
    ends = [begin(line.segment, InputsFrozen(1), line.now) for _ in range(2)]
    box.inputs = 0xFFC0
    pressed = begin(line.segment, TerminalFault(10, "low"), line.now)
    assert shown_inputs(line) == 0xFFFF
    ends[0](line.now)
    assert shown_inputs(line) == 0xFFFF
    ends[1](line.now)
    assert shown_inputs(line) == 0xFDC0
    pressed(line.now)
    assert shown_inputs(line) == 0xFFC0


def test_only_an_io_box_has_inputs_to_freeze() -> None:
    line = Line([CubemarsOrh40()])
    with pytest.raises(FaultRefused, match="is no IO box"):
        begin(line.segment, InputsFrozen(1), line.now)


def test_without_an_io_box_no_input_can_be_broken() -> None:
    line = Line([CubemarsOrh40()])
    for fault in (TerminalFault(1, "high"), JoystickCode(0)):
        with pytest.raises(FaultRefused, match="no IO box on the segment"):
            begin(line.segment, fault, line.now)


def test_on_the_bus_inprocess_drives_and_inputs_fail_alike() -> None:
    bus = InProcessBus([DiewuIoBox(), CubemarsOrh70()])
    models = [slave.device for slave in bus.slaves]
    undo = JoystickCode(0).begin(models)
    DriveErrorFault(2, "over-voltage").begin(models)
    for model in models:
        for _ in range(120):
            model.step(0.001)
    assert models[0].objects[0x6000, 1].value == 0x0300
    assert models[1].objects[0x603F, 0].value == 0x3210
    undo(bus.now_ns)
    models[0].step(0.001)
    assert models[0].objects[0x6000, 1].value == 0x033F
