"""A running platform with its segment, for fault injection: commands, faults, and every later cycle."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtcp.api import Robot, RtcpError, State
from rtcp.config.model import ArmConfig
from rtcp.ipc.names import Names
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, segment_control
from rtcp.ipc.session import read_session
from rtcp.telemetry.reading import target_steps
from rtcp.virtual.faults.control import SegmentClient

CLIENT_NAME = "a trial"
_POLL_S = 0.02
_STANDSTILL_S = 0.25
"""A joint that has not moved for this long is at standstill."""
_STOP_TIMEOUT_S = 10.0
_RESETS, _RESET_PAUSE_S = 5, 1.0
_MOVES, _SPEED = 3, 0.4


class TrialFailed(Exception):
    """The platform does not reach a condition of a trial; the message names it."""


class Harness:
    """Commands a platform and its segment, and reads every cycle record.

    Args:
        directory: the platform's runtime directory.
        config: the arm.
    """

    def __init__(self, directory: Path, config: ArmConfig) -> None:
        self.directory = directory
        self.config = config
        self.robot = Robot(CLIENT_NAME, control_socket(directory))
        # The socket is in the session: another segment may have the default one.
        self.segment = SegmentClient(read_session(directory).segment_control or segment_control(directory))
        self.observer = Observer(blackboard_file(directory))
        self._names = Names(config)
        self._speeds = np.array([joint.velocity for joint in config.joints])
        self._seen = self.observer.head
        self._last: Any = None
        self.injected = 0
        """Faults injected."""
        self.records = 0
        """Cycle records read."""
        self.torn = 0
        """Cycle records that were torn, or overwritten before they were read."""
        self.wrong = 0
        """Cycles without the expected working counter."""
        self.largest_step = 0.0
        """Largest step of a target between cycles with enabled drives, as a fraction of its speed limit's step."""

    def __enter__(self) -> Harness:
        self.segment.clear_peaks()  # the segment observes its joints from the first request on
        return self

    def __exit__(self, *_: object) -> None:
        self.robot.close()
        self.segment.close()
        self.observer.close()

    # -- observation ------------------------------------------------------------------------------------------------

    def read_cycles(self) -> None:
        """Read the cycles since the last call; must be called every few seconds."""
        records, torn = self.observer.since(self._seen)
        self.torn += torn
        if not len(records):
            return
        self._seen = int(records[-1]["number"])
        self.records += len(records)
        self.wrong += int((records["wkc"] != records["wkc_expected"]).sum())
        joined = records if self._last is None else np.concatenate([self._last, records])
        self._last = records[-1:].copy()
        _, steps = target_steps(joined)
        if len(steps):
            allowed = self._speeds * self.observer.period_ns * 1e-9
            self.largest_step = max(self.largest_step, float((steps / allowed).max()))

    def state(self) -> State:
        """Return the machine's state."""
        self.read_cycles()
        latest = self.observer.latest()
        return State.OFF if latest is None else State(int(latest[0]["state"]))

    def speed(self) -> float:
        """Return the measured speed of the fastest joint, rad/s."""
        latest = self.observer.latest()
        return 0.0 if latest is None else float(np.abs(latest[0]["actual_velocity"]).max())

    def moment(self) -> int:
        """Return the number of the last event, the argument of `messages_since`."""
        return self.observer.last_event

    def messages_since(self, moment: int) -> list[str]:
        """Return the platform's messages since a moment, in order."""
        return [self._names.message(record.event) for record in self.observer.events_since(moment)]

    def wait_for(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition while reading cycles; return whether it was met in time."""
        end = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end:
                return False
            self.read_cycles()
            time.sleep(_POLL_S)
        return True

    def wait(self, seconds: float) -> None:
        """Wait while reading cycles."""
        self.wait_for(lambda: False, seconds)

    def drives(self) -> list[dict[str, Any]]:
        """Return the segment's ground truth of each joint's drive, as `position_rad`, `torque_on`."""
        by_position = {slave["position"]: slave for slave in self.segment.truth()["slaves"]}
        positions = {slave.name: at for at, slave in enumerate(self.config.slaves, 1)}
        slaves = [(by_position[positions[joint.slave]], joint.axis) for joint in self.config.joints]
        return [slave["axes"][axis - 1] if "axes" in slave else slave for slave, axis in slaves]

    def joint_positions(self) -> list[float]:
        """Return the true joint positions, rad."""
        return [drive["position_rad"] for drive in self.drives()]

    def wait_standstill(self) -> int:
        """Wait until every joint is truly at standstill; return when the last one stopped, ns of CLOCK_MONOTONIC.

        Raises:
            TrialFailed: a joint still moves after 10 s.
        """

        def moved_ns() -> int:
            drives = (axis for slave in self.segment.truth()["slaves"] for axis in slave.get("axes", [slave]))
            return max((drive["moved_ns"] for drive in drives if "moved_ns" in drive), default=0)

        standstill_ns = round(_STANDSTILL_S * 1e9)
        if not self.wait_for(lambda: time.monotonic_ns() - moved_ns() > standstill_ns, _STOP_TIMEOUT_S):
            raise TrialFailed(f"a joint still moves {_STOP_TIMEOUT_S:g} s after the fault")
        return moved_ns()

    # -- commands ---------------------------------------------------------------------------------------------------

    def inject(self, fault: Mapping[str, Any]) -> None:
        """Inject a fault; raises RequestRefused, ServerAway."""
        self.segment.fault(fault)
        self.injected += 1

    def enable(self) -> tuple[int, str]:
        """Reset and enable until the arm holds.

        Returns:
            The number of attempts, and the last refusal (empty when the arm holds).
        """
        refusal = ""
        for attempt in range(1, _RESETS + 1):
            try:
                if self.state() in (State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT):
                    self.robot.reset()
                if self.state() is not State.HOLDING:
                    self.robot.enable()
            except RtcpError as error:
                refusal = error.message
                self.wait(_RESET_PAUSE_S)
                continue
            return attempt, ""
        return _RESETS, refusal

    def move(self, q: Sequence[float]) -> str:
        """Enable and move to `q`, rad; return the refusal, empty after success.

        Repeats, as a host that delays the gateway for longer than `lease_s` ends a move.
        """
        refusal = ""
        for _ in range(_MOVES):
            _, refusal = self.enable()
            if refusal:
                break
            try:
                self.robot.mode("joint")
                self.robot.move_joints(q, _SPEED)
            except RtcpError as error:
                refusal = error.message
                continue
            return ""
        return refusal
