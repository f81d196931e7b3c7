"""What the arm is doing when something breaks: it holds, moves in joint mode, is jogged, or is led by the stick."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import control_socket
from rtcp.telemetry.trials.bench import NAME, Bench, TrialFailed

START = (0.0, 0.2, 1.57, 0.0, 0.4, 0.0)
"""rad; away from every limit and singularity: jogs along each axis are possible from here."""
_SWING = (0.35, 0.25, -0.25, 0.35, 0.35, 0.35)
"""rad, from `START`: what a moving arm goes to and fro."""
_SPEED = 0.4
_JOG_M_S, _TURN_S = 0.06, 1.2
_SAY_AGAIN_S, _HOLD_S = 0.05, 0.25
_STICK_HOLD_S = 0.5
_NEUTRAL = 63


class Activity:
    """Something that a thread of its own keeps asking of the arm, until it is told to end or is refused."""

    name = "holding"
    motion = "joint"
    """The motion mode that it needs."""
    moves = False

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.refusal = ""
        """What ended it, where it was not told to end."""

    def begin(self, bench: Bench) -> None:
        """Begin; return when the arm moves, where it is to.

        Raises:
            TrialFailed: it is refused, or the arm does not move.
        """
        if self.motion != "joint":
            try:
                bench.call("motion", name=self.motion)
            except RtcpError as error:
                raise TrialFailed(f"{self.name} cannot begin: {error.message}") from error
        if not self.moves:
            return
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        if not bench.until(lambda: bench.speed() > 0.03 or bool(self.refusal), 10.0) or self.refusal:
            raise TrialFailed(f"{self.name} did not begin: {self.refusal or 'nothing moved for 10 s'}")
        # Well into the motion: past the ramp.
        bench.until(self._ended.is_set, 0.3)

    def end(self) -> None:
        """End, and wait until its connection is closed."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join(timeout=70.0)

    def _run(self) -> None:
        with contextlib.suppress(OSError), ControlClient(f"{NAME}, {self.name}", self._socket) as client:
            try:
                self._ask(client)
            except RtcpError as error:
                self.refusal = error.message

    @property
    def _socket(self) -> Path:
        return control_socket(self._directory)

    def _ask(self, client: ControlClient) -> None:
        """Ask again and again until `_ended`."""


class Holding(Activity):
    """The arm holds."""


class Moving(Activity):
    """The arm goes to and fro in joint mode."""

    name = "moving"
    moves = True

    def _ask(self, client: ControlClient) -> None:
        ends: tuple[Sequence[float], Sequence[float]] = (
            tuple(start + by for start, by in zip(START, _SWING, strict=True)),
            tuple(start - by for start, by in zip(START, _SWING, strict=True)),
        )
        way = 0
        while not self._ended.is_set():
            client.call("move", {"q": list(ends[way]), "speed": _SPEED}, timeout_s=60.0)
            way = 1 - way

    def end(self) -> None:
        """End the move under way, too."""
        self._ended.set()
        with contextlib.suppress(RtcpError, OSError), ControlClient(NAME, self._socket) as client:
            client.call("halt")
        super().end()


class Jogging(Activity):
    """The tool is jogged to and fro along x of the base."""

    name = "jogging"
    moves = True

    def _ask(self, client: ControlClient) -> None:
        begun = time.monotonic()
        while not self._ended.is_set():
            way = 1.0 if (time.monotonic() - begun) % (2 * _TURN_S) < _TURN_S else -1.0
            speeds = [way * _JOG_M_S, 0.0, 0.0, 0.0, 0.0, 0.0]
            client.call("jog", {"v": speeds, "frame": "base", "hold_s": _HOLD_S})
            self._ended.wait(_SAY_AGAIN_S)


class Stick(Activity):
    """The stick, forced at the virtual IO box, moves the tool to and fro."""

    name = "stick"
    motion = "joystick"
    moves = True

    def _ask(self, client: ControlClient) -> None:
        # The arm waits for a stick in its middle before it follows it.
        client.call("stick", {"pressed": [], "byte": _NEUTRAL, "hold_s": _STICK_HOLD_S})
        self._ended.wait(_STICK_HOLD_S / 2)
        begun = time.monotonic()
        while not self._ended.is_set():
            way = "forward" if (time.monotonic() - begun) % (2 * _TURN_S) < _TURN_S else "backward"
            arguments: dict[str, Any] = {"pressed": [way], "hold_s": _STICK_HOLD_S}
            client.call("stick", arguments)
            self._ended.wait(_STICK_HOLD_S / 3)


ACTIVITIES: dict[str, type[Activity]] = {kind.name: kind for kind in (Holding, Moving, Jogging, Stick)}
