"""The status of the running platform for `rtcp status`, from the blackboard."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from kinematics.forward import frames
from kinematics.jacobian import singularity_distances
from rtcp.config.model import PLATFORM_PARTS
from rtcp.ipc.codes import state_name
from rtcp.ipc.events import JOYSTICK_MODES, ResetDone, ServiceEvent, severity
from rtcp.ipc.names import SINGULARITIES, Names
from rtcp.ipc.observer import EventRecord, Observer
from rtcp.ipc.robot_status import RobotStatus
from rtcp.ipc.schema import (
    FLAG_ARM_HAS_JOYSTICK,
    FLAG_DC_LOCKED,
    HELD_BOX_AT,
    HELD_RANGE_AT,
    HELD_SHOULDER,
    HELD_SPEED_AT,
    PER_JOINT,
    identifier,
)
from rtcp.ipc.session import Processes, Session, is_running
from rtcp.ipc.states import ControlMode, DriveMode, DriveState, State
from rtcp.ipc.tool_motion import ToolMotion
from rtcp.motion.controllers.jog_bounds import held_zone
from rtcp.motion.guards.zones import Zones, is_cone, reported
from rtcp.motion.limits import Limits
from rtcp.realtime.statistics import Percentiles, SlidingPercentiles, diagnose

_MESSAGES = 50
_SHOWN = 10
"""Number of messages in the status."""
_SILENT_S = 1.0
_SECOND_NS = 1_000_000_000
_UNDER_WAY = (int(State.MOVING), int(State.STOPPING))
_FIGURES = {"wakeup": "wakeup_ns", "exchange": "exchange_ns", "compute": "compute_ns", "offset": "dc_offset_ns",
            "filtered": "dc_filtered_ns"}  # fmt: skip

_SECOND = ("cycles", "unanswered", "incomplete", "tracked")
"""Counts of cycles in the last second: all, without an answer, with a working counter other than expected, with an
answer and a locked clock."""


class StatusSnapshot:
    """Reads the blackboard: statistics of the cycle, the last messages, the fault.

    Args:
        observer: the blackboard.
        session: the running platform.
        started: facts of the start that the loop reported (realtime, start to OP).
    """

    def __init__(self, observer: Observer, session: Session, started: dict[str, Any]) -> None:
        self._observer = observer
        self._session = session
        self._started = started
        self.names = Names(session.config, session.partners)
        self.limits = Limits(session.config)
        """Limits in force."""
        self._tool = None if session.config.arm is None else ToolMotion(session.config.models, observer.schema)
        self._at = max(observer.head - 1, 0)
        self._event = 0
        self._figures = {name: SlidingPercentiles() for name in _FIGURES}
        self._recent: deque[tuple[int, npt.NDArray[np.int64], int]] = deque()
        """For each batch of the last second: instant of its last cycle, ns; counts in the order of `_SECOND`; working
        counter of its last answer, -1: none."""
        self._enables = 0
        self.fault = ""
        """Message of the present fault."""
        self.last_fault = ""
        self.message = ""
        """The last message about the arm."""
        self._message_ns = 0
        """Instant of `message`, CLOCK_MONOTONIC, ns: the wall clock may be set."""
        self._moves = 0
        self._moving = False
        self._began_ns = 0
        """Begin of the last motion, CLOCK_MONOTONIC, ns."""
        self.messages: deque[tuple[int, str]] = deque(maxlen=_MESSAGES)
        self.loop_lives = True

    # -- following ----------------------------------------------------------------------------------------------------

    def follow(self) -> list[str]:
        """Read new records and events; return the messages since the last call."""
        records, _ = self._observer.since(self._at)
        if len(records):
            self._at = int(records[-1]["number"])
            self._count(records)
            self._note_motion(records)
        return self._read_messages()

    def note(self, message: str) -> None:
        """Add a message of the gateway."""
        self.messages.append((time.time_ns(), message))

    def _count(self, records: npt.NDArray[np.void]) -> None:
        self._note_answers(records)
        now = time.monotonic()
        if int(records[-1]["enables"]) != self._enables:
            self._enables = int(records[-1]["enables"])
            for figure in self._figures.values():
                figure.reset()
            records = records[records["enables"] == self._enables]
        for name, field in _FIGURES.items():
            self._figures[name].add(now, np.abs(records[field]) / 1e3 if "dc" in field else records[field] / 1e3)

    def _note_answers(self, records: npt.NDArray[np.void]) -> None:
        """Count complete and incomplete answers, and cycles with a locked clock."""
        wkc, answered = records["wkc"], records["wkc"] >= 0
        incomplete = answered & (wkc != records["wkc_expected"])
        tracked = answered & (records["flags"] & FLAG_DC_LOCKED != 0)
        counts = [len(records), *map(np.count_nonzero, (~answered, incomplete, tracked))]
        last = int(wkc[answered][-1]) if answered.any() else -1
        self._recent.append((int(records["time_ns"][-1]), np.array(counts), last))

    def _last_second(self) -> tuple[dict[str, int], int]:
        """Return the counts of the last second by name, and the working counter of its last answer, -1: none."""
        while self._recent and self._recent[0][0] < time.monotonic_ns() - _SECOND_NS:
            self._recent.popleft()
        counts = sum((batch for _, batch, _ in self._recent), np.zeros(len(_SECOND), dtype=np.int64))
        last = next((counter for _, _, counter in reversed(self._recent) if counter >= 0), -1)
        return dict(zip(_SECOND, map(int, counts), strict=True)), last

    def _note_motion(self, records: npt.NDArray[np.void]) -> None:
        """Note the last cycle in which a motion began, from rest or in place of another."""
        moving, moves = np.isin(records["state"], _UNDER_WAY), records["moves"].astype(np.int64)
        rested = ~np.concatenate([[self._moving], moving[:-1]])
        replaced = moves != np.concatenate([[self._moves], moves[:-1]])
        begun = np.flatnonzero(moving & (rested | replaced))
        if len(begun):
            self._began_ns = int(records["time_ns"][begun[-1]])
        self._moving, self._moves = bool(moving[-1]), int(moves[-1])

    def _read_messages(self) -> list[str]:
        new: list[str] = []
        for record in self._observer.events_since(self._event):
            self._event, event = record.number, record.event
            message = self.names.message(event)
            new.append(message)
            self.messages.append((record.time_ns, message))
            if not isinstance(event, ServiceEvent) or event.is_problem:
                self.message, self._message_ns = message, record.monotonic_ns
            if type(event) in self.names.faults:
                # An emergency stop during a fault must be ended first.
                self.fault = message if event.is_emergency else self.fault or message
                self.last_fault = message
            elif isinstance(event, ResetDone):
                self.fault = ""
        return new

    # -- showing ------------------------------------------------------------------------------------------------------

    def event(self, record: EventRecord) -> dict[str, Any]:
        """Return an event as JSON."""
        return {
            "number": record.number,
            "time": _iso(record.time_ns),
            "name": record.event.name,
            "fields": record.event.as_json(),
            "message": self.names.message(record.event),
            "severity": severity(type(record.event)),
        }

    def _limited_by(self, record: npt.NDArray[np.void]) -> dict[str, str]:
        """Return the limits that keep the motion below the commanded velocity: a sentence under the name of each."""
        held, q = int(record["held"]), [float(value) for value in record["commanded_position"]]
        names, models, limits = self.names, self._session.config.models, {}
        low, high = self.limits.low, self.limits.high
        for axis in (axis for axis in range(len(q)) if held >> axis & 1):
            name = names.joint(axis)
            limits[name] = f"a guard cuts the target of {name} (limits of {names.key(axis)} in {names.file})"
        if (axis := (held >> HELD_SPEED_AT & 15) - 1) >= 0:
            name, speed = names.joint(axis), self.limits.velocity[axis]
            limits[f"{name} speed"] = (
                f"{name} moves at its speed limit, {speed:g} rad/s ({names.key(axis)}.velocity in {names.file})"
            )
        if (axis := (held >> HELD_RANGE_AT & 15) - 1) >= 0:
            name, end = names.joint(axis), low[axis] if q[axis] - low[axis] < high[axis] - q[axis] else high[axis]
            limits[f"{name} range"] = (
                f"{name} is {abs(end - q[axis]):.4f} rad from the end of its range, {end:g} rad "
                f"({names.key(axis)}.position in {names.file})"
            )
        if not models:
            return limits
        model = models[int(record["tool"])]
        distances = singularity_distances(model, q)
        for which, (name, unit) in enumerate(SINGULARITIES):
            if held & HELD_SHOULDER << which:
                least = getattr(self._session.config.cartesian.singularity, name)
                limits[name] = (
                    f"the {name} is {distances[which] or 0.0:.3f} {unit} from its singularity, limit {least:g} {unit} "
                    f"(cartesian.singularity.{name} in {names.file}): jog away from it, or jog joints"
                )
        if (box := (held >> HELD_BOX_AT) - 2) >= -1:
            clearance = self._session.config.cartesian.clearance
            near = Zones(model, self.limits, clearance).clearances(frames(model, q), math.inf)
            nearest = ((each.zone, each.distance) for each in near if held_zone(each.zone) == box)
            zone, distance = next(nearest, (box, 0.0))
            unit = "rad" if is_cone(zone) else "m"
            limits["box"] = f"the arm is {reported(zone, distance):.3f} {unit} from {names.box(zone)}"
        return limits

    def _headline(self, state: State, limits: dict[str, str], paused: bool) -> str:
        """Return the reason of a fault, else the last message; during a motion none of an earlier one."""
        if self.fault or int(state) not in _UNDER_WAY:
            return self.fault or self.message
        if paused:
            return "paused: the motion rests on its path"
        if self._message_ns > self._began_ns:
            return self.message
        return f"{state.words}, limited: {'; '.join(limits.values())}" if limits else state.words

    def _loop_problem(self, silent_s: float) -> str:
        """Return the problem of the loop's process; empty: it publishes."""
        loop = f"the loop (process {self._observer.loop_pid})"
        way_out = "the drives' watchdog stops them: `rtcp stop`, then `rtcp start`"
        if not self.loop_lives:
            return f"{loop} ended unexpectedly; {way_out}"
        if silent_s > _SILENT_S:
            return f"{loop} has published nothing for {silent_s:.1f} s; {way_out}, if it stays so"
        return ""

    def _slaves(self) -> list[dict[str, Any]]:
        if "states" in self._session.config.bus.LACKS:
            return []
        slaves = self._session.config.slaves
        rows = zip(slaves, self._observer.slaves(len(slaves)), self._observer.health(len(slaves)), strict=True)
        return [
            {
                "position": position,
                "name": slave.name,
                "state": state_name(al) if self.loop_lives else "unknown",
                "al_status_code": code,
                "lost": health.lost,
                "recovered": health.recovered,
                "temperature": None if math.isnan(health.temperature) else round(health.temperature, 1),
                "errors": {"rx": health.rx, "forwarded": health.forwarded, "links": health.links},
            }
            for position, (slave, (al, code), health) in enumerate(rows, 1)
        ]

    def _tool_motion(self, record: np.void) -> dict[str, list[float]] | None:
        """Return measured pose, velocity and commanded pose of the tool, m and rad; None without geometry."""
        if self._tool is None:
            return None
        q = np.stack([record["actual_position"], record["commanded_position"]])
        poses, velocities = self._tool.of(q, np.stack([record["actual_velocity"]] * 2), np.stack([record["tool"]] * 2))
        motion = {"pose": poses[0], "velocity": velocities[0], "commanded_pose": poses[1]}
        return {name: [round(number, 7) for number in values.tolist()] for name, values in motion.items()}

    def _devices(self, record: np.void) -> dict[str, dict[str, dict[str, Any]]]:
        """Return value and unit of the fields of each slave that is no drive, by slave and field."""
        devices: dict[str, dict[str, dict[str, Any]]] = {name: {} for name in self._session.config.boxes}
        others = PLATFORM_PARTS | {axis.name for axis in self._session.config.external_axes}
        for field in self._observer.schema.fields:
            if field.part in others:
                continue
            value = record[field.name].tolist()
            numbers = value if field.shape else [value]
            known = [number if math.isfinite(number) else None for number in numbers]  # JSON has no others
            entry = {"value": known if field.shape else known[0], "unit": field.unit}
            devices.setdefault(field.part, {})[field.local_name] = entry
        return devices

    def _axes(self, record: np.void) -> dict[str, dict[str, Any]]:
        """Return unit, measurements and state of each external axis, by name."""
        axes = {}
        for axis in self._session.config.external_axes:
            part = identifier(axis.name)
            axes[axis.name] = {
                "unit": axis.unit,
                "position": round(float(record[f"{part}_actual_position"]), 7),
                "velocity": round(float(record[f"{part}_actual_velocity"]), 7),
                "target_position": round(float(record[f"{part}_target_position"]), 7),
                "target_velocity": round(float(record[f"{part}_target_velocity"]), 7),
                "mode": int(record[f"{part}_mode"]),
                "drive_state": DriveState(int(record[f"{part}_drive_state"])).words,
                "moving": bool(record[f"{part}_moving"]),
                "homed": bool(record[f"{part}_homed"]),
            }
        return axes

    def _processes(self, record: np.void) -> dict[str, dict[str, Any]]:
        """Return kind, state in words, and names of the commands of each process, by name."""
        processes: dict[str, dict[str, Any]] = {}
        for process in self._session.config.processes:
            words = None
            if process.STATES is not None:
                words = process.state_in_words(int(record[f"{identifier(process.name)}_state"]))
            commands = [command.name for command in process.COMMANDS]
            processes[process.name] = {"kind": process.kind, "state": words, "commands": commands}
        return processes

    def _skipped_ticks(self, cycles: int, missed: int, figures: Mapping[str, Percentiles]) -> dict[str, Any] | None:
        """Return cause and remedy if the loop skips too many ticks, else None."""
        wakeup, exchange, compute = (figures[name] for name in ("wakeup", "exchange", "compute"))
        cause = diagnose(self._observer.period_ns * 1e-3, cycles, missed, wakeup, exchange, compute)
        if cause is None:
            return None
        return {"share": cause.share, "part": cause.part.value, "message": cause.message, "remedy": cause.remedy}

    def status(self, processes: Processes, goal: Sequence[float] | None) -> dict[str, Any]:
        """Return the whole status, as `rtcp status --json` prints it; `goal`: of the motion under way, rad."""
        latest = self._observer.latest()
        if latest is None:
            raise RuntimeError("the loop has published no cycle yet")
        record = latest[0]
        state, control_mode, flags = State(int(record["state"])), int(record["control_mode"]), int(record["flags"])
        problem = self._loop_problem((time.monotonic_ns() - int(record["time_ns"])) * 1e-9)
        lost_s = int(record["lost"]) * self._observer.period_ns * 1e-9
        robot = RobotStatus.lost() if problem else RobotStatus.of_record(record, lost_s)
        figures = {name: figure.read() for name, figure in self._figures.items()}
        newest = list(self.messages)[-_SHOWN:]
        last_second, wkc = self._last_second()
        limits = self._limited_by(record) if state is State.MOVING else {}
        return {
            "state": "fault" if problem else state.name.lower(),
            "message": problem or self._headline(state, limits, not record["speed_override"]),
            "limited_by": limits,
            "drive_mode": _name(DriveMode, int(record["drive_mode"])),
            "control_mode": _name(ControlMode, control_mode),
            "speed_override": float(record["speed_override"]),
            "tool_name": self.names.tool(int(record["tool"])),
            "payload": {
                "mass": float(record["payload_mass"]),
                "centre": [float(record[f"payload_{axis}"]) for axis in "xyz"],
            },
            "joystick": None
            if self._session.config.inputs.joystick is None
            else {
                "mode": JOYSTICK_MODES[int(record["joystick_mode"]) % len(JOYSTICK_MODES)],
                "controls_arm": bool(flags & FLAG_ARM_HAS_JOYSTICK),
            },
            "robot": dataclasses.asdict(robot),
            "bus": self._session.bus,
            "bus_kind": self._session.config.bus.kind,
            "lacks": dict(self._session.config.bus.LACKS),
            "cycle_ns": self._observer.period_ns,
            "cycles": int(record["cycle"]),
            "time_ns": int(record["time_ns"]),
            "missed": int(record["missed"]),
            "skipped_ticks": self._skipped_ticks(int(record["cycle"]), int(record["missed"]), figures),
            "lost_s": round(lost_s, 3),
            "wkc": {"expected": int(record["wkc_expected"]), "actual": -1 if problem else wkc},
            "last_second": last_second,
            "slaves": self._slaves(),
            "joint_names": [joint.name for joint in self._session.config.joints],
            "joints": {
                name: [round(float(value), 7) for value in record[name]]
                for name in PER_JOINT
                if record[name].dtype.kind == "f"
            },
            "tool": self._tool_motion(record),
            # An arm that stops no longer has a goal.
            "goal": None
            if goal is None or problem or state is not State.MOVING
            else [round(value, 7) for value in goal],
            "drive_states": [DriveState(state).words for state in record["drive_state"].tolist()],
            "statuswords": [int(word) for word in record["statusword"]],
            "axes": self._axes(record),
            "devices": self._devices(record),
            "processes": self._processes(record),
            "wakeup_us": figures["wakeup"].as_json(),
            "exchange_us": figures["exchange"].as_json(),
            "compute_us": figures["compute"].as_json(),
            "dc": None
            if "clocks" in self._session.config.bus.LACKS
            else {
                "locked": not problem and bool(flags & FLAG_DC_LOCKED),
                "offset_ns": int(record["dc_offset_ns"]),
                "filtered_ns": int(record["dc_filtered_ns"]),
                "offset_us": figures["offset"].as_json(),
                "filtered_us": figures["filtered"].as_json(),
            },
            "realtime": self._started.get("realtime", {}),
            "start_to_op_s": self._started.get("start_to_op_s"),
            "lease": {"holder": self._observer.holder()},
            "pids": {
                "loop": processes.loop if self.loop_lives else 0,
                "gateway": processes.gateway,
                "segment": processes.segment if is_running(processes.segment) else 0,
            },
            "messages": [message for _, message in newest],
            "message_times": [_iso(at) for at, _ in newest],
        }


def _name(kind: type[ControlMode] | type[DriveMode], number: int) -> str:
    return next((member.name.lower() for member in kind if member == number), str(number))


def _iso(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9).astimezone().isoformat(timespec="milliseconds")
