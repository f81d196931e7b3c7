"""External axes through the whole loop, in simulated time: a rail in metres and a conveyor, without an arm."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, DriveWaitsConfig
from rtcp.control.external_axis import ExternalAxisGroup
from rtcp.ipc.commands import (
    Command,
    Disable,
    Enable,
    Halt,
    Home,
    HomeAxis,
    MoveAxis,
    Reset,
    RunAxis,
    Shutdown,
    StopAxis,
)
from rtcp.ipc.events import (
    AxisAtRest,
    AxisFailed,
    AxisModeLost,
    AxisNotReplaced,
    AxisStillMoving,
    ClockLost,
    Event,
    Homed,
    HomedElsewhere,
    LeaseExpired,
)
from rtcp.ipc.states import State
from rtcp.testing.simulation import Frame, Simulation
from rtcp.virtual.models import CubemarsDrive
from rtcp.virtual.models.profile_modes import Phase, SetPoint
from tests.control.rig import about

SHIPPED = load(default_config().parent / "linear_axis.yaml")
CONFIG = replace(SHIPPED, cycle=replace(SHIPPED.cycle, period_us=2000.0))
RAIL_AXIS = CONFIG.external_axes[0]
ABSOLUTE = replace(
    CONFIG, external_axes=(replace(RAIL_AXIS, modes=("position", "velocity")), *CONFIG.external_axes[1:])
)
"""The rail with an encoder that needs no homing."""
RAIL, BELT = 0, 1
M_PER_RAD = 0.1
"""Travel of both axes for a rad of their drives."""
OUTPUTS = struct.Struct("<HiIib")
"""Controlword, target position, profile velocity, target velocity and mode, as the device file maps them."""
NEW_SETPOINT, HALT = 0x10, 0x100
EMERGENCY_STOP_INPUT = 9
SET_POINT = SetPoint(6.0, 2.0, 5.0, 5.0, limited=False)
"""0.6 m, rad of the drive."""


class Bench(Simulation):
    """Both axes, enabled. Records what each drive is sent."""

    def __init__(self, config: ArmConfig = ABSOLUTE) -> None:
        super().__init__(config, follow_clock=False)
        self.axes: list[ExternalAxisGroup] = self.loop.machine.context.axes
        self.drives = [slave.device for slave in self.bus.slaves if isinstance(slave.device, CubemarsDrive)]
        self.sent: list[list[tuple[int, ...]]] = [[], []]
        self.on_frame = self._see
        self.hold()

    def _see(self, frame: Frame) -> None:
        for axis, sent in enumerate(self.sent):
            sent.append(OUTPUTS.unpack(frame.sent[1 + axis]))

    def at(self, axis: int) -> float:
        """True travel of an axis from the drive's own zero, m."""
        mechanics = self.drives[axis].servo.axis
        return (mechanics.mechanics.position + mechanics.offset) * M_PER_RAD

    def speed(self, axis: int) -> float:
        """True speed, m/s."""
        return self.drives[axis].mechanics.velocity * M_PER_RAD

    def rest(self, axis: int, seconds: float = 10.0) -> None:
        assert self.until(lambda: self.axes[axis].at_rest, seconds), self.axes[axis].phase
        self.run(0.1)

    def recover_from_emergency_stop(self) -> None:
        """Press and release the emergency stop, reset, and enable again."""
        assert self.box is not None
        self.box.set_input(EMERGENCY_STOP_INPUT, False)
        self.bring_to(State.EMERGENCY_STOP)
        self.run(1.5)
        self.box.set_input(EMERGENCY_STOP_INPUT, True)
        self.run(0.1)
        self.do(Reset())
        self.bring_to(State.READY)
        self.hold()

    def last_of(self, kind: type[Event]) -> Event:
        return [record.event for record in self.events if isinstance(record.event, kind)][-1]

    def refused(self, command: Command) -> str:
        refusal = self.send(command).refusal
        assert refusal is not None
        return self.names.message(refusal)

    def field(self, name: str) -> float:
        return float(self.observer.latest()[0][name])


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as made:
        yield made


