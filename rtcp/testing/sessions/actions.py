"""Random actions of a session on any bus: commands that follow one another, and a hand on the joystick."""

from __future__ import annotations

from math import inf, nan
from random import Random

from rtcp.config.model import ControlModeName
from rtcp.ipc import commands
from rtcp.ipc.states import DriveMode, JogFrame

NONSENSE = (nan, inf, -inf, 1e308, -1e308, 1e300, -1e300, 1e9, -1e9, 5e-324, -5e-324, 0.0)
CONTROL_MODES: tuple[ControlModeName, ...] = ("joint", "cartesian", "joystick", "velocity", "torque")
SHARES = (3, 3, 2, 1, 1)
"""How often each of them is chosen."""
JOYSTICK = (63, 62, 61, 59, 55, 47, 31)
"""Levels at the inputs of a joystick that is active low: forward is bit 0; the first is neutral."""


class RandomActions:
    """Actions that follow from random numbers alone; how they reach the arm is the subclass's part."""

    pauses: tuple[float, float] = (0.02, 0.15)
    """Seconds between two commands of a stream."""
    joints = 6
    """Number of joints."""

    def __init__(self, random: Random) -> None:
        self.random = random
        self.stamp = 0.0

    # -- how it reaches the arm -------------------------------------------------------------------------------------

    @property
    def commanded(self) -> list[float]:
        """The last targets, rad."""
        raise NotImplementedError

    def send(self, command: commands.Command) -> bool:
        """Send a command; return whether it was accepted."""
        raise NotImplementedError

    def seconds(self, least: float, most: float) -> None:
        """Let time pass."""
        raise NotImplementedError

    def show(self, code: int, seconds: float) -> None:
        """Show a byte at the joystick's inputs for a random time, at most `seconds`."""
        raise NotImplementedError

    def leave(self) -> None:
        """End a stream."""

    # -- numbers ----------------------------------------------------------------------------------------------------

    def or_nonsense(self, number: float, share: float = 0.02) -> float:
        """Return the number, or now and then one that nobody should send."""
        return self.random.choice(NONSENSE) if self.random.random() < share else number

    def some(self, numbers: list[float], share: float = 0.01) -> tuple[float, ...]:
        """Return the numbers, now and then with one among them that nobody should send."""
        return tuple(self.or_nonsense(number, share) for number in numbers)

    def near(self, by: float) -> list[float]:
        """Return a place near the last targets."""
        return [q + self.random.uniform(-by, by) for q in self.commanded]

    def waypoints(self, paces: tuple[float, ...], most: int) -> list[tuple[float, list[float]]]:
        """Return times and places on a random way from the last targets."""
        random, found, t, here = self.random, [], 0.0, self.commanded
        pace = random.choice(paces)
        for _ in range(random.randrange(1, most)):
            step = random.uniform(0.1, 0.8)
            t += step
            here = [q + random.uniform(-pace, pace) * step for q in here]
            found.append((t, here))
        return found

    # -- actions ----------------------------------------------------------------------------------------------------

    def command(self) -> None:
        """Something short, whether or not it is allowed."""
        random = self.random
        self.send(
            random.choice(
                (
                    commands.Enable(), commands.Disable(), commands.Reset(), commands.Halt(), commands.Halt(),
                    commands.SetDriveMode(random.choice(list(DriveMode))),
                    commands.SetOutput(random.randrange(0, 18), random.random() < 0.5),
                    commands.MoveGripper(random.random() < 0.5),
                )
            )
        )  # fmt: skip

    def _goes_on(self, accepted: bool) -> bool:
        """Let a pause pass; return whether a commander continues: not for long where it was refused."""
        self.seconds(*self.pauses)
        return accepted or self.random.random() < 0.5

    def jog(self) -> None:
        """Speeds of the tool or of joints, held for a while."""
        random = self.random
        frame = random.choice(list(JogFrame))
        count = self.joints if frame is JogFrame.JOINTS else 6
        speeds = [
            random.choice((0.0, 0.0, 1.0, -1.0))
            * (random.choice((0.05, 0.1, 0.2, 0.4)) if frame is JogFrame.JOINTS or axis > 2 else 0.1)
            for axis in range(count)
        ]
        for _ in range(random.randrange(1, 10)):
            hold_s = self.or_nonsense(random.choice((0.1, 0.25)), 0.01)
            if not self._goes_on(self.send(commands.Jog(self.some(speeds), frame, hold_s))):
                break
            if random.random() < 0.1:
                speeds[random.randrange(count)] *= -1.0
        self.leave()

    def velocity(self) -> None:
        """Joint speeds."""
        random = self.random
        for _ in range(random.randrange(1, 6)):
            speeds = [random.choice((0.0, random.uniform(-0.5, 0.5), 0.5)) for _ in range(self.joints)]
            hold_s = self.or_nonsense(random.choice((0.1, 0.5, 1.0)))
            if not self._goes_on(self.send(commands.MoveAtVelocity(self.some(speeds), hold_s))):
                break
            self.seconds(0.0, 0.3)
        self.leave()

    def torque(self) -> None:
        """Joint torques, with or without an impedance about where the arm was; or an arm that is guided by hand."""
        random = self.random
        if random.random() < 0.3:
            if self._goes_on(self.send(commands.Guide(self.or_nonsense(random.choice((0.0, 0.3, 1.0)))))):
                self.seconds(0.0, 1.0)
            self.leave()
            return
        for _ in range(random.randrange(1, 6)):
            size = random.choice((1.0, 5.0, 20.0))
            torque = self.some([random.uniform(-size, size) for _ in range(self.joints)])
            stiffness, damping = random.choice((0.0, 0.5, 1.0)), random.choice((0.0, 1.0))
            hold_s = self.or_nonsense(random.choice((0.1, 0.5)))
            if not self._goes_on(self.send(commands.ApplyTorque(torque, stiffness, damping, hold_s))):
                break
            self.seconds(0.0, 0.3)
        self.leave()

    def stream(self) -> None:
        """Targets at some rate; late ones, doubled ones, jumps, and an end without notice."""
        random = self.random
        interval, pace = random.choice((0.004, 0.01, 0.033, 0.1)), random.choice((0.1, 0.3, 0.6))
        target = self.commanded
        velocity = [random.uniform(-pace, pace) for _ in target]
        for _ in range(random.randrange(3, 30)):
            self.stamp += interval
            if random.random() < 0.1:
                velocity = [random.uniform(-pace, pace) for _ in target]
            target = [q + v * interval for q, v in zip(target, velocity, strict=True)]
            sent = self.near(0.5) if random.random() < 0.03 else target
            stamp = self.stamp - random.choice((0.0, 0.0, 0.0, 0.0, 0.5, interval))
            accepted = self.send(commands.StreamPosition(self.some(sent), self.or_nonsense(stamp, 0.01)))
            self.seconds(0.5 * interval, 1.5 * interval)
            if not accepted and random.random() < 0.4:
                break
        self.leave()

    def joystick(self) -> None:
        """Deflect the joystick, change its modes, and now and then show what is no code."""
        random = self.random
        for _ in range(random.randrange(1, 6)):
            self.show(
                random.choice(JOYSTICK) if random.random() < 0.9 else random.randrange(256), random.uniform(0, 0.5)
            )
            if random.random() < 0.6:
                self.show(JOYSTICK[0], 0.05)
        if random.random() < 0.7:
            self.show(JOYSTICK[0], 0.05)
