"""Samples of the arm for the node, from cycle records alone, without ROS types.

Every stamp is the instant of a cycle, converted to CLOCK_REALTIME; no sample is published twice. Joint samples are from
cycles in which every slave answered; in the others the record repeats older values.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from kinematics.forward import frames
from kinematics.model import ArmModel
from kinematics.pose import Vector
from rtcp import api
from rtcp.api import ControlMode, NotRunning, State
from rtcp.api.feed import Feed, Records
from rtcp.fieldbus.simple_message.messages import RobotMode, TriState
from rtcp.motion.planning.interpolation import Quaternion, quaternion
from rtcp.ros.processes import ProcessService, services_of

TOOL_FRAME = "tool0_controller"
"""Frame of the tool, named as by other drivers; `tool0` is a fixed child of the URDF's last link."""
RECONNECT_S = 1.0
"""Interval between two attempts to reach the platform (ROS-Industrial driver specification, 1.2.2)."""
_SECOND_NS = 1_000_000_000
_STATUS_NS = _SECOND_NS // 10
"""Longest interval between two statuses, beside one at each change, and interval of the channels' samples, ns."""
_DIAGNOSTICS_NS = _SECOND_NS
_STALE_NS = round(api.RobotStatus.STALE_S * 1e9)
"""Age above which a record, or a measured value in one, is stale, ns."""
_CHANGES = (
    "state", "flags", "control_mode", "fault", "limit", "speed_override", "drives_powered", "e_stopped",
    "operating_mode",
)  # fmt: skip
_IN_ERROR = (State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT, State.RESETTING)
_TAKES_MOTIONS = (ControlMode.JOINT, ControlMode.CARTESIAN)

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class JointSample:
    """The joints in one cycle, base to tool; `stamp_ns`: its instant, CLOCK_REALTIME."""

    stamp_ns: int
    position: Numbers
    """Actual, rad."""
    velocity: Numbers
    """Actual, rad/s; empty where the drives send none."""
    effort: Numbers
    """Actual, Nm; empty where the drives send none."""
    commanded: Numbers
    """Commanded position, rad."""
    tool: int = 0
    """Number of the tool in use."""


@dataclass(frozen=True)
class RobotStatus:
    """industrial_msgs/RobotStatus; `stamp_ns`: CLOCK_REALTIME. The defaults mean: unknown, and no motion possible."""

    stamp_ns: int
    mode: RobotMode = RobotMode.UNKNOWN
    e_stopped: TriState = TriState.UNKNOWN
    drives_powered: TriState = TriState.UNKNOWN
    motion_possible: TriState = TriState.FALSE
    in_motion: TriState = TriState.UNKNOWN
    in_error: TriState = TriState.UNKNOWN
    error_code: int = 0
    """Number of the event (`docs/machine.md`); 0: no error."""
    speed_override: float = 0.0
    """Speed override, 0 to 1; of a group the smallest one; 0: unknown."""


@dataclass(frozen=True)
class Diagnostics:
    """One entry of diagnostic_msgs/DiagnosticArray; `level`: 0 OK, 1 warning, 2 error, 3 stale."""

    stamp_ns: int
    level: int
    message: str
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class ChannelSample:
    """Named inputs and outputs of IO boxes, and channels of slaves, in one cycle, by slave and name."""

    stamp_ns: int
    values: Mapping[str, Mapping[str, float]]
    """In the unit of the device's file; a level is 0 or 1. What is not measured, as a force without a sensor, is left
    out."""
    settable: Collection[tuple[str, str]] = ()
    """Slave and name of those that a command may set."""


class Sink(Protocol):
    """Publisher of the samples."""

    def connected(self, config: Any) -> None:
        """A platform was reached: its configuration (`rtcp.config.model.ArmConfig`)."""

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        """Publish joint_states and feedback_states."""

    def status(self, status: RobotStatus) -> None:
        """Publish robot_status."""

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        """Publish diagnostics."""

    def channels(self, sample: ChannelSample) -> None:
        """Publish the channels."""

    def processes(self, entries: Mapping[str, Diagnostics]) -> None:
        """Publish an entry for each process, by its name: the message is its state, the values are its fields."""

    def serve(self, services: Sequence[ProcessService]) -> None:
        """Offer the commands of the processes of a platform that was reached; those of before stay."""


def robot_status(record: Any, age_ns: int, stamp_ns: int, is_held_by_others: bool = False) -> RobotStatus:
    """Return the status that a cycle record shows.

    Args:
        record: the cycle record.
        age_ns: age of its measured values at its instant, ns.
        stamp_ns: its instant, CLOCK_REALTIME.
        is_held_by_others: whether another commander holds the lease, so that a motion would be refused.
    """
    status = api.RobotStatus.of_record(record, age_ns * 1e-9)
    takes_motions = int(record["control_mode"]) in _TAKES_MOTIONS and not is_held_by_others
    return RobotStatus(
        stamp_ns,
        RobotMode.UNKNOWN if status.mode is None else RobotMode[status.mode.upper()],
        _tri_state(status.e_stopped),
        _tri_state(status.drives_powered),
        TriState(status.motion_possible and takes_motions),
        _tri_state(status.in_motion),
        TriState(status.in_error),
        status.error_code,
        float(record["speed_override"]),
    )


