"""A random session on the bus `virtual`: real processes, the real socket, and the frames that reached the segment."""

from __future__ import annotations

import tempfile
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

from rtcp.motion.limits import Values
from tests.e2e.conftest import Platform
from tests.sessions.driver import bounds_of, configuration
from tests.sessions.judge import Judge
from tests.sessions.play import Outcome
from tests.sessions.wire_deeds import MOTIONS, WireDeeds
from tests.sessions.wire_frames import EXPECTED_WKC, exchanges
from tests.sessions.wire_limits import Change, Limiter
from tests.sessions.wire_voice import Voice

READY_FOR_MOTION = ("holding", "moving", "stopping")
HOPELESS = 12
"""So many times in a row the arm could not be brought back."""
SLACK_CYCLES = 2
SHOWN_DEEDS = 10


class WirePlayer:
    """Chooses what is done next on a platform that runs."""

    def __init__(self, platform: Platform, seed: int) -> None:
        self.random = random = Random(seed)
        self.voice = voice = Voice(platform.directory / "control.sock")
        self.deeds = deeds = WireDeeds(platform, voice, random)
        self.states: Counter[str] = Counter()
        self._hopeless = 0
        self._actions: list[tuple[int, Callable[[], object]]] = [
            (24, self._motion),
            (4, deeds.command),
            (8, deeds.control_mode),
            (3, deeds.limits),
            (2, deeds.stick),
            (1, deeds.chair),
            (1, deeds.emergency),
            (2, deeds.lost_frames),
            (1, deeds.silent_gateway),
            (1, deeds.slave_leaves_op),
            (1, deeds.drive_fault),
        ]

    def play(self, seconds: float) -> None:
        """Play for so long."""
        random, end = self.random, time.monotonic() + seconds
        while time.monotonic() < end:
            state = self.voice.status()["state"]
            self.states[state] += 1
            if state not in READY_FOR_MOTION and random.random() < 0.8:
                self._recover()
            else:
                if state in READY_FOR_MOTION:
                    self._hopeless = 0
                random.choices([do for _, do in self._actions], [weight for weight, _ in self._actions])[0]()
            self.deeds.seconds(0.0, 0.2)
            self.voice.busy(1e-3)

    def _recover(self) -> None:
        self._hopeless += 1
        if self._hopeless % 4 == 0:
            # Limits may have become such that nothing is allowed.
            self.voice.ask("joystick")
            self.deeds.widen()
        if self._hopeless == HOPELESS:
            raise RuntimeError(f"the arm cannot be enabled any more: {self.voice.status()['message']}")
        self.deeds.enable()

    def _motion(self) -> None:
        """Mostly one that the control mode takes, now and then another."""
        deeds, motion = self.deeds, str(self.voice.status()["control_mode"])
        if self.random.random() < 0.1:
            motion = self.random.choice(MOTIONS)
        if motion == "velocity":
            deeds.velocity()
        elif motion == "torque":
            deeds.torque()
        elif motion == "joystick":
            deeds.stick()
        else:
            self.random.choice(
                (deeds.move, deeds.move, deeds.pose_move, deeds.line, deeds.trajectory, deeds.stream, deeds.jog)
            )()

    def leave(self) -> None:
        """Let go of everything; half the time while the arm moves, so that the platform ends under way."""
        if self.random.random() < 0.5:
            self.deeds.enable()
            self.deeds.move()
        self.voice.close()


def judge(
    path: Path, period_s: float, changes: Sequence[Change] = (), deeds: Sequence[tuple[int, str]] = ()
) -> tuple[Judge, list[list[str]]]:
    """Judge a capture; return the judge, and of each violation its sentence and the last deeds before it."""
    config = configuration()
    found = Judge(bounds_of(config), period_s, range(1, 7), EXPECTED_WKC)
    limiter = Limiter(found, Values.configured(config), changes, round(SLACK_CYCLES * period_s * 1e9))
    instants = [when for when, _ in deeds]
    failures: list[list[str]] = []
    for frame in exchanges(path):
        limiter.at(frame.now_ns)
        found.see(frame)
        if len(found.violations) > len(failures):
            at = bisect_right(instants, frame.now_ns)
            before = [f"{when * 1e-9:.4f} {deed}" for when, deed in deeds[max(0, at - SHOWN_DEEDS) : at + 1]]
            failures += [[sentence, *before] for sentence in found.violations[len(failures) :]]
    return found, failures


def play_on_the_wire(seed: int, seconds: float, period_us: int, keep: Path | None = None) -> Outcome:
    """Start a platform, play, stop it and judge what was on its wire.

    `keep`: where the capture stays, with a list of the deeds beside it (.txt).
    """
    period_s = period_us * 1e-6
    platform = Platform()
    with tempfile.TemporaryDirectory(prefix="rtcp-wire-") as directory:
        path = keep or Path(directory) / "capture"
        platform.environment["RTCP_STATE_DIR"] = directory
        try:
            platform.rtcp("start", "--detach", "--cycle-us", str(period_us))
            player = WirePlayer(platform, seed)
            voice = player.voice
            with platform.capture(path):
                try:
                    player.play(seconds)
                    player.leave()
                    platform.rtcp("stop")
                except Exception as error:
                    voice.defects.append((time.monotonic_ns(), f"{type(error).__name__}: {error}"))
            if "Traceback" in (logs := platform.logs()):
                voice.defects.append((time.monotonic_ns(), logs))
        finally:
            platform.end()
        path.with_suffix(".txt").write_text("".join(f"{when * 1e-9:.4f} {deed}\n" for when, deed in voice.deeds))
        found, failures = judge(path, period_s, player.deeds.changes, voice.deeds)
    failures += [[f"{when * 1e-9:.4f} {defect}"] for when, defect in voice.defects]
    return Outcome(
        1, found.frames, found.obeyed, seconds, voice.taken, voice.refused, voice.happenings, player.states,
        found.largest_step, found.largest_acceleration, [(seed, sentences) for sentences in failures],
    )  # fmt: skip