def test_an_axis_moves_to_a_position_at_a_speed_and_says_that_it_is_there(bench: Bench) -> None:
    bench.do(MoveAxis(RAIL, 0.3, 0.1))
    bench.run(1.0)
    assert bench.speed(RAIL) == pytest.approx(0.1, abs=0.003)
    assert bench.field("rail_moving")
    bench.rest(RAIL)
    assert bench.at(RAIL) == pytest.approx(0.3, abs=1e-3)
    rest = bench.last_of(AxisAtRest)
    assert rest == AxisAtRest(RAIL, about(0.3, abs=1e-3), True)
    assert bench.names.message(rest).endswith(" m")
    assert not bench.field("rail_moving")
    assert bench.field("rail_actual_position") == pytest.approx(0.3, abs=1e-3)


def test_a_new_target_on_the_way_replaces_the_former_one(bench: Bench) -> None:
    bench.do(MoveAxis(RAIL, 0.6))
    bench.run(1.5)
    bench.do(MoveAxis(RAIL, 0.1))
    bench.rest(RAIL)
    assert bench.at(RAIL) == pytest.approx(0.1, abs=1e-3)
    assert [record.event.reached for record in bench.events if isinstance(record.event, AxisAtRest)] == [True]


@pytest.mark.parametrize("gap_s", [0.0, 0.002, 0.006])
def test_a_target_that_comes_before_the_former_one_is_acknowledged_replaces_it(bench: Bench, gap_s: float) -> None:
    bench.do(MoveAxis(RAIL, 0.6))
    bench.run(gap_s)
    bench.do(MoveAxis(RAIL, 0.1))
    bench.rest(RAIL)
    assert bench.at(RAIL) == pytest.approx(0.1, abs=1e-3)
    assert bench.last_of(AxisAtRest) == AxisAtRest(RAIL, about(0.1, abs=1e-3), True)


@pytest.mark.parametrize("stop", [StopAxis(RAIL), Halt()], ids=["stop", "halt"])
def test_a_stopped_axis_does_not_continue_to_its_former_target(bench: Bench, stop: Command) -> None:
    bench.do(MoveAxis(RAIL, 0.6))
    bench.run(1.0)
    assert bench.speed(RAIL) > 0.2
    bench.do(stop)
    bench.rest(RAIL)
    stood = bench.at(RAIL)
    assert stood < 0.4
    assert bench.last_of(AxisAtRest) == AxisAtRest(RAIL, about(stood, abs=1e-3), False)
    assert any(sent[0] & HALT for sent in bench.sent[RAIL])
    bench.run(2.0)
    # Not halted any more, and it stands: the set-point was replaced.
    assert not bench.sent[RAIL][-1][0] & HALT
    assert bench.at(RAIL) == pytest.approx(stood, abs=2e-4)


def test_a_conveyor_runs_for_its_hold_time_and_each_command_holds_anew(bench: Bench) -> None:
    before = bench.at(BELT)
    for _ in range(5):
        bench.do(RunAxis(BELT, 0.15, 0.25))
        bench.run(0.2)
    assert bench.speed(BELT) == pytest.approx(0.15, abs=0.005)
    assert bench.at(BELT) > before + 0.05
    bench.rest(BELT, 2.0)
    assert bench.speed(BELT) == pytest.approx(0.0, abs=1e-3)
    assert all(sent[3] == 0 for sent in bench.sent[BELT][-50:])


def test_an_axis_that_runs_is_halted_before_the_end_of_its_range(bench: Bench) -> None:
    bench.do(RunAxis(RAIL, 0.25, 60.0))
    bench.rest(RAIL)
    assert 0.7 < bench.at(RAIL) <= 0.8
    assert bench.axes[RAIL].drive.mode_display == 1
    assert "-0.1 to 0.8 m" in bench.refused(RunAxis(RAIL, 0.25, 1.0))
    bench.do(RunAxis(RAIL, -0.1, 0.3))


def test_the_end_of_the_lease_halts_every_axis(bench: Bench) -> None:
    bench.do(MoveAxis(RAIL, 0.6))
    bench.do(RunAxis(BELT, 0.15, 60.0))
    bench.run(0.8)
    bench.observer.release(bench.lease)
    bench.rest(RAIL)
    bench.rest(BELT)
    assert bench.at(RAIL) < 0.5
    assert isinstance(bench.last_of(LeaseExpired), LeaseExpired)
    assert bench.state is State.HOLDING


