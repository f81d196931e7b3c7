"""Longer deeds of a random session: what takes several commands, or a plan, or a hand on the stick."""

from __future__ import annotations

from dataclasses import replace
from math import sqrt
from random import Random

from kinematics import forward
from rtcp.ipc.commands import (
    ApplyTorque,
    Command,
    Jog,
    MoveAtVelocity,
    Reset,
    RunLines,
    RunTrajectory,
    StreamPosition,
)
from rtcp.ipc.states import JogFrame, State
from rtcp.motion.limits import Values
from tests.sessions.driver import NONSENSE, ODD_INTEGERS, STICK, Driver, configuration, is_free

CUBIC, QUINTIC, LINE = 3.0, 5.0, 1.0
"""Column 19 of a plan's row (`rtcp.motion.planning.plan`)."""
HOLD_S = 0.2


class Deeds:
    """Made of a driver and the session's random numbers."""

    def __init__(self, driver: Driver, random: Random, period_s: float) -> None:
        self.driver = driver
        self.random = random
        self._period_s = period_s

    def or_nonsense(self, number: float, share: float = 0.03) -> float:
        """Return the number, or now and then one that nobody should send."""
        return self.random.choice(NONSENSE) if self.random.random() < share else number

    def or_odd(self, number: int) -> int:
        """Return the integer, or now and then one that nobody should send."""
        return self.random.choice(ODD_INTEGERS) if self.random.random() < 0.03 else number

    def send(self, command: Command) -> bool:
        """Send a command."""
        return self.driver.send(command)

    def goes_on(self, taken: bool) -> bool:
        """Whether a commander says it again: not for long where it was refused."""
        return taken or self.random.random() < 0.6

    def seconds(self, least: float, most: float) -> None:
        """Let time pass."""
        self.driver.wait(int(self.random.uniform(least, most) / self._period_s))

    def _near(self, by: float) -> list[float]:
        return [q + self.random.uniform(-by, by) for q in self.driver.commanded]

    # -- plans ------------------------------------------------------------------------------------------------------

    def trajectory(self) -> None:
        """A trajectory that nobody has planned: its pieces may be far too quick, or none at all."""
        random = self.random
        here = self.driver.commanded
        kind = random.choice((CUBIC, QUINTIC))
        pace = random.choice((0.1, 0.3, 0.3, 1.0))
        rows, t = [], 0.0
        if random.random() < 0.5:
            rows.append([0.0, *here, *[0.0] * 12, kind])
        for _ in range(random.randrange(1, 8)):
            step = random.uniform(0.1, 0.6)
            t += step
            here = [q + random.uniform(-pace, pace) * step for q in here]
            speed = [random.uniform(-pace, pace) if random.random() < 0.5 else 0.0 for _ in here]
            rows.append([t, *here, *speed, *[0.0] * 6, kind])
        rows[-1][7:13] = [0.0] * 6
        if random.random() < 0.1:
            rows[random.randrange(len(rows))][random.randrange(20)] = random.choice(NONSENSE)
        slot = self.driver.simulation.observer.write_plan(rows)
        self.send(RunTrajectory(self.or_odd(slot), self.or_odd(len(rows))))

    def invade(self) -> None:
        """A smooth trajectory to where a point of the arm would be in a keep-out box, or the tool outside its box."""
        bounds, here = self.driver.bounds, self.driver.commanded
        for _ in range(60):
            near = self._near(0.8)
            there = [max(a, min(b, q)) for q, a, b in zip(near, bounds.low, bounds.high, strict=True)]
            if not is_free(bounds, there):
                break
        else:
            return
        took = 0.1 + max(abs(b - a) for a, b in zip(here, there, strict=True)) / self.random.choice((0.1, 0.25))
        rows = [[t, *q, *[0.0] * 12, QUINTIC] for t, q in ((0.0, here), (took, there))]
        slot = self.driver.simulation.observer.write_plan(rows)
        if self.send(RunTrajectory(slot, len(rows))):
            self.seconds(0.5 * took, took)

    def line(self) -> None:
        """Straight pieces from where the tool is, planned by nobody: out of reach, too quick, through a singularity."""
        random = self.random
        arm = configuration().arm
        if arm is None:
            return
        pose = forward(arm, self.driver.commanded)
        turn = _quaternion(pose.rotation)
        rows, at = [], list(pose.position)
        for _ in range(random.randrange(1, 4)):
            far = random.choice((0.02, 0.1, 0.3))
            to = [x + random.uniform(-far, far) for x in at]
            length = sqrt(sum((b - a) ** 2 for a, b in zip(at, to, strict=True)))
            speed = random.choice((0.05, 0.1, 0.25, 0.5)) / max(length, 1e-3)
            took = 2.0 / speed
            rows.append([*at, *turn, *to, *turn, speed, 4 * speed, 40 * speed, length, took, LINE])
            at = to
        if random.random() < 0.1:
            rows[random.randrange(len(rows))][random.randrange(20)] = random.choice(NONSENSE)
        slot = self.driver.simulation.observer.write_plan(rows)
        self.send(RunLines(self.or_odd(slot), self.or_odd(len(rows))))

    # -- what has to be said again and again --------------------------------------------------------------------------

    def stream(self) -> None:
        """Targets at some rate; late ones, doubled ones, jumps, and an end without a word."""
        random, driver = self.random, self.driver
        interval = random.choice((0.004, 0.01, 0.033, 0.1))
        pace = random.choice((0.1, 0.3, 0.6))
        target = driver.commanded
        velocity = [random.uniform(-pace, pace) for _ in target]
        for _ in range(random.randrange(3, 20)):
            driver.stamp += interval
            if random.random() < 0.1:
                velocity = [random.uniform(-pace, pace) for _ in target]
            target = [q + v * interval for q, v in zip(target, velocity, strict=True)]
            sent = self._near(0.5) if random.random() < 0.03 else target
            stamp = driver.stamp - random.choice((0.0, 0.0, 0.0, 0.0, 0.5, interval))
            q = tuple(self.or_nonsense(q, 0.01) for q in sent)
            taken = self.send(StreamPosition(q, self.or_nonsense(stamp, 0.01)))
            if not self.goes_on(taken):
                return
            driver.wait(max(1, int(interval * random.uniform(0.5, 1.5) / self._period_s)))

    def jog(self) -> None:
        """Speeds of the tool or of joints, held for a while."""
        random = self.random
        frame = random.choice(list(JogFrame))
        speeds = [
            random.choice((0.0, 0.0, 1.0, -1.0))
            * (random.choice((0.05, 0.1, 0.2, 0.3)) if frame is JogFrame.JOINTS or axis > 2 else 0.1)
            for axis in range(6)
        ]
        for _ in range(random.randrange(1, 9)):
            velocity = tuple(self.or_nonsense(v, 0.01) for v in speeds)
            if not self.goes_on(self.send(Jog(velocity, frame, self.or_nonsense(HOLD_S, 0.01)))):
                return
            self.seconds(0.02, 0.15)
            if random.random() < 0.1:
                speeds[random.randrange(6)] *= -1.0

    def velocity(self) -> None:
        """Joint speeds."""
        random = self.random
        for _ in range(random.randrange(1, 5)):
            speeds = [random.choice((0.0, random.uniform(-0.5, 0.5), 0.5)) for _ in range(6)]
            velocity = tuple(self.or_nonsense(v, 0.01) for v in speeds)
            hold_s = self.or_nonsense(random.choice((0.1, 0.5, 1.0)), 0.02)
            if not self.goes_on(self.send(MoveAtVelocity(velocity, hold_s))):
                return
            self.seconds(0.02, 0.4)

    def torque(self) -> None:
        """Joint torques, with or without an impedance about where the arm was."""
        random = self.random
        for _ in range(random.randrange(1, 5)):
            size = random.choice((1.0, 5.0, 20.0))
            torques = [random.uniform(-size, size) for _ in range(6)]
            torque = tuple(self.or_nonsense(v, 0.01) for v in torques)
            stiffness, damping = random.choice((0.0, 0.5, 1.0)), random.choice((0.0, 1.0))
            hold_s = self.or_nonsense(random.choice((0.1, 0.5)), 0.02)
            if not self.goes_on(self.send(ApplyTorque(torque, stiffness, damping, hold_s))):
                return
            self.seconds(0.02, 0.4)

    # -- limits -----------------------------------------------------------------------------------------------------

    def limits(self) -> None:
        """Narrower ones, now and then too narrow for the arm, too wide, or none at all; or those of the start again."""
        random, driver = self.random, self.driver
        old = driver.limits
        widest = Values.configured(driver.simulation.config)
        if random.random() < 0.2:
            driver.set_limits(widest)
            return
        here = driver.commanded
        share = random.choice((0.2, 0.6, 0.9, 1.1))
        changes: dict[str, object] = {}
        if random.random() < 0.5:
            low = [self.or_nonsense(q + share * (a - q), 0.005) for q, a in zip(here, widest.low, strict=True)]
            high = [self.or_nonsense(q + share * (b - q), 0.005) for q, b in zip(here, widest.high, strict=True)]
            changes |= {"low": tuple(low), "high": tuple(high)}
        for name in ("velocity", "acceleration", "jerk", "torque"):
            if random.random() < 0.3:
                scale = random.choice((0.3, 0.7, 1.0, 1.0, 1.1))
                changes[name] = tuple(self.or_nonsense(scale * x, 0.005) for x in getattr(widest, name))
        if random.random() < 0.3 and widest.box is not None:
            by = random.choice((0.05, 0.2, -0.1))
            changes["box"] = tuple(x + (by if at < 3 else -by) for at, x in enumerate(widest.box))
        if random.random() < 0.3:
            by = random.choice((0.02, 0.1, -0.1))
            changes["keep_out"] = tuple(
                tuple(x - by if at < 3 else x + by for at, x in enumerate(box)) for box in widest.keep_out
            )
        driver.set_limits(replace(old, **changes))  # type: ignore[arg-type]

    # -- a hand at the arm ------------------------------------------------------------------------------------------

    def stick(self) -> None:
        """Push the stick, change modes, and now and then show what is no code."""
        random, driver = self.random, self.driver
        for _ in range(random.randrange(1, 6)):
            driver.stick(random.choice(STICK) if random.random() < 0.9 else random.randrange(256))
            self.seconds(0.0, 0.4)
            if random.random() < 0.6:
                driver.stick(63)
                self.seconds(0.0, 0.1)
        if random.random() < 0.7:
            driver.stick(63)

    def toggle(self) -> None:
        """Give the stick to the chair for a while."""
        self.driver.toggle(False)
        self.seconds(0.0, 0.3)
        self.driver.toggle(True)

    def emergency(self) -> None:
        """Press the emergency stop, and mostly reset it later."""
        self.driver.press(True)
        self.seconds(0.0, 0.6)
        self.driver.press(False)
        self.seconds(0.0, 0.1)
        if self.random.random() < 0.8:
            self.send(Reset())
            self.driver.simulation.until(lambda: self.driver.state is not State.RESETTING, 0.5)


def _quaternion(rotation: object) -> list[float]:
    """w, x, y, z of a rotation, by its largest component (nine numbers, row by row)."""
    (a, b, c), (d, e, f), (g, h, i) = _rows(rotation)
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    at = squares.index(max(squares))
    size = sqrt(squares[at])
    mixed = (
        (size, (h - f) / size, (c - g) / size, (d - b) / size),
        ((h - f) / size, size, (b + d) / size, (c + g) / size),
        ((c - g) / size, (b + d) / size, size, (f + h) / size),
        ((d - b) / size, (c + g) / size, (f + h) / size, size),
    )
    return [0.5 * part for part in mixed[at]]


def _rows(rotation: object) -> list[list[float]]:
    flat = [float(x) for row in rotation for x in (row if hasattr(row, "__iter__") else (row,))]  # type: ignore[attr-defined]
    return [flat[0:3], flat[3:6], flat[6:9]]