def _tri_state(value: bool | None) -> TriState:
    return TriState.UNKNOWN if value is None else TriState(value)


def transforms_of(arm: ArmModel, q: Numbers, has_links: bool) -> dict[str, tuple[Vector, Quaternion]]:
    """Return frames by name, each with its position, m, and orientation (w, x, y, z) in `base_link`.

    Args:
        arm: the geometry.
        q: joint positions, rad, one number for each joint.
        has_links: whether to return the links and `tool0` beside `TOOL_FRAME`: without a robot_state_publisher.
    """
    poses = frames(arm, q)
    names = [*(f"link{number}" for number in range(1, len(poses))), "tool0"] if has_links else []
    poses_of = dict(zip([*names, TOOL_FRAME], [*poses, poses[-1]] if has_links else poses[-1:], strict=True))
    return {name: (pose.position, quaternion(pose.rotation)) for name, pose in poses_of.items()}


class StatePublisher:
    """Reads the records of the platform and publishes samples to a sink; tries to connect once a second.

    Args:
        sink: publishes the samples.
        open_feed: returns the records of the platform; raises NotRunning.
        rate_hz: joint samples per second; at most one per cycle.
        name: name of this node as commander; a lease with another name is held by others.
    """

    def __init__(
        self, sink: Sink, open_feed: Callable[[], Feed] = Feed, rate_hz: float = 100.0, name: str = ""
    ) -> None:
        self._sink, self._open, self._name = sink, open_feed, name
        self._period_ns = round(_SECOND_NS / rate_hz)
        self._names: tuple[str, ...] = ()
        self._measures_velocity = self._measures_effort = True
        self._feed: Feed | None = None
        self._why = ""
        """Reason for the missing feed."""
        self._retry_ns = self._status_ns = self._diagnostics_ns = 0
        """When each is due, CLOCK_MONOTONIC."""
        self._joints_ns = 0
        """When the next sample is due, CLOCK_MONOTONIC of its cycle."""
        self._channels_ns = 0
        """As `_joints_ns`, of the channels."""
        self._measured_ns = 0
        """Cycle of the last sample, CLOCK_MONOTONIC."""
        self._last: Any = None
        """Newest record; None: none yet."""
        self._changes: tuple[str, ...] = _CHANGES
        """Fields of which each change is published at once: also the states of processes."""
        self._level: tuple[float, ...] = ()
        """Its fields `_changes`."""

    def step(self, wait_s: float) -> None:
        """Wait for new records, and publish what is due."""
        now_ns = time.monotonic_ns()
        if self._feed is None and now_ns >= self._retry_ns:
            self._retry_ns = now_ns + round(RECONNECT_S * 1e9)
            self._connect()
        feed = self._feed
        if feed is None:
            time.sleep(wait_s)
        else:
            # Sleep until the next sample is due: waking up for each of up to 2000 records a second costs too much.
            rest_s = (self._joints_ns - feed.period_ns - now_ns) * 1e-9
            has_ended = feed.ended(min(max(rest_s, 0.0), wait_s))
            feed.wait(wait_s)
            self._follow(feed, feed.records()[0])
            if has_ended:
                self._disconnect("the platform has ended")
        self._publish_due(time.monotonic_ns())

    def close(self) -> None:
        """Close the records."""
        if self._feed is not None:
            self._feed.close()
            self._feed = None

    def _connect(self) -> None:
        try:
            feed = self._open()
        except NotRunning as error:
            self._why = error.message
            return
        self._last, self._level, self._measured_ns, self._joints_ns, self._channels_ns = None, (), 0, 0, 0
        self._feed, self._names = feed, tuple(joint.name for joint in feed.config.joints)
        names = {process.name for process in feed.config.processes if process.STATES is not None}
        states = [field.name for field in feed.schema.fields if field.part in names and field.local_name == "state"]
        self._changes = (*_CHANGES, *states)
        self._measures_velocity, self._measures_effort = map(feed.config.measures, ("velocity", "torque"))
        self._sink.connected(feed.config)
        if feed.config.processes:
            self._sink.serve(services_of(feed.config))

    def _disconnect(self, why: str) -> None:
        self.close()
        self._why, self._last, self._status_ns = why, None, 0

    def _follow(self, feed: Feed, records: Records) -> None:
        """Publish the samples that are due and each change of the status."""
        ahead_ns, half_cycle = _ahead_ns(), feed.period_ns // 2
        is_whole = records["wkc"] == records["wkc_expected"]
        levels = zip(*(records[name].tolist() for name in self._changes), strict=True)
        for at, (instant, whole, level) in enumerate(
            zip(records["time_ns"].tolist(), is_whole.tolist(), levels, strict=True)
        ):
            if whole:
                self._measured_ns = instant
                if self._names and instant >= self._joints_ns - half_cycle:
                    # One period after this sample was due, so that the rate is kept; after a pause one from now.
                    due = self._joints_ns + self._period_ns
                    self._joints_ns = due if due > instant else instant + self._period_ns
                    self._sink.joints(self._names, self._sample(records[at], instant + ahead_ns))
                if feed.channels and instant >= self._channels_ns:
                    self._channels_ns = instant + _STATUS_NS
                    self._sink.channels(_channels(feed, records[at], instant + ahead_ns))
            if level != self._level:
                self._level = level
                self._publish_status(feed, records[at], instant, ahead_ns)
        if len(records):
            self._last = records[-1]

    def _sample(self, record: Any, stamp_ns: int) -> JointSample:
        def numbers(name: str, is_measured: bool = True) -> Numbers:
            return tuple(record[name].tolist()) if is_measured else ()

        return JointSample(
            stamp_ns,
            numbers("actual_position"),
            numbers("actual_velocity", self._measures_velocity),
            numbers("actual_torque", self._measures_effort),
            numbers("commanded_position"),
            int(record["tool"]),
        )

    def _publish_due(self, now_ns: int) -> None:
        """Publish the status again, and the diagnostics."""
        feed, record, ahead_ns = self._feed, self._last, _ahead_ns()
        is_known = feed is not None and record is not None and now_ns - int(record["time_ns"]) < _STALE_NS
        if now_ns >= self._status_ns:
            if feed is not None and is_known:
                self._publish_status(feed, record, int(record["time_ns"]), ahead_ns)
            else:
                self._status_ns = now_ns + _STATUS_NS
                self._sink.status(RobotStatus(now_ns + ahead_ns))
        if now_ns >= self._diagnostics_ns:
            self._diagnostics_ns = now_ns + _DIAGNOSTICS_NS
            if feed is None or not is_known:
                why = self._why if feed is None else "the loop publishes no cycles"
                self._sink.diagnostics(Diagnostics(now_ns + ahead_ns, 3, why, (("connected", "false"),)))
            else:
                self._sink.diagnostics(_diagnostics(feed, record, ahead_ns))

    def _publish_status(self, feed: Feed, record: Any, instant: int, ahead_ns: int) -> None:
        self._status_ns = instant + _STATUS_NS
        is_held = feed.holder not in ("", self._name)
        age_ns = instant - self._measured_ns
        self._sink.status(robot_status(record, age_ns, instant + ahead_ns, is_held))
        if feed.config.processes:
            self._sink.processes(_processes(feed, record, instant + ahead_ns))


