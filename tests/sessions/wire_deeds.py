"""What is done to a real platform in a random session, beside waiting: one method a kind of deed."""

from __future__ import annotations

import os
import signal
import time
from math import inf, nan
from random import Random
from typing import Any

from kinematics import forward
from rtcp.motion.limits import Values
from tests.e2e.conftest import Platform
from tests.sessions.driver import STICK, configuration
from tests.sessions.wire_limits import Change, from_answer
from tests.sessions.wire_voice import Voice

NONSENSE = (nan, inf, -inf, 1e300, -1e300, 1e9, -1e9, 0.0)
MOTIONS = ("joint", "cartesian", "joystick", "velocity", "torque")
SHARES = (3, 3, 2, 1, 1)
DRIVE_MODES = ("csp", "csv", "cst")
BROKEN = ("fault", "emergency_stop")
SAY_AGAIN_S = 0.1
BENT = (0.0, 0.2, 1.57, 0.0, 0.4, 0.0)
"""rad; away from every limit and singularity: lines and tool jogs are possible from there."""
Q = list[float]


class WireDeeds:
    """Everything follows from `random`, but for what the platform answers and when.

    Args:
        platform: it runs.
        voice: asks it.
        random: chooses.
    """

    def __init__(self, platform: Platform, voice: Voice, random: Random) -> None:
        self.platform = platform
        self.voice = voice
        self.random = random
        self.changes: list[Change] = []
        self.widest = Values.configured(configuration())
        self.now = self.widest
        self._narrowed: set[int] = set()

    # -- numbers ----------------------------------------------------------------------------------------------------

    def or_nonsense(self, number: float, share: float = 0.02) -> float:
        return self.random.choice(NONSENSE) if self.random.random() < share else number

    def commanded(self) -> Q:
        return list(self.voice.status()["joints"]["commanded_position"])

    def near(self, by: float) -> Q:
        return [q + self.random.uniform(-by, by) for q in self.commanded()]

    def seconds(self, least: float, most: float) -> None:
        time.sleep(self.random.uniform(least, most))

    def pose(self, far: float) -> Q:
        """A pose near where the tool is told to be."""
        arm = configuration().arm
        assert arm is not None
        here = forward(arm, self.commanded())
        return [
            self.or_nonsense(x + self.random.uniform(-far, far), 0.005)
            for x in (*map(float, here.position), *map(float, here.rpy))
        ]

    # -- states and modes -------------------------------------------------------------------------------------------

    def enable(self) -> None:
        """Enable, and come back from whatever keeps the arm from it."""
        state = self.voice.status()["state"]
        if state in (*BROKEN, "stopped_by_limit"):
            self.voice.ask("reset")
        if self.voice.status()["state"] == "ready":
            self.mend_drives()
            self.voice.ask("enable")

    def command(self) -> None:
        """Something short, whether or not it is allowed."""
        verb, arguments = self.random.choice(
            (
                ("enable", {}), ("disable", {}), ("reset", {}), ("halt", {}), ("halt", {}),
                ("set_drive_mode", {"mode": self.random.choice((*DRIVE_MODES, "none"))}),
                ("set_output", {"output": self.random.randrange(0, 18), "value": self.random.random() < 0.5}),
                ("move_gripper", {"open": self.random.random() < 0.5}),
            )
        )  # fmt: skip
        self.voice.ask(verb, **arguments)

    def control_mode(self) -> None:
        (name,) = self.random.choices(MOTIONS, SHARES)
        if self.voice.ask("mode", name=name) is not None and self.random.random() < 0.3:
            self.voice.ask("mode", name=self.random.choice(DRIVE_MODES))

    # -- what has an end --------------------------------------------------------------------------------------------

    def move(self) -> None:
        random = self.random
        span = random.choice((1.0, 0.3, 0.1, 0.02))
        now = self.now
        if random.random() < 0.2:
            self._travel("move_joints", q=[q + random.uniform(-0.2, 0.2) for q in BENT])
            return
        q = [
            self.or_nonsense(here + span * (random.uniform(low, high) - here))
            for here, low, high in zip(self.commanded(), now.low, now.high, strict=True)
        ]
        if random.random() < 0.1:
            q[random.randrange(6)] = random.choice((-3.2, 3.2, 3.1, -3.1))
        speed = self.or_nonsense(random.choice((0.5, 0.5, 0.2, random.uniform(0.0, 0.6))))
        self._travel("move_joints", q=q, speed=speed, synchronized=random.random() < 0.5)

    def pose_move(self) -> None:
        self._travel("move_pose", pose=self.pose(0.2), line=self.random.random() < 0.5)

    def line(self) -> None:
        random = self.random
        poses = [self.pose(random.choice((0.05, 0.2))) for _ in range(random.randrange(1, 4))]
        self._travel("move_line", poses=poses, speed=self.or_nonsense(random.choice((0.05, 0.1, 0.25))))

    def trajectory(self) -> None:
        random = self.random
        here, t = self.commanded(), 0.0
        pace = random.choice((0.1, 0.2, 0.4))
        points: list[dict[str, Any]] = [{"t": 0.0, "q": here}] if random.random() < 0.7 else []
        for _ in range(random.randrange(1, 5)):
            step = random.uniform(0.3, 1.0)
            t += step
            here = [q + random.uniform(-pace, pace) * step for q in here]
            points.append({"t": t, "q": [self.or_nonsense(q, 0.003) for q in here]})
        self._travel("run_trajectory", points=points, approach=random.random() < 0.3)

    def _travel(self, verb: str, **arguments: Any) -> None:
        """Begin it; now and then something comes in between, or nobody waits for its end."""
        random, voice = self.random, self.voice
        voice.begin(verb, **arguments)
        if not voice.busy(random.uniform(0.05, 1.5)):
            return
        what = random.random()
        if what < 0.25:
            voice.ask("halt")
        elif what < 0.35:
            voice.drop()
        elif what < 0.40:
            voice.ask("disable")
        elif what < 0.45:
            self.emergency()
        elif what < 0.50:
            self.limits()
        elif what < 0.55:
            self.command()
        elif what < 0.60:
            self.lost_frames()
        voice.busy(random.uniform(0.0, 3.0))

    # -- what has to be said again and again ------------------------------------------------------------------------

    def jog(self) -> None:
        random = self.random
        frame = random.choice(("base", "tool", "joints"))
        speeds = [
            random.choice((0.0, 0.0, 1.0, -1.0))
            * (random.choice((0.05, 0.2, 0.4)) if frame == "joints" or axis > 2 else 0.1)
            for axis in range(6)
        ]
        for _ in range(random.randrange(1, 12)):
            v = [self.or_nonsense(speed, 0.005) for speed in speeds]
            taken = self.voice.ask("jog", velocity=v, frame=frame, hold_s=random.choice((0.1, 0.25)))
            if taken is None and random.random() < 0.5:
                break
            self.seconds(0.02, 0.15)
            if random.random() < 0.1:
                speeds[random.randrange(6)] *= -1.0
        self._leave()

    def velocity(self) -> None:
        random = self.random
        for _ in range(random.randrange(1, 6)):
            numbers = [self.or_nonsense(random.choice((0.0, random.uniform(-0.5, 0.5), 0.5)), 0.01) for _ in range(6)]
            taken = self.voice.ask("move_at_velocity", velocity=numbers, hold_s=self.or_nonsense(0.5))
            if taken is None and random.random() < 0.5:
                break
            self.seconds(0.02, 0.4)
        self._leave()

    def torque(self) -> None:
        random = self.random
        share = random.choice((0.05, 0.2, 0.5, 1.1))
        for _ in range(random.randrange(1, 6)):
            numbers = [self.or_nonsense(random.uniform(-share, share) * most, 0.005) for most in self.now.torque]
            shares = {"stiffness": random.choice((0.0, 0.5, 1.0)), "damping": random.choice((0.0, 1.0))}
            taken = self.voice.ask("apply_torque", torque=numbers, **shares, hold_s=self.or_nonsense(0.3))
            if taken is None and random.random() < 0.5:
                break
            self.seconds(0.02, 0.3)
        self._leave()

    def stream(self) -> None:
        """Targets at some rate; late ones, jumps, and an end without a word."""
        random = self.random
        interval = random.choice((0.01, 0.033, 0.1))
        pace = random.choice((0.1, 0.3, 0.6))
        target, stamp = self.commanded(), time.monotonic()
        velocity = [random.uniform(-pace, pace) for _ in target]
        for _ in range(random.randrange(5, 40)):
            stamp += interval
            if random.random() < 0.1:
                velocity = [random.uniform(-pace, pace) for _ in target]
            target = [q + v * interval for q, v in zip(target, velocity, strict=True)]
            sent = [q + random.uniform(-0.5, 0.5) for q in target] if random.random() < 0.03 else target
            told = stamp - random.choice((0.0, 0.0, 0.0, 0.0, 0.5, interval))
            if self.voice.ask("stream_position", q=[self.or_nonsense(q, 0.003) for q in sent], stamp_s=told) is None:
                break
            time.sleep(interval * random.uniform(0.5, 1.5))
        self._leave()

    def _leave(self) -> None:
        """Be silent, say halt, or hang up: each an end of what has to be said again."""
        what = self.random.random()
        if what < 0.3:
            self.voice.hang_up()
        elif what < 0.6:
            self.voice.ask("halt")

    # -- a hand at the arm ------------------------------------------------------------------------------------------

    def _hold(self, seconds: float, **position: Any) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.voice.ask("joystick", **position, hold_s=0.4)
            time.sleep(min(SAY_AGAIN_S, left))

    def stick(self) -> None:
        """Push the stick, change modes, and now and then show what is no code."""
        random = self.random
        for _ in range(random.randrange(1, 4)):
            byte = random.choice(STICK) if random.random() < 0.9 else random.randrange(256)
            self._hold(random.uniform(0.02, 0.8), byte=byte)
            if random.random() < 0.2:
                self.limits()
            if random.random() < 0.6:
                self._hold(0.05, byte=63)
        if random.random() < 0.7:
            self._hold(0.05, byte=63)
        self.voice.ask("joystick")

    def chair(self) -> None:
        """Give the stick to the wheelchair for a while."""
        self._hold(
            self.random.uniform(0.02, 0.4), pressed=["chair", self.random.choice(("forward", "left", "mode_up"))]
        )
        self.voice.ask("joystick")

    def emergency(self) -> None:
        """Press the emergency stop, and mostly reset it later."""
        self._hold(self.random.uniform(0.02, 0.6), pressed=["emergency_stop"])
        self.voice.ask("joystick")
        self.seconds(0.0, 0.2)
        if self.random.random() < 0.8:
            self.voice.ask("reset")

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
            for axis, q in enumerate(self.commanded()):
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
        widest, found = self.widest, {}
        keys = {"min": "low", "max": "high", "velocity": "velocity", "acceleration": "acceleration", "jerk": "jerk",
                "torque": "torque"}  # fmt: skip
        for key, name in keys.items():
            found |= {f"joint{axis + 1}.{key}": number for axis, number in enumerate(getattr(widest, name))}
        boxes = {"box": widest.box} if widest.box is not None else {}
        names = (zone.name for zone in configuration().cartesian.keep_out)
        for name, box in (boxes | dict(zip(names, widest.keep_out, strict=True))).items():
            found |= {f"{name}.{end}": box[at] for at, (end, _) in enumerate(_ENDS)}
        return found

    def _set(self, changes: dict[str, float]) -> None:
        asked = time.monotonic_ns()
        answer = self.voice.ask("set_limits", changes=changes)
        if answer is not None:
            self.now = from_answer(answer["limits"], self.widest.jerk)
            self.changes.append(Change(asked, time.monotonic_ns(), self.now))

    # -- what goes wrong --------------------------------------------------------------------------------------------

    def lost_frames(self) -> None:
        """The segment stands still: frames come late or not at all."""
        seconds = self.random.choice((0.003, 0.01, 0.03, 0.1, 0.3))
        self.voice.happen("segment stopped", f"for {seconds} s")
        self._stopped("segment", seconds)

    def silent_gateway(self) -> None:
        """Nobody renews a lease."""
        seconds = self.random.choice((0.1, 0.7))
        self.voice.happen("gateway stopped", f"for {seconds} s")
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
        self.voice.happen("slave to SAFE-OP", str(position))
        self.platform.wire("safeop", str(position))

    def drive_fault(self) -> None:
        """A drive with hardly any window for its following error: fault 0x8611 as soon as it moves."""
        if self.voice.status()["state"] not in ("ready", "holding"):
            return
        self.voice.ask("disable")
        slave = self.random.randrange(2, 8)
        self._narrowed.add(slave)
        self._window(slave, 1, 0)
        self.voice.happen("following error window of 1 count", f"slave {slave}")
        self.voice.ask("enable")
        self.voice.begin("move_joints", q=self.near(0.5))
        self.voice.busy(2.0)
        self.voice.drop()

    def mend_drives(self) -> None:
        """Give the drives back what they were told to watch; possible while ready only."""
        for slave in sorted(self._narrowed):
            if self._window(slave, 2000, 50):
                self._narrowed.discard(slave)

    def _window(self, slave: int, counts: int, ms: int) -> bool:
        done = True
        for index, value, size in ((0x6065, counts, 4), (0x6066, ms, 2)):
            what = {"slave": slave, "index": index, "subindex": 0}
            done &= self.voice.ask("sdo_write", **what, hex=value.to_bytes(size, "little").hex()) is not None
        return done


_ENDS = (("min.x", 1), ("min.y", 1), ("min.z", 1), ("max.x", -1), ("max.y", -1), ("max.z", -1))
"""Corners of a box, and which way is inwards."""