def test_an_emergency_stop_stops_both_and_nothing_moves_after_it(bench: Bench) -> None:
    bench.do(MoveAxis(RAIL, 0.6))
    bench.do(RunAxis(BELT, 0.15, 60.0))
    bench.run(0.8)
    assert bench.box is not None
    bench.box.set_input(EMERGENCY_STOP_INPUT, False)
    bench.bring_to(State.EMERGENCY_STOP)
    bench.run(1.5)
    assert [bench.speed(axis) for axis in (RAIL, BELT)] == [pytest.approx(0.0, abs=1e-3)] * 2
    assert not any(drive.powered for drive in bench.drives)
    bench.box.set_input(EMERGENCY_STOP_INPUT, True)
    bench.run(0.1)
    bench.do(Reset())
    bench.bring_to(State.READY)
    bench.hold()
    stood = bench.at(RAIL), bench.at(BELT)
    bench.run(1.0)
    assert (bench.at(RAIL), bench.at(BELT)) == pytest.approx(stood, abs=2e-4)
    bench.do(MoveAxis(RAIL, 0.1))


def test_disabling_halts_an_axis_before_its_torque_goes(bench: Bench) -> None:
    bench.do(MoveAxis(RAIL, 0.6))
    bench.run(1.0)
    bench.do(Disable())
    assert bench.until(lambda: not bench.drives[RAIL].powered, 3.0)
    assert bench.speed(RAIL) == pytest.approx(0.0, abs=1e-3)
    bench.bring_to(State.READY)
    assert bench.refused(MoveAxis(RAIL, 0.1)) == "the drive of rail is not enabled: `rtcp enable` first"


def test_homing_gives_the_rail_its_positions_and_is_needed_before_a_motion_and_after_an_emergency_stop() -> None:
    with Bench(CONFIG) as bench:
        assert "is not homed" in bench.refused(MoveAxis(RAIL, 0.1))
        assert "is not homed" in bench.refused(RunAxis(RAIL, 0.1, 1.0))
        before = bench.drives[RAIL].mechanics.position
        bench.do(HomeAxis(RAIL))
        bench.rest(RAIL)
        assert bench.drives[RAIL].mechanics.position < before
        assert isinstance(bench.last_of(Homed), Homed)
        assert bench.field("rail_homed")
        bench.do(MoveAxis(RAIL, 0.05))
        bench.rest(RAIL)
        assert bench.at(RAIL) == pytest.approx(0.05, abs=1e-3)
        bench.recover_from_emergency_stop()
        assert bench.refused(MoveAxis(RAIL, 0.1)) == "rail is not homed: `rtcp axis home rail` first"


@pytest.mark.interpreted
def test_a_rail_whose_drive_says_it_is_homed_where_it_is_not_has_not_homed() -> None:
    with Bench(replace(CONFIG, homing=replace(CONFIG.homing, tolerance=0.01))) as bench:
        homing: Any = bench.drives[RAIL].servo._modes[6]
        homing._begin = lambda: setattr(homing, "_phase", Phase.ATTAINED)
        bench.do(HomeAxis(RAIL, 0.0))
        bench.rest(RAIL)
        assert bench.last_of(HomedElsewhere) == HomedElsewhere(RAIL, about(0.05, abs=1e-3), 0.0)
        assert "is not homed" in bench.refused(MoveAxis(RAIL, 0.1))


def test_a_drive_that_loses_its_supply_during_a_reset_is_homed_no_more() -> None:
    with Bench(CONFIG) as bench:
        bench.do(HomeAxis(RAIL))
        bench.rest(RAIL)
        bench.drives[BELT].inject_fault(0x2310)
        bench.bring_to(State.FAULT)
        bench.run(0.5)
        assert bench.axes[RAIL].homed
        bench.do(Reset())
        bench.bring_to(State.RESETTING)
        bench.bus.restart(2)
        bench.run(0.004)
        assert bench.state is State.RESETTING
        assert not bench.axes[RAIL].homed


