"""A random session on the bus `virtual`: real processes, the real socket, and the frames that reached the segment."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

from kinematics import forward
from rtcp.ipc.commands import Command, Halt
from rtcp.motion.limits import Values
from rtcp.testing.sessions.actions import CONTROL_MODES, SHARES, RandomActions
from rtcp.testing.sessions.checker import FrameChecker
from tests.e2e.conftest import Platform
from tests.sessions.oracle import checker_of, configuration
from tests.sessions.session import Outcome
from tests.sessions.wire_capture import EXPECTED_WKC, Change, Limiter, exchanges, from_answer
from tests.sessions.wire_client import WireClient

BROKEN = ("fault", "emergency_stop")
RENEW_S = 0.1
BENT = (0.0, 0.2, 1.57, 0.0, 0.4, 0.0)
"""rad; away from every limit and singularity: lines and tool jogs are possible from there."""
READY_FOR_MOTION = ("holding", "moving", "stopping")
HOPELESS = 12
"""So many times in a row the arm could not be brought back."""
SLACK_CYCLES = 2
SHOWN_ACTIONS = 10


class WireSession(RandomActions):
    """A session on a platform that runs. Everything follows from `random`, but for what it answers and when."""

    def __init__(self, platform: Platform, random: Random) -> None:
        super().__init__(random)
        self.platform = platform
        self.client = WireClient(platform.directory / "control.sock")
        self.states: Counter[str] = Counter()
        self.changes: list[Change] = []
        self.widest = self.now = Values.configured(configuration())
        self.stamp = time.monotonic()
        self._narrowed: set[int] = set()
        self._hopeless = 0
        self._actions: list[tuple[int, Callable[[], object]]] = [
            (24, self._motion),
            (4, self.command),
            (8, self.control_mode),
            (3, self.limits),
            (2, self.joystick),
            (1, self.chair),
            (1, self.emergency),
            (2, self.lost_frames),
            (1, self.silent_gateway),
            (1, self.slave_leaves_op),
            (1, self.drive_fault),
        ]

    # -- how it reaches the arm -------------------------------------------------------------------------------------

    @property
    def commanded(self) -> list[float]:
        """The last targets, rad."""
        return self.client.commanded

    def send(self, command: Command) -> bool:
        """Ask for the method of the command's name."""
        return self.client.ask(command.name, **command.as_json()) is not None

    def seconds(self, least: float, most: float) -> None:
        """Let time pass."""
        time.sleep(self.random.uniform(least, most))

    def show(self, code: int, seconds: float) -> None:
        """Show a byte at the joystick's inputs for so long."""
        self._hold(seconds, byte=code)

    def leave(self) -> None:
        """Be silent, send halt, or close the connection: each an end of a stream."""
        what = self.random.random()
        if what < 0.3:
            self.client.hang_up()
        elif what < 0.6:
            self.send(Halt())

    def _hold(self, seconds: float, **position: Any) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.client.ask("joystick", **position, hold_s=0.4)
            time.sleep(min(RENEW_S, left))

    # -- the session ------------------------------------------------------------------------------------------------

    def run(self, seconds: float) -> None:
        """Run for so long."""
        random, end = self.random, time.monotonic() + seconds
        while time.monotonic() < end:
            state = self.client.status()["state"]
            self.states[state] += 1
            if state not in READY_FOR_MOTION and random.random() < 0.8:
                self._recover()
            else:
                if state in READY_FOR_MOTION:
                    self._hopeless = 0
                random.choices([do for _, do in self._actions], [weight for weight, _ in self._actions])[0]()
            self.seconds(0.0, 0.2)
            self.client.busy(1e-3)

    def _recover(self) -> None:
        self._hopeless += 1
        if self._hopeless % 4 == 0:
            # Limits may have become such that nothing is allowed.
            self.client.ask("joystick")
            self.widen()
        if self._hopeless == HOPELESS:
            raise RuntimeError(f"the arm cannot be enabled any more: {self.client.status()['message']}")
        self.enable()

    def _motion(self) -> None:
        """Mostly one that the control mode takes, now and then another."""
        mode = str(self.client.status()["control_mode"])
        if self.random.random() < 0.1:
            mode = self.random.choice(CONTROL_MODES)
        usual = (self.move, self.move, self.pose_move, self.line, self.trajectory, self.stream, self.jog)
        special = {"velocity": self.velocity, "torque": self.torque, "joystick": self.joystick}
        (special[mode] if mode in special else self.random.choice(usual))()

    def control_mode(self) -> None:
        """Choose another; now and then a drive mode, too."""
        (name,) = self.random.choices(CONTROL_MODES, SHARES)
        if self.client.ask("mode", name=name) is not None and self.random.random() < 0.3:
            self.client.ask("mode", name=self.random.choice(("csp", "csv", "cst")))

    def end(self) -> None:
        """Close all connections; half the time while the arm moves, so that the platform ends under way."""
        if self.random.random() < 0.5:
            self.enable()
            self.move()
        self.client.close()

    def enable(self) -> None:
        """Enable, and come back from whatever keeps the arm from it."""
        state = self.client.status()["state"]
        if state in (*BROKEN, "stopped_by_limit"):
            self.client.ask("reset")
        if self.client.status()["state"] == "ready":
            self.restore_drives()
            self.client.ask("enable")

    def pose(self, far: float) -> list[float]:
        """A pose near where the tool is commanded to be."""
        arm = configuration().arm
        assert arm is not None
        here = forward(arm, self.commanded)
        return [
            self.or_nonsense(x + self.random.uniform(-far, far), 0.005)
            for x in (*map(float, here.position), *map(float, here.rpy))
        ]

    # -- motions that end --------------------------------------------------------------------------------------------

    def move(self) -> None:
        """Joint positions."""
        random = self.random
        span = random.choice((1.0, 0.3, 0.1, 0.02))
        now = self.now
        if random.random() < 0.2:
            self._travel("move_joints", q=[q + random.uniform(-0.2, 0.2) for q in BENT])
            return
        q = [
            self.or_nonsense(here + span * (random.uniform(low, high) - here))
            for here, low, high in zip(self.commanded, now.low, now.high, strict=True)
        ]
        if random.random() < 0.1:
            q[random.randrange(6)] = random.choice((-3.2, 3.2, 3.1, -3.1))
        speed = self.or_nonsense(random.choice((0.5, 0.5, 0.2, random.uniform(0.0, 0.6))))
        self._travel("move_joints", q=q, speed=speed, synchronized=random.random() < 0.5)

    def pose_move(self) -> None:
        """A pose."""
        self._travel("move_pose", pose=self.pose(0.2), line=self.random.random() < 0.5)

    def line(self) -> None:
        """Straight pieces."""
        random = self.random
        poses = [self.pose(random.choice((0.05, 0.2))) for _ in range(random.randrange(1, 4))]
        self._travel("move_line", poses=poses, speed=self.or_nonsense(random.choice((0.05, 0.1, 0.25))))

    def trajectory(self) -> None:
        """A way through random points."""
        points: list[dict[str, Any]] = [{"t": 0.0, "q": self.commanded}] if self.random.random() < 0.7 else []
        points += [{"t": t, "q": self.some(q, 0.003)} for t, q in self.waypoints((0.1, 0.2, 0.4), 5)]
        self._travel("run_trajectory", points=points, approach=self.random.random() < 0.3)

    def _travel(self, verb: str, **arguments: Any) -> None:
        """Begin it; now and then something comes in between, or nobody waits for its end."""
        random, client = self.random, self.client
        client.begin(verb, **arguments)
        if not client.busy(random.uniform(0.05, 1.5)):
            return
        what = random.random()
        if what < 0.25:
            client.ask("halt")
        elif what < 0.35:
            client.drop()
        elif what < 0.40:
            client.ask("disable")
        elif what < 0.45:
            self.emergency()
        elif what < 0.50:
            self.limits()
        elif what < 0.55:
            self.command()
        elif what < 0.60:
            self.lost_frames()
        client.busy(random.uniform(0.0, 3.0))

    def chair(self) -> None:
        """Give the joystick to the wheelchair for a while."""
        self._hold(
            self.random.uniform(0.02, 0.4), pressed=["chair", self.random.choice(("forward", "left", "mode_up"))]
        )
        self.client.ask("joystick")

    def emergency(self) -> None:
        """Press the emergency stop, and mostly reset it later."""
        self._hold(self.random.uniform(0.02, 0.6), pressed=["emergency_stop"])
        self.client.ask("joystick")
        self.seconds(0.0, 0.2)
        if self.random.random() < 0.8:
            self.client.ask("reset")

    # -- limits -----------------------------------------------------------------------------------------------------

    def limits(self) -> None:
        """Narrower ones, now and then too narrow, too wide or none at all; or those of the configuration again."""
        random, widest = self.random, self.widest
        if random.random() < 0.25:
            self._set(self._all())
            return
        changes: dict[str, float] = {}
        if random.random() < 0.6:
            share = random.choice((0.2, 0.4, 0.6, 0.8, 0.9, 1.05))
            for axis, q in enumerate(self.commanded):
                changes[f"joint{axis + 1}.min"] = self.or_nonsense(q + share * (widest.low[axis] - q), 0.002)
                changes[f"joint{axis + 1}.max"] = self.or_nonsense(q + share * (widest.high[axis] - q), 0.002)
        for name in ("velocity", "acceleration", "jerk", "torque"):
            if random.random() < 0.3:
                axis, scale = random.randrange(6), random.choice((0.3, 0.7, 1.0, 1.0, 1.0, 1.0, 1.05))
                changes[f"joint{axis + 1}.{name}"] = scale * getattr(widest, name)[axis]
        if random.random() < 0.15 and widest.box is not None:
            by = random.choice((0.05, 0.2))
            for at, (end, way) in enumerate(_ENDS):
                changes[f"box.{end}"] = widest.box[at] + way * by
        if random.random() < 0.15:
            by = random.choice((0.02, 0.1))
            for zone, box in zip(configuration().cartesian.keep_out, widest.keep_out, strict=True):
                for at, (end, way) in enumerate(_ENDS):
                    changes[f"{zone.name}.{end}"] = box[at] - way * by
        self._set(changes)

    def widen(self) -> None:
        """Give back the configuration's limits."""
        self._set(self._all())

    def _all(self) -> dict[str, float]:
        widest = self.widest
        numbers: dict[str, float] = {}
        keys = {"min": "low", "max": "high", "velocity": "velocity", "acceleration": "acceleration", "jerk": "jerk",
                "torque": "torque"}  # fmt: skip
        for key, name in keys.items():
            numbers |= {f"joint{axis + 1}.{key}": number for axis, number in enumerate(getattr(widest, name))}
        boxes = {"box": widest.box} if widest.box is not None else {}
        names = (zone.name for zone in configuration().cartesian.keep_out)
        for name, box in (boxes | dict(zip(names, widest.keep_out, strict=True))).items():
            numbers |= {f"{name}.{end}": box[at] for at, (end, _) in enumerate(_ENDS)}
        return numbers

    def _set(self, changes: dict[str, float]) -> None:
        asked = time.monotonic_ns()
        answer = self.client.ask("set_limits", changes=changes)
        if answer is not None:
            self.now = from_answer(answer["limits"], self.widest.jerk)
            self.changes.append(Change(asked, time.monotonic_ns(), self.now))

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def lost_frames(self) -> None:
        """The segment stands still: frames come late or not at all."""
        seconds = self.random.choice((0.003, 0.01, 0.03, 0.1, 0.3))
        self.client.count_fault("segment stopped", f"for {seconds} s")
        self._stopped("segment", seconds)

    def silent_gateway(self) -> None:
        """Nobody renews a lease."""
        seconds = self.random.choice((0.1, 0.7))
        self.client.count_fault("gateway stopped", f"for {seconds} s")
        self._stopped("gateway", seconds)

    def _stopped(self, name: str, seconds: float) -> None:
        pid = self.platform.pids()[name]
        os.kill(pid, signal.SIGSTOP)
        try:
            time.sleep(seconds)
        finally:
            os.kill(pid, signal.SIGCONT)

    def slave_leaves_op(self) -> None:
        """A slave falls to SAFE-OP; a drive with torque then has fault 0x8130."""
        position = self.random.randrange(7)
        self.client.count_fault("slave to SAFE-OP", str(position))
        self.platform.wire("safeop", str(position))

    def drive_fault(self) -> None:
        """A drive with hardly any window for its following error: fault 0x8611 as soon as it moves."""
        if self.client.status()["state"] not in ("ready", "holding"):
            return
        self.client.ask("disable")
        slave = self.random.randrange(2, 8)
        self._narrowed.add(slave)
        self._window(slave, 1, 0)
        self.client.count_fault("following error window of 1 count", f"slave {slave}")
        self.client.ask("enable")
        self.client.begin("move_joints", q=self.near(0.5))
        self.client.busy(2.0)
        self.client.drop()

    def restore_drives(self) -> None:
        """Restore the window of the following error; possible while ready only."""
        for slave in sorted(self._narrowed):
            if self._window(slave, 2000, 50):
                self._narrowed.discard(slave)

    def _window(self, slave: int, counts: int, ms: int) -> bool:
        done = True
        for index, value, size in ((0x6065, counts, 4), (0x6066, ms, 2)):
            what = {"slave": slave, "index": index, "subindex": 0}
            done &= self.client.ask("sdo_write", **what, hex=value.to_bytes(size, "little").hex()) is not None
        return done