def _ahead_ns() -> int:
    """Return CLOCK_REALTIME minus CLOCK_MONOTONIC, ns: of three readings the one with the least delay."""
    readings = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(3)]
    before, wall, after = min(readings, key=lambda reading: reading[2] - reading[0])
    return wall - (before + after) // 2


def _channels(feed: Feed, record: Any, stamp_ns: int) -> ChannelSample:
    values: dict[str, dict[str, float]] = {}
    for item in feed.channels:
        if not math.isnan(value := float(item.value(record))):
            values.setdefault(item.slave, {})[item.local_name] = value
    return ChannelSample(stamp_ns, values, [(item.slave, item.local_name) for item in feed.channels if item.settable])


def _processes(feed: Feed, record: Any, stamp_ns: int) -> dict[str, Diagnostics]:
    entries = {}
    for process in feed.config.processes:
        fields = [field for field in feed.schema.fields if field.part == process.name]
        values = {field.local_name: str(record[field.name]) for field in fields}
        words = "" if process.STATES is None else process.state_in_words(int(values["state"]))
        level = 2 if State(record["state"]) in _IN_ERROR else 0
        entries[process.name] = Diagnostics(stamp_ns, level, words, tuple(values.items()))
    return entries


def _diagnostics(feed: Feed, record: Any, ahead_ns: int) -> Diagnostics:
    state = State(record["state"])
    level = 2 if state in _IN_ERROR else 0
    if not level and record["wkc"] != record["wkc_expected"]:
        level = 1
    values = {
        "connected": "true",
        "state": state.words,
        "commander": feed.holder,
        "working counter": f"{record['wkc']} of {record['wkc_expected']}",
        "cycles without an answer": str(record["lost"]),
        "ticks skipped": str(record["missed"]),
        "error code": str(record["fault"] or record["limit"]),
    }
    # Processes, and slaves that the platform knows by their channels alone.
    parts = {process.name for process in feed.config.processes}
    parts |= {slave.name for slave in feed.config.slaves if slave.device.has_channels}
    for field in feed.schema.fields:
        if field.part in parts:
            unit = f" {field.unit}" if field.unit else ""
            values[f"{field.part} {field.local_name}"] = f"{record[field.name]}{unit}"
    return Diagnostics(int(record["time_ns"]) + ahead_ns, level, state.words, tuple(values.items()))