def test_an_axis_that_has_found_its_home_can_be_stopped_and_the_end_of_the_lease_is_published_once() -> None:
    with Bench(CONFIG) as bench:
        bench.do(HomeAxis(RAIL))
        assert bench.until(lambda: bool(bench.axes[RAIL]._homing._attained), 30.0)
        bench.observer.release(bench.lease)
        bench.rest(RAIL)
        assert [type(record.event) for record in bench.events].count(LeaseExpired) == 1
        assert not bench.field("rail_homed")


def test_what_an_axis_may_not_do_is_refused_and_nothing_is_sent(bench: Bench) -> None:
    bench.sent[RAIL].clear()
    nan = float("nan")
    assert bench.refused(MoveAxis(RAIL, 0.9)) == (
        "rail: 0.9 m is outside its range: allowed is -0.1 to 0.8 m (external_axes[0].position in linear_axis.yaml)"
    )
    assert "rail: 0.3 m/s is not allowed: 1e-05 to 0.25 m/s" in bench.refused(MoveAxis(RAIL, 0.1, 0.3))
    for below_a_count in (1e-310, 1e-6):
        assert "is not allowed: " in bench.refused(MoveAxis(RAIL, 0.1, below_a_count))
    assert bench.refused(Home(RAIL)) == "rail is an external axis, no joint: `rtcp axis home rail`"
    assert "belt is not used in profile position" in bench.refused(MoveAxis(BELT, 0.1))
    assert "rail is not used in homing" in bench.refused(HomeAxis(RAIL))
    assert "belt is not used in homing" in bench.refused(HomeAxis(BELT))
    for command in (MoveAxis(RAIL, nan), MoveAxis(RAIL, 0.1, nan), RunAxis(RAIL, nan, 1.0), RunAxis(RAIL, 0.1, nan),
                    MoveAxis(7, 0.1), StopAxis(-1)):  # fmt: skip
        bench.refused(command)
    bench.do(RunAxis(RAIL, 0.1, 1.0))
    assert "moves in another mode" in bench.refused(MoveAxis(RAIL, 0.1))
    assert not any(sent[0] & NEW_SETPOINT for sent in bench.sent[RAIL])


@pytest.mark.interpreted
def test_an_axis_whose_drive_takes_no_set_point_is_stopped(bench: Bench) -> None:
    model = bench.drives[RAIL]
    position = model.servo._modes[1]
    setattr(position, "_handshake", lambda controlword: None)  # noqa: B010 a drive that takes none
    bench.do(MoveAxis(RAIL, 0.3))
    bench.bring_to(State.FAULT, 5.0)
    assert isinstance(bench.last_of(AxisFailed), AxisFailed)
    assert isinstance(bench.last_of(AxisNotReplaced), AxisNotReplaced)


def test_a_drive_that_leaves_its_mode_is_a_fault(bench: Bench) -> None:
    bench.do(RunAxis(BELT, 0.15, 60.0))
    bench.run(0.5)
    servo = bench.drives[BELT].servo
    servo._choose_mode(8)
    del servo._modes[3]  # it would go back to it at once
    bench.bring_to(State.FAULT, 2.0)
    lost = bench.last_of(AxisModeLost)
    assert "shows mode 8, commanded is profile velocity" in bench.names.message(lost)
    bench.run(1.0)
    assert bench.speed(BELT) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.interpreted
def test_an_axis_that_ignores_its_halt_is_stopped_by_its_drive(bench: Bench) -> None:
    servo = bench.drives[BELT].servo
    servo._control_halt = lambda controlword: None  # type: ignore[method-assign]
    bench.do(RunAxis(BELT, 0.15, 0.3))
    # The target velocity of 0 is lost too.
    servo._modes[3]._target = SimpleNamespace(value=15000)  # type: ignore[attr-defined]
    bench.bring_to(State.FAULT, 6.0)
    still = bench.last_of(AxisStillMoving)
    assert bench.names.message(still).startswith("belt does not come to rest although it is halted: 0.15")
    bench.run(1.0)
    assert bench.speed(BELT) == pytest.approx(0.0, abs=1e-3)
    # Once the drive obeys again, the fault is forgotten.
    del servo._control_halt
    servo._modes[3]._target = SimpleNamespace(value=0)  # type: ignore[attr-defined]
    bench.do(Reset())
    bench.bring_to(State.READY)
    bench.hold()