_ENDS = (("min.x", 1), ("min.y", 1), ("min.z", 1), ("max.x", -1), ("max.y", -1), ("max.z", -1))
"""Corners of a box, and which way is inwards."""


def check(
    path: Path, period_s: float, changes: Sequence[Change] = (), actions: Sequence[tuple[int, str]] = ()
) -> tuple[FrameChecker, list[list[str]]]:
    """Check a capture; return the checker, and of each violation its sentence and the last actions before it."""
    config = configuration()
    checker = checker_of(config, period_s, EXPECTED_WKC)
    limiter = Limiter(checker, Values.configured(config), changes, round(SLACK_CYCLES * period_s * 1e9))
    instants = [when for when, _ in actions]
    failures: list[list[str]] = []
    for frame in exchanges(path):
        limiter.at(frame.now_ns)
        checker.check(frame)
        if len(checker.violations) > len(failures):
            at = bisect_right(instants, frame.now_ns)
            before = [f"{when * 1e-9:.4f} {action}" for when, action in actions[max(0, at - SHOWN_ACTIONS) : at + 1]]
            failures += [[str(violation), *before] for violation in checker.violations[len(failures) :]]
    return checker, failures


def run_on_the_wire(seed: int, seconds: float, period_us: int, keep: Path | None = None) -> Outcome:
    """Start a platform, run a session, stop it and check what was on its wire.

    `keep`: where the capture stays, with a list of the actions beside it (.txt).
    """
    period_s = period_us * 1e-6
    platform = Platform()
    with tempfile.TemporaryDirectory(prefix="rtcp-wire-") as directory:
        path = keep or Path(directory) / "capture"
        platform.environment["RTCP_STATE_DIR"] = directory
        try:
            platform.rtcp("start", "--detach", "--cycle-us", str(period_us))
            session = WireSession(platform, Random(seed))
            client = session.client
            with platform.capture(path):
                try:
                    session.run(seconds)
                    session.end()
                    platform.rtcp("stop")
                except Exception as error:
                    client.defects.append((time.monotonic_ns(), f"{type(error).__name__}: {error}"))
            if "Traceback" in (logs := platform.logs()):
                client.defects.append((time.monotonic_ns(), logs))
        finally:
            platform.end()
        path.with_suffix(".txt").write_text("".join(f"{when * 1e-9:.4f} {action}\n" for when, action in client.actions))
        checker, failures = check(path, period_s, session.changes, client.actions)
    failures += [[f"{when * 1e-9:.4f} {defect}"] for when, defect in client.defects]
    return Outcome(
        1, checker.frames, checker.obeyed, seconds, client.taken, client.refused, client.faults, session.states,
        checker.largest_step, checker.largest_acceleration, [(seed, sentences) for sentences in failures],
    )  # fmt: skip
