"""The bench: a platform that runs, its segment to be broken, and all by which is told what happens to the arm."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from rtcp.config.model import ArmConfig
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.machine import State
from rtcp.ipc.messages import Sentences
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, segment_control
from rtcp.ipc.session import read_session
from rtcp.telemetry.steps import target_steps
from rtcp.virtual.faults.client import SegmentClient

POLL_S = 0.02
STILL_S = 0.25
"""A joint that has not moved for so long stands."""
_LONGEST_STOP_S = 10.0
_RESETS, _RESET_PAUSE_S = 5, 1.0
_MOVES, _SPEED = 3, 0.4
NAME = "a trial"


@dataclass(frozen=True)
class Mark:
    """A moment: what came after it is asked for by it."""

    time_ns: int
    event: int
    text: int


class TrialFailed(Exception):
    """The platform does not do what a trial cannot go on without: a sentence."""


class Bench:
    """Asks a platform and its segment, and follows every cycle.

    Args:
        directory: the platform's runtime directory.
        config: the arm.
    """

    def __init__(self, directory: Path, config: ArmConfig) -> None:
        self.directory = directory
        self.config = config
        self.client = ControlClient(NAME, control_socket(directory))
        self.segment = SegmentClient(_segment_socket(directory))
        self.observer = Observer(blackboard_file(directory))
        # The segment watches its joints from the first question on.
        self.segment.clear_peaks()
        self._sentences = Sentences(config)
        self._speeds = np.array([joint.velocity for joint in config.joints])
        self._seen = self.observer.head
        self._last: Any = None
        self.injected = 0
        """Faults made."""
        self.records = 0
        """Cycle records read."""
        self.torn = 0
        """Cycle records that could not be read: torn, or overwritten before they were."""
        self.wrong = 0
        """Cycles without the expected working counter."""
        self.largest_step = 0.0
        """Of any joint's target from one cycle to the next while enabled, as a part of what its speed limit allows."""

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:  # fmt: skip
        self.close()

    def close(self) -> None:
        """Let go of the platform."""
        self.client.close()
        self.segment.close()
        self.observer.close()

    # -- what is seen -------------------------------------------------------------------------------------------

    def follow(self) -> None:
        """Read the cycles since the last call; to be called at least every few seconds."""
        found, torn = self.observer.since(self._seen)
        self.torn += torn
        if not len(found):
            return
        self._seen = int(found[-1]["number"])
        self.records += len(found)
        self.wrong += int((found["wkc"] != found["wkc_expected"]).sum())
        joined = found if self._last is None else np.concatenate([self._last, found])
        self._last = found[-1:].copy()
        _, steps = target_steps(joined)
        if len(steps):
            allowed = self._speeds * self.observer.period_ns * 1e-9
            self.largest_step = max(self.largest_step, float((steps / allowed).max()))

    def state(self) -> str:
        """Return the machine's state as `rtcp status` names it."""
        self.follow()
        latest = self.observer.latest()
        return "off" if latest is None else State(int(latest[0]["state"])).name.lower()

    def speed(self) -> float:
        """Return the speed of the fastest joint as the master measures it, rad/s."""
        latest = self.observer.latest()
        return 0.0 if latest is None else float(np.abs(latest[0]["velocity"]).max())

    def mark(self) -> Mark:
        """Return this moment."""
        events, texts = self.observer.events_since(0), self.observer.texts_since(0)
        return Mark(
            time.monotonic_ns(), events[-1].number if events else 0, texts[-1].number if texts else 0
        )  # fmt: skip

    def said_since(self, mark: Mark) -> list[str]:
        """Return what the platform has said since, in its order."""
        said = [
            (event.time_ns, self._sentences.event(event.code, event.axis, event.value, event.limit))
            for event in self.observer.events_since(mark.event)
        ]
        said += [(text.time_ns, text.sentence) for text in self.observer.texts_since(mark.text)]
        return [sentence for _, sentence in sorted(said)]

    def until(self, met: Callable[[], bool], patience_s: float) -> bool:
        """Wait until `met`, at most so long; return whether it came."""
        end = time.monotonic() + patience_s
        while not met():
            if time.monotonic() > end:
                return False
            self.follow()
            time.sleep(POLL_S)
        return True

    def moved_ns(self) -> int:
        """Return the last instant at which any joint truly moved (ns, CLOCK_MONOTONIC), as the segment knows it."""
        return max((slave["moved_ns"] for slave in self.segment.truth()["slaves"] if "moved_ns" in slave), default=0)

    def drives(self) -> list[dict[str, Any]]:
        """Return what the segment knows of each joint's drive: position, whether it has torque."""
        found = {slave["position"]: slave for slave in self.segment.truth()["slaves"]}
        places = {slave.name: at for at, slave in enumerate(self.config.slaves, 1)}
        return [found[places[joint.slave]] for joint in self.config.joints]

    def until_still(self) -> int:
        """Wait until every joint truly stands; return the last instant at which one moved.

        Raises:
            TrialFailed: one still moves after 10 s.
        """
        still_ns = round(STILL_S * 1e9)
        if not self.until(lambda: time.monotonic_ns() - self.moved_ns() > still_ns, _LONGEST_STOP_S):
            raise TrialFailed(f"a joint still moves {_LONGEST_STOP_S:g} s after the fault")
        return self.moved_ns()

    # -- what is done -------------------------------------------------------------------------------------------

    def fault(self, fault: Mapping[str, Any]) -> None:
        """Make a fault; raises SegmentRefused, SegmentAway."""
        self.segment.fault(fault)
        self.injected += 1

    def call(self, verb: str, /, **arguments: Any) -> dict[str, Any]:
        """Ask the platform; raises RtcpError."""
        return self.client.call(verb, arguments, timeout_s=60.0)

    def bring_up(self) -> tuple[int, str]:
        """Reset until the machine is ready, enable, hold.

        Returns:
            How many resets it took, and the sentence of the last refusal (empty when the arm holds).
        """
        sentence = ""
        for number in range(1, _RESETS + 1):
            try:
                if self.state() in ("fault", "emergency_stop", "stopped_by_limit"):
                    self.call("reset")
                if self.state() != "holding":
                    self.call("enable")
            except RtcpError as error:
                sentence = error.message
                self.until(lambda: False, _RESET_PAUSE_S)
                continue
            return number, ""
        return _RESETS, sentence

    def stand_at(self, q: Sequence[float]) -> None:
        """Move to `q`, rad, in mode joint; raises TrialFailed where the arm cannot be brought there."""
        sentence = self.move(q)
        if sentence:
            raise TrialFailed(f"the arm cannot be brought to where a trial begins: {sentence}")

    def move(self, q: Sequence[float]) -> str:
        """Move to `q`, rad, in mode joint; return why that was not possible, empty where it was.

        It is tried again: on a host that holds the gateway up for longer than `lease_s` a move ends, as it must.
        """
        sentence = ""
        for _ in range(_MOVES):
            _, sentence = self.bring_up()
            if sentence:
                break
            try:
                self.call("motion", name="joint")
                self.call("move", q=list(q), speed=_SPEED)
            except RtcpError as error:
                sentence = error.message
                continue
            return ""
        return sentence


def _segment_socket(directory: Path) -> Path:
    """Return where the platform's own segment is asked: another one may have the usual place."""
    return read_session(directory).segment_control or segment_control(directory)
