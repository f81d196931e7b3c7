"""The node's messages of the arm, from the test's records: no ROS, no platform."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from kinematics.forward import forward
from rtcp.api import ControlMode, NotRunning, RtcpError, State
from rtcp.api.feed import Feed
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.config.model import ArmConfig
from rtcp.control.cycle import record_schema
from rtcp.fieldbus.simple_message.messages import RobotMode, TriState
from rtcp.ipc.observer import record_type
from rtcp.ipc.schema import (
    FLAG_EMERGENCY_STOP,
    FLAG_ENABLED,
    FLAG_MOTION_ALLOWED,
    FLAG_SWITCHING,
    RecordSchema,
    arm_schema,
)
from rtcp.ipc.terminals import named, terminals_of
from rtcp.motion.planning.interpolation import rotation
from rtcp.ros.processes import ProcessService
from rtcp.ros.state import (
    TOOL_FRAME,
    ChannelSample,
    Diagnostics,
    JointSample,
    RobotStatus,
    StatePublisher,
    _diagnostics,
    robot_status,
    transforms_of,
)
from tests.control.test_channels import config as with_valves

SCHEMA = arm_schema(6)
CONFIG = load(default_config())
MS = 1_000_000
READY_TO_MOVE = FLAG_ENABLED | FLAG_MOTION_ALLOWED
YES, NO, UNKNOWN = TriState.TRUE, TriState.FALSE, TriState.UNKNOWN


def record(time_ns: int = 0, **fields: Any) -> Any:
    made = np.zeros(1, record_type(SCHEMA))
    values = {"state": State.HOLDING, "control_mode": ControlMode.JOINT, "flags": READY_TO_MOVE, "wkc": 21,
              "wkc_expected": 21, "drives_powered": 1, "operating_mode": -1} | fields  # fmt: skip
    for name, value in (values | {"time_ns": time_ns}).items():
        made[name] = value
    return made[0]


class FakeFeed:
    """Records that a test adds."""

    period_ns = 2 * MS

    def __init__(self, config: ArmConfig = CONFIG, schema: RecordSchema = SCHEMA) -> None:
        self.config, self.schema = config, schema
        self.channels = named(*terminals_of(config, schema))
        self.holder = ""
        self.waiting: list[Any] = []
        self.has_ended = self.is_closed = False

    def ended(self, wait_s: float) -> bool:
        return self.has_ended

    def wait(self, timeout_s: float) -> bool:
        return bool(self.waiting)

    def records(self) -> tuple[Any, int]:
        samples, self.waiting = self.waiting, []
        return np.array(samples, record_type(self.schema)), 0

    def close(self) -> None:
        self.is_closed = True


class Heard:
    """A sink that records its messages."""

    def __init__(self) -> None:
        self.samples: list[JointSample] = []
        self.statuses: list[RobotStatus] = []
        self.entries: list[Diagnostics] = []
        self.sampled: list[ChannelSample] = []
        self.of_processes: list[dict[str, Diagnostics]] = []
        self.services: list[ProcessService] = []
        self.names: tuple[str, ...] = ()
        self.connections = 0

    def connected(self, config: Any) -> None:
        self.connections += 1

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        self.names = names
        self.samples.append(sample)

    def status(self, status: RobotStatus) -> None:
        self.statuses.append(status)

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        self.entries.append(diagnostics)

    def channels(self, sample: ChannelSample) -> None:
        self.sampled.append(sample)

    def processes(self, entries: Mapping[str, Diagnostics]) -> None:
        self.of_processes.append(dict(entries))

    def serve(self, services: Sequence[ProcessService]) -> None:
        self.services += services


@pytest.fixture
def feed() -> FakeFeed:
    return FakeFeed()


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def publisher(feed: FakeFeed, heard: Heard) -> StatePublisher:
    return StatePublisher(heard, lambda: cast(Feed, feed), 100.0, "node")


# -- joints ---------------------------------------------------------------------------------------------------------


def test_joints_have_the_names_and_values_of_the_record(
    feed: FakeFeed, publisher: StatePublisher, heard: Heard
) -> None:
    q = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    feed.waiting = [record(time.monotonic_ns(), actual_position=q, actual_velocity=1, actual_torque=2, sent_position=9,
                           commanded_position=3)]  # fmt: skip
    publisher.step(0)
    (sample,) = heard.samples
    assert heard.names == tuple(joint.name for joint in CONFIG.joints)
    assert (sample.position, sample.velocity, sample.effort) == (tuple(q), (1.0,) * 6, (2.0,) * 6)
    assert sample.commanded == (3.0,) * 6


def test_a_stamp_is_the_instant_of_the_cycle_on_the_hosts_clock(
    feed: FakeFeed, publisher: StatePublisher, heard: Heard
) -> None:
    before, woken, after = time.time_ns(), time.monotonic_ns(), time.time_ns()
    feed.waiting = [record(woken - 30 * MS)]
    publisher.step(0)
    stamp = heard.samples[0].stamp_ns + 30 * MS
    assert before - MS <= stamp <= after + MS
    assert heard.statuses[0].stamp_ns == heard.samples[0].stamp_ns


@pytest.mark.parametrize("jitter_ns", [0, 300_000])
@pytest.mark.parametrize(("rate_hz", "expected"), [(100.0, 100), (500.0, 500), (5000.0, 500), (30.0, 30)])
def test_samples_have_the_rate_asked_for_and_at_most_one_a_cycle(
    feed: FakeFeed, heard: Heard, rate_hz: float, expected: int, jitter_ns: int
) -> None:
    publisher = StatePublisher(heard, lambda: cast(Feed, feed), rate_hz)
    begin = time.monotonic_ns()
    feed.waiting = [record(begin + at * 2 * MS + (2 - at * 7 % 5) * jitter_ns // 2) for at in range(500)]
    publisher.step(0)
    assert abs(len(heard.samples) - expected) <= 1
    stamps = [sample.stamp_ns for sample in heard.samples]
    assert stamps == sorted(set(stamps))


def test_a_cycle_that_not_every_slave_answered_gives_no_sample(
    feed: FakeFeed, publisher: StatePublisher, heard: Heard
) -> None:
    begin = time.monotonic_ns()
    feed.waiting = [record(begin + at * 20 * MS, wkc=-1 if at == 1 else 21) for at in range(3)]
    publisher.step(0)
    assert [sample.stamp_ns - heard.samples[0].stamp_ns for sample in heard.samples] == [0, 40 * MS]


def test_what_was_published_is_not_published_again(feed: FakeFeed, publisher: StatePublisher, heard: Heard) -> None:
    feed.waiting = [record(time.monotonic_ns())]
    for _ in range(5):
        publisher.step(0)
    assert len(heard.samples) == 1


# -- the link -------------------------------------------------------------------------------------------------------


def test_without_a_platform_the_status_is_unknown_and_no_joints_come(heard: Heard) -> None:
    def refuse() -> Feed:
        raise RtcpError("not running", "no platform runs: start one")

    publisher = StatePublisher(heard, refuse)
    publisher.step(0)
    (status,), (entry,) = heard.statuses, heard.entries
    assert status == RobotStatus(status.stamp_ns)
    assert [value for name, value in dataclasses.asdict(status).items() if name != "stamp_ns"] == [
        -1,
        -1,
        -1,
        0,
        -1,
        -1,
        0,
        0.0,
    ]
    assert (entry.level, entry.message, entry.values) == (3, "no platform runs: start one", (("connected", "false"),))
    assert heard.samples == []


def test_the_end_of_the_platform_ends_the_joints_and_leaves_the_status_unknown(
    feed: FakeFeed, publisher: StatePublisher, heard: Heard
) -> None:
    feed.waiting = [record(time.monotonic_ns())]
    publisher.step(0)
    assert heard.statuses[0].motion_possible is YES
    feed.has_ended = True
    publisher.step(0)
    assert feed.is_closed
    assert heard.statuses[-1] == RobotStatus(heard.statuses[-1].stamp_ns)
    assert len(heard.samples) == 1


def test_a_platform_is_looked_for_once_a_second_and_found_when_it_comes(heard: Heard, feed: FakeFeed) -> None:
    tries: list[float] = []

    def open_late() -> Feed:
        tries.append(time.monotonic())
        if len(tries) < 2:
            raise RtcpError("not running", "none")
        return cast(Feed, feed)

    publisher = StatePublisher(heard, open_late)
    while heard.connections == 0:
        publisher.step(0.01)
    assert len(tries) == 2
    assert tries[1] - tries[0] >= 0.99


def test_a_loop_that_publishes_nothing_leaves_the_status_unknown(
    feed: FakeFeed, publisher: StatePublisher, heard: Heard
) -> None:
    feed.waiting = [record(time.monotonic_ns() - 600 * MS)]
    publisher.step(0)
    time.sleep(0.1)
    publisher.step(0)
    assert heard.statuses[-1].motion_possible is NO
    assert heard.statuses[-1].in_motion is UNKNOWN


# -- the status -----------------------------------------------------------------------------------------------------


def test_each_change_is_published_with_the_instant_of_its_cycle(
    feed: FakeFeed, publisher: StatePublisher, heard: Heard
) -> None:
    begin = time.monotonic_ns()
    states = [State.HOLDING, State.MOVING, State.MOVING, State.HOLDING]
    feed.waiting = [record(begin + at * 2 * MS, state=state) for at, state in enumerate(states)]
    publisher.step(0)
    seen = [(status.in_motion, status.stamp_ns - heard.statuses[0].stamp_ns) for status in heard.statuses]
    assert seen == [(NO, 0), (YES, 2 * MS), (NO, 6 * MS)]


def status_of(age_ms: int = 0, by_others: bool = False, **fields: Any) -> RobotStatus:
    return robot_status(record(**fields), age_ms * MS, 0, by_others)


@pytest.mark.parametrize(
    ("fields", "possible"),
    [
        ({}, YES),
        ({"state": State.MOVING}, YES),  # another trajectory replaces the one under way
        ({"state": State.READY, "flags": FLAG_MOTION_ALLOWED}, NO),
        ({"state": State.STOPPING}, NO),
        ({"state": State.FAULT}, NO),
        ({"flags": FLAG_ENABLED}, NO),  # the enabling switch is released
        ({"flags": READY_TO_MOVE | FLAG_EMERGENCY_STOP}, NO),
        ({"flags": READY_TO_MOVE | FLAG_SWITCHING}, NO),
        ({"control_mode": ControlMode.JOYSTICK}, NO),
        ({"control_mode": ControlMode.VELOCITY}, NO),
        ({"by_others": True}, NO),
        ({"age_ms": 600}, NO),
    ],
)
def test_motion_is_possible_only_where_a_trajectory_would_begin_now(fields: dict[str, Any], possible: TriState) -> None:
    assert status_of(**fields).motion_possible is possible


def test_an_emergency_stop_is_an_error_too() -> None:
    pressed = status_of(flags=READY_TO_MOVE | FLAG_EMERGENCY_STOP, e_stopped=1)
    assert (pressed.e_stopped, pressed.in_error) == (YES, YES)
    stopped = status_of(state=State.EMERGENCY_STOP, flags=0, fault=23)
    assert (stopped.e_stopped, stopped.in_error, stopped.error_code) == (YES, YES, 23)


@pytest.mark.parametrize(("fields", "code"), [({"fault": 5}, 5), ({"limit": 20, "state": State.STOPPED_BY_LIMIT}, 20)])
def test_the_error_code_is_the_event_behind_the_error(fields: dict[str, Any], code: int) -> None:
    assert status_of(**{"state": State.FAULT} | fields).error_code == code
    assert status_of(**fields | {"state": State.HOLDING}).error_code == 0


def test_power_that_no_frame_shows_is_unknown() -> None:
    assert status_of(age_ms=600, state=State.FAULT).drives_powered is UNKNOWN
    assert status_of(age_ms=100, state=State.FAULT).drives_powered is YES
    assert status_of(age_ms=100, state=State.FAULT, drives_powered=0).drives_powered is NO


def test_an_arm_that_decelerates_in_a_fault_is_in_motion_until_it_rests() -> None:
    assert status_of(state=State.FAULT, actual_velocity=[0, 0, -0.5, 0, 0, 0]).in_motion is YES
    assert status_of(state=State.FAULT, actual_velocity=0.001).in_motion is NO
    assert status_of(age_ms=600, state=State.FAULT, actual_velocity=0.5).in_motion is UNKNOWN


def test_the_mode_is_the_position_of_the_controllers_key_and_never_the_joysticks() -> None:
    assert status_of(operating_mode=1).mode is RobotMode.MANUAL
    assert status_of(operating_mode=2).mode is RobotMode.AUTO
    assert status_of(control_mode=ControlMode.JOYSTICK).mode is RobotMode.UNKNOWN


def test_what_a_bus_does_not_measure_is_empty(heard: Heard) -> None:
    for arm, velocities, efforts in (("abb_irb120", 6, 0), ("abb_irb120_rapid", 0, 0), ("assistive_arm", 6, 6)):
        feed = FakeFeed(load(default_config().with_name(f"{arm}.yaml")))
        feed.waiting = [record(time.monotonic_ns(), actual_torque=1.0)]
        StatePublisher(heard, lambda feed=feed: cast(Feed, feed)).step(0)  # type: ignore[misc]
        sample = heard.samples[-1]
        assert (len(sample.position), len(sample.velocity), len(sample.effort)) == (6, velocities, efforts)


def test_a_force_exists_only_while_a_sensor_sends_it(heard: Heard) -> None:
    config = load(default_config().with_name("abb_irb120.yaml"))
    schema = record_schema(config)
    feed = FakeFeed(config, schema)
    made = np.zeros(2, record_type(schema))
    made["time_ns"] = [time.monotonic_ns() + at * 200 * MS for at in range(2)]
    made["robot_measured_force_x"] = [np.nan, 4.0]
    feed.waiting = list(made)
    StatePublisher(heard, lambda: cast(Feed, feed)).step(0)
    without, with_sensor = (sample.values["robot"] for sample in heard.sampled)
    assert "measured_force_x" not in without
    assert with_sensor["measured_force_x"] == 4.0


def test_not_running_is_the_only_error_that_is_waited_out(heard: Heard) -> None:
    def fail() -> Feed:
        raise RuntimeError("a programming error")

    assert issubclass(NotRunning, RtcpError)
    with pytest.raises(RuntimeError):
        StatePublisher(heard, fail).step(0)


def test_the_tool_has_a_frame_and_the_links_where_that_is_asked_for() -> None:
    arm = CONFIG.arm
    assert arm is not None
    q = (0.1, 0.3, 1.2, 0.2, 0.4, 0.5)
    pose = forward(arm, q)
    alone, every = transforms_of(arm, q, False), transforms_of(arm, q, True)
    assert list(alone) == [TOOL_FRAME]
    assert list(every) == [*(f"link{number}" for number in range(1, 7)), "tool0", TOOL_FRAME]
    assert every["tool0"] == every[TOOL_FRAME] == alone[TOOL_FRAME]
    position, orientation = alone[TOOL_FRAME]
    assert position == pytest.approx(pose.position)
    assert rotation(orientation) == pytest.approx(pose.rotation)


def test_diagnostics_name_the_channels_of_slaves_with_their_units() -> None:
    config = with_valves()
    schema = record_schema(config)
    feed = SimpleNamespace(config=config, schema=schema, holder="")
    (record,) = np.zeros(1, record_type(schema))
    record["state"], record["valves_pressure"] = State.READY, 2.5
    values = dict(_diagnostics(cast(Feed, feed), record, 0).values)
    assert values["valves pressure"] == "2.5 bar"
    assert values["valves current"] == "0.0 mA"


def test_channels_and_named_terminals_are_published_ten_times_a_second_by_slave_and_name(heard: Heard) -> None:
    config = with_valves()
    feed = FakeFeed(config, record_schema(config))
    publisher = StatePublisher(heard, lambda: cast(Feed, feed))
    made = np.zeros(151, record_type(feed.schema))
    made["time_ns"] = time.monotonic_ns() + np.arange(151) * 2 * MS
    made["valves_pressure"], made["io_inputs"], made["io_outputs"] = 2.5, 0b10, 0b1000
    made["wkc"][50:55] = -1  # a cycle without an answer repeats the last known values
    feed.waiting = list(made)
    publisher.step(0)
    assert [each.stamp_ns - heard.sampled[0].stamp_ns for each in heard.sampled] == [0, 110 * MS, 210 * MS]
    sample = heard.sampled[0]
    assert sample.values["valves"] == {"pressure": 2.5, "angle": 0.0, "current": 0.0}
    assert {name for name, level in sample.values["io"].items() if level} == {"backward", "gripper"}
    assert not [name for name in sample.values["io"] if name[0].isdigit()]
    assert sample.settable == [("valves", "current")]


def test_a_process_is_published_ten_times_a_second_and_at_each_change_of_its_state_and_has_no_joints(
    heard: Heard,
) -> None:
    config = load(default_config().parent / "heater.yaml")
    feed = FakeFeed(config, record_schema(config))
    publisher = StatePublisher(heard, lambda: cast(Feed, feed))
    made = np.zeros(5, record_type(feed.schema))
    begin = time.monotonic_ns()
    made["time_ns"], made["state"] = begin + np.arange(5) * 2 * MS, State.HOLDING
    made["heater_state"] = [1, 1, 2, 2, 5]
    made["heater_middle_temperature"][-1] = 81.5
    feed.waiting = list(made)
    publisher.step(0)
    assert [(entries["heater"].message, entries["heater"].level) for entries in heard.of_processes] == [
        ("ready", 0), ("armed", 0), ("holding", 0),
    ]  # fmt: skip
    first, *_, last = (entries["heater"] for entries in heard.of_processes)
    assert last.stamp_ns - first.stamp_ns == 8 * MS
    values = dict(last.values)
    assert (values["middle_temperature"], values["busy"]) == ("81.5", "0")
    assert "heater/arm_heater" in [service.name for service in heard.services]
    assert heard.samples == []
    made["state"][-1], made["time_ns"] = State.FAULT, time.monotonic_ns()
    feed.waiting = list(made[-1:])
    publisher.step(0)
    assert heard.of_processes[-1]["heater"].level == 2
    before = len(heard.of_processes)
    time.sleep(0.11)
    made["time_ns"] = time.monotonic_ns()
    feed.waiting = list(made[-1:])
    publisher.step(0)
    assert len(heard.of_processes) == before + 1