@pytest.mark.interpreted
def test_closing_stops_an_axis_that_ignores_its_halt_by_its_drive(bench: Bench) -> None:
    servo = bench.drives[BELT].servo
    servo._control_halt = lambda controlword: None  # type: ignore[method-assign]
    bench.do(RunAxis(BELT, 0.15, 30.0))
    bench.run(1.0)
    servo._modes[3]._target = SimpleNamespace(value=15000)  # type: ignore[attr-defined]
    bench.send(Shutdown())
    bench.bring_to(State.OFF, 10.0)
    assert isinstance(bench.last_of(AxisStillMoving), AxisStillMoving)
    assert not bench.drives[BELT].powered
    assert bench.speed(BELT) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("way", ["disabled", "run", "emergency"])
def test_a_drive_that_keeps_its_set_point_does_not_go_on_to_it(bench: Bench, way: str) -> None:
    bench.drives[RAIL].servo.keeps_set_point = True
    bench.do(MoveAxis(RAIL, 0.6))
    bench.run(1.0)
    if way == "run":
        bench.do(StopAxis(RAIL))
        bench.rest(RAIL)
        bench.drives[RAIL].servo._modes[1]._active = SET_POINT  # type: ignore[attr-defined]
        bench.do(RunAxis(RAIL, 0.1, 0.3))
        bench.rest(RAIL)
    elif way == "disabled":
        bench.do(Disable())
        bench.bring_to(State.READY)
        # As a drive that was at its target, and was then pushed.
        bench.drives[RAIL].servo._modes[1]._active = SET_POINT  # type: ignore[attr-defined]
        bench.hold()
    else:
        bench.recover_from_emergency_stop()
    stood = bench.at(RAIL)
    bench.run(2.0)
    assert bench.at(RAIL) == pytest.approx(stood, abs=1e-3)
    assert stood < 0.4
    bench.do(MoveAxis(RAIL, stood + 0.02))


def test_no_axis_begins_to_move_while_a_fault_waits_for_standstill() -> None:
    stops = replace(ABSOLUTE.stops, clock_lost="controlled_stop")
    with Bench(replace(ABSOLUTE, stops=stops)) as bench:
        bench.do(RunAxis(BELT, 0.15, 30.0))
        bench.run(1.0)
        bench.loop.machine._handle(ClockLost(1.0))
        bench.run(0.01)
        for command in (MoveAxis(RAIL, 0.6), RunAxis(RAIL, 0.1, 30.0), HomeAxis(RAIL)):
            assert bench.refused(command).startswith("a fault has stopped all motion and begins at standstill")
        stood = bench.at(RAIL)
        bench.bring_to(State.FAULT, 3.0)
        assert bench.at(RAIL) == pytest.approx(stood, abs=1e-3)


@pytest.mark.parametrize(("pulse_ms", "state"), [(10.0, State.FAULT), (50.0, State.READY)])
def test_the_drive_of_an_axis_is_reset_by_the_configured_pulse(pulse_ms: float, state: State) -> None:
    with Bench(replace(ABSOLUTE, drive_waits=DriveWaitsConfig(reset_pulse_ms=pulse_ms, reset_ms=500.0))) as bench:
        servo = bench.drives[RAIL].servo
        servo.reset_pulse = 0.03
        servo.inject_fault(0x2310)
        bench.bring_to(State.FAULT)
        bench.run(0.5)
        bench.do(Reset())
        bench.bring_to(state)


def test_a_drive_that_does_not_show_the_mode_in_which_its_axis_rests_is_not_enabled() -> None:
    with Simulation(ABSOLUTE, follow_clock=False) as bench:
        del bench.bus.slaves[1].device.servos[0]._modes[1]
        bench.bring_to(State.READY)
        bench.acquire()
        bench.do(Enable())
        bench.bring_to(State.FAULT, 10.0)
        (lost,) = [record.event for record in bench.events if isinstance(record.event, AxisModeLost)]
        assert bench.names.message(lost).startswith("the drive of rail shows mode 0, commanded is profile position")
