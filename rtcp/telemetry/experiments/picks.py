"""Pick and place by the joystick as in the thesis, by a simulated person; the same task as a computed trajectory."""

from __future__ import annotations

import random
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import copysign, dist, hypot, pi
from typing import Any, Protocol

import numpy as np

from kinematics.forward import forward, forward_batch
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.api import Robot, State, TimedOut
from rtcp.ipc.events import JOYSTICK_MODES
from rtcp.telemetry.experiments.experiment import SPEED_RAD_S, Experiment, ExperimentFailed, Row, Setup
from rtcp.telemetry.experiments.motions import geometry
from rtcp.telemetry.reading import Recorded, read

Point = tuple[float, float, float]

BASE_ABOVE_GROUND_M = 0.45
NEUTRAL, FORWARD, BACKWARD, LEFT, RIGHT, PADDLE_UP, PADDLE_DOWN = 63, 62, 61, 59, 55, 47, 31
ITEMS: Mapping[str, Point] = {
    "table": (-0.55, -0.20, 0.72 - BASE_ABOVE_GROUND_M),
    "ground": (-0.50, 0.15, 0.05 - BASE_ABOVE_GROUND_M),
    "shelf": (-0.65, 0.2375, 0.80 - BASE_ABOVE_GROUND_M),
}
"""Positions of the items from the base, m; as in the thesis the highest 0.8 m above ground, the furthest 0.692 m."""
_ASIDE_M = 0.15
"""Distance from an item to the place where it is put, m, towards the middle."""
LEVEL = Pose.from_xyzrpy(-0.5, 0.0, 0.3, 0.0, -pi / 2, 0.0)
"""First pose of the tool: the gripper level, pointing away from the user."""
LIFT_M = 0.1
MOST_BESIDE_M = 0.02
"""Largest distance of the gripper from an item, and of the item from its place, with which a task is done, m."""
AIM_S = 60.0
"""Time in which the thesis' users did each task, s."""

REACTION_S, REACTION_SPREAD, TIMING_ERROR = 0.25, 0.2, 0.1
"""Reaction time of the simulated person, s; relative standard deviations of it, and of how long the person holds."""
_SETTLE_S = 0.3
"""Time for which the person watches the tool come to rest, s."""
_PRESS_S = 0.1
_LEAST_HOLD_S = 0.03
_NEAR_M = 0.004
_MOST_PUSHES = 400


def placed_at(item: Point) -> Point:
    """Return where an item is put, m."""
    x, y, z = item
    return x, y - copysign(_ASIDE_M, y), z


def lines(item: str, height: float) -> tuple[list[Point], list[Point], list[Point]]:
    """Return the ends of the straight lines to an item, on to its place, and away from it, m: the joystick's way.

    Args:
        item: one of `ITEMS`.
        height: of the tool at the begin, m: the tool goes to the item level first.
    """
    (x, y, z), (to_x, to_y, to_z) = ITEMS[item], placed_at(ITEMS[item])
    lifted = (to_x, to_y, to_z + LIFT_M)
    return [(x, y, height), (x, y, z)], [(x, y, z + LIFT_M), lifted, (to_x, to_y, to_z)], [lifted]


def begin_pose(model: ArmModel) -> tuple[float, ...]:
    """Return the joint positions, rad, at the begin of the tasks; raises ExperimentFailed."""
    joints = InverseKinematics(model).solve_near(LEVEL, (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)).q
    if joints is None:
        raise ExperimentFailed("the arm does not reach the pose from which the picks begin")
    return tuple(joints)


class Arm(Protocol):
    """A person's view of the arm, and the joystick."""

    @property
    def tool(self) -> Point:
        """Position of the tool, m."""

    @property
    def mode(self) -> int:
        """Mode of the joystick: 0 X-Y, 1 Z-yaw, 2 roll-pitch, 3 gripper."""

    def hold(self, code: int, seconds: float) -> None:
        """Hold the joystick at the byte `code` for a time, s."""


class Person:
    """A simulated person who looks at the tool, moves the joystick, watches the tool come to rest, and looks again.

    Each look is followed by a reaction time before the hand moves. From practice the person knows how far the tool goes
    while the joystick is held, and holds it so long, with a relative error; what is left over is corrected after the
    next look.

    Args:
        arm: the arm and the joystick, the arm's only command.
        speed: of the tool under the joystick, m/s.
        acceleration: of the tool, m/s^2.
        jerk: of the tool, m/s^3.
        reaction_s: mean reaction time, s.
        seed: of the person's spread.
    """

    def __init__(
        self,
        arm: Arm,
        speed: float = 0.1,
        acceleration: float = 0.5,
        jerk: float = 5.0,
        reaction_s: float = REACTION_S,
        seed: int = 0,
    ) -> None:
        self._arm = arm
        self._speed, self._acceleration, self._jerk = speed, acceleration, jerk
        self._reaction_s = reaction_s
        self._random = random.Random(seed)

    def pick(self, item: Point) -> Point:
        """Pick an item and lift it; return the tool's position when the gripper closed, m."""
        self._grip(close=False)
        self._bring(item)
        closed_at = self._arm.tool
        self._grip(close=True)
        self._bring((item[0], item[1], item[2] + LIFT_M))
        return closed_at

    def place(self, at: Point) -> Point:
        """Put the item down at a place and lift the gripper; return the tool's position when it opened, m."""
        self._bring((at[0], at[1], at[2] + LIFT_M))
        self._bring(at)
        opened_at = self._arm.tool
        self._grip(close=False)
        self._bring((at[0], at[1], at[2] + LIFT_M))
        return opened_at

    def _react(self) -> None:
        spread = self._random.gauss(1.0, REACTION_SPREAD)
        self._arm.hold(NEUTRAL, self._reaction_s * min(max(spread, 0.4), 2.0))

    def _choose(self, mode: int) -> None:
        for _ in range(_MOST_PUSHES):
            ahead = (mode - self._arm.mode) % len(JOYSTICK_MODES)
            if not ahead:
                return
            self._arm.hold(PADDLE_UP if ahead <= len(JOYSTICK_MODES) // 2 else PADDLE_DOWN, _PRESS_S)
            self._react()
        raise ExperimentFailed(f"the joystick does not change from mode {self._arm.mode} to {mode}")

    def _bring(self, target: Point) -> None:
        if any(abs(target[axis] - self._arm.tool[axis]) > _NEAR_M for axis in (0, 1)):
            self._choose(0)
            self._push(target, ((0, FORWARD, BACKWARD), (1, LEFT, RIGHT)))
        self._choose(1)
        self._push(target, ((2, BACKWARD, FORWARD),))

    def _push(self, target: Point, ways: tuple[tuple[int, int, int], ...]) -> None:
        for _ in range(_MOST_PUSHES):
            code, nearest = NEUTRAL, 0.0
            for axis, plus, minus in ways:
                error = target[axis] - self._arm.tool[axis]
                if abs(error) > _NEAR_M:
                    # Active low: a direction clears its bit.
                    code &= plus if error > 0 else minus
                    nearest = min(nearest or abs(error), abs(error))
            if code == NEUTRAL:
                return
            self._react()
            self._arm.hold(code, max(_LEAST_HOLD_S, self._held_s(nearest) * self._random.gauss(1.0, TIMING_ERROR)))
            self._arm.hold(NEUTRAL, _SETTLE_S)
        raise ExperimentFailed(f"the tool is at {self._arm.tool}, not at {target}")

    def _held_s(self, distance: float) -> float:
        """Return for how long the joystick is held until the tool rests at a distance, m."""
        short_s = self._acceleration / self._jerk  # until then the acceleration still rises
        short, long = 2 * self._jerk * short_s**3, self._speed * (self._speed / self._acceleration + short_s)
        if distance <= short:
            return float((distance / (2 * self._jerk)) ** (1 / 3))
        if distance >= long:
            return distance / self._speed
        return short_s + (distance - short) / (long - short) * (long / self._speed - short_s)

    def _grip(self, close: bool) -> None:
        self._choose(3)
        self._react()
        self._arm.hold(BACKWARD if close else FORWARD, _PRESS_S)
        self._arm.hold(NEUTRAL, _PRESS_S)


class _VirtualJoystick:
    """The arm of a running platform, with its virtual joystick moved by requests."""

    def __init__(self, robot: Robot, model: ArmModel) -> None:
        self._robot = robot
        self._model = model

    @property
    def tool(self) -> Point:
        return forward(self._model, self._robot.status().positions).position

    @property
    def mode(self) -> int:
        return JOYSTICK_MODES.index(self._robot.status().raw["joystick"]["mode"])

    def hold(self, code: int, seconds: float) -> None:
        until = time.monotonic() + seconds
        while True:
            with suppress(TimedOut):  # late on a busy host, without effect: the person sees that, and corrects it
                self._robot.joystick(byte=code, hold_s=1.0)
            remaining_s = until - time.monotonic()
            time.sleep(max(0.0, min(remaining_s, 0.4)))
            if remaining_s <= 0.4:
                return


@dataclass(frozen=True)
class Done:
    """A task that was carried out: where the gripper closed and opened, m, its time, s, and its recording."""

    item: str
    closed_at: Point
    opened_at: Point
    seconds: float
    recorded: Recorded

    @property
    def beside_m(self) -> tuple[float, float]:
        """Distance of the gripper from the item, and of the item from its place, m."""
        item = ITEMS[self.item]
        return dist(self.closed_at, item), dist(self.opened_at, placed_at(item))

    @property
    def succeeded(self) -> bool:
        """Whether the item was picked and put in its place."""
        return max(self.beside_m) <= MOST_BESIDE_M


_SIGNALS = ("sent_position", "actual_position", "actual_velocity", "actual_torque", "io_*")


def by_joystick(setup: Setup, robot: Robot, item: str, name: str, seed: int = 0) -> Done:
    """Pick and place an item by the bytes of the virtual joystick alone; the recording is `name`."""
    model = geometry(setup)
    robot.mode("joint")
    robot.move_joints(begin_pose(model), speed=SPEED_RAD_S)
    robot.mode("joystick")
    cartesian, jog = setup.arm.cartesian, setup.arm.jog
    person = Person(_VirtualJoystick(robot, model), jog.speed, cartesian.acceleration, cartesian.jerk, seed=seed)
    with setup.recording(robot, name, _SIGNALS) as path:
        begun = time.monotonic()
        closed_at = person.pick(ITEMS[item])
        opened_at = person.place(placed_at(ITEMS[item]))
        seconds = time.monotonic() - begun
    while robot.status().state is State.MOVING:  # the mode changes at rest only
        time.sleep(0.05)
    robot.mode("joint")
    return Done(item, closed_at, opened_at, seconds, read(path, _SIGNALS))


def by_trajectory(setup: Setup, robot: Robot, item: str, name: str) -> Done:
    """Pick and place an item on computed straight lines, at the speed of the joystick; the recording is `name`."""
    model = geometry(setup)
    begin = begin_pose(model)
    robot.mode("joint")
    robot.move_joints(begin, speed=SPEED_RAD_S)
    begin_pose_of_tool = robot.fk(begin)
    to_item, to_place, away = lines(item, begin_pose_of_tool[2])

    def follow(points: Sequence[Point]) -> Point:
        robot.move_line([[*point, *begin_pose_of_tool[3:]] for point in points], setup.arm.jog.speed)
        return forward(model, robot.status().positions).position

    with setup.recording(robot, name, _SIGNALS) as path:
        begun = time.monotonic()
        robot.gripper(open=True)
        closed_at = follow(to_item)
        robot.gripper(open=False)
        opened_at = follow(to_place)
        robot.gripper(open=True)
        follow(away)
        seconds = time.monotonic() - begun
    return Done(item, closed_at, opened_at, seconds, read(path, _SIGNALS))


class PicksExperiment(Experiment):
    """Items picked and placed by joystick bytes alone: from the table, the ground and the shelf.

    Args:
        items: some of `ITEMS`.
    """

    name = "picks"
    title = "Pick and place by joystick"

    def __init__(self, items: Sequence[str] = tuple(ITEMS)) -> None:
        self._items = items

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; with a real arm a person holds the joystick, so this needs the virtual one."""
        require_virtual(setup)
        picked = []
        with setup.platform() as robot:
            for name in self._items:
                done = by_joystick(setup, robot, name, f"recording-{name}")
                picked.append(done.closed_at)
                at_item, at_place = (1e3 * away for away in done.beside_m)
                setup.report(
                    f"{name}: picked {at_item:.1f} mm from the item and placed {at_place:.1f} mm from its place in "
                    f"{done.seconds:.0f} s"
                )
                yield Row(f"{name}: distance to the item", "mm", at_item, most=1e3 * MOST_BESIDE_M)
                yield Row(f"{name}: distance to its place", "mm", at_place, most=1e3 * MOST_BESIDE_M)
                yield Row(f"{name}: completion time", "s", done.seconds, "below 60", most=AIM_S)
                self._draw(setup, geometry(setup), done)
        yield Row("highest item above ground", "m", max(z for _, _, z in picked) + BASE_ABOVE_GROUND_M, 0.8)
        yield Row("furthest item", "m", max(hypot(x, y) for x, y, _ in picked), 0.692)

    @staticmethod
    def _draw(setup: Setup, model: ArmModel, done: Done) -> None:
        from matplotlib.figure import Figure

        records = done.recorded.records[:: max(1, len(done.recorded.records) // 2000)]
        seconds = (records["time_ns"] - records["time_ns"][0]) * 1e-9
        figure = Figure(figsize=(13.0, 8.0), layout="constrained")
        grid = figure.add_gridspec(3, 5)
        space: Any = figure.add_subplot(grid[:, :2], projection="3d")
        lines = (("sent_position", "red", 4.0, "target"), ("actual_position", "blue", 1.5, "actual"))
        for field, colour, width, label in lines:
            points = forward_batch(model, records[field].astype(np.float64))[0]
            space.plot(*points.T, ls=":", lw=width, color=colour, label=label)
        for at, label in ((ITEMS[done.item], "item"), (placed_at(ITEMS[done.item]), "its place")):
            space.scatter(*at, s=50, label=label)
        middle, half = 0.5 * (points.max(axis=0) + points.min(axis=0)), 0.55 * np.ptp(points, axis=0).max()
        for axis, at in zip("xyz", middle, strict=True):
            getattr(space, f"set_{axis}lim")(at - half, at + half)
            getattr(space, f"set_{axis}label")(f"{axis}, m", labelpad=10)
        space.set_title(f"tool, {done.item}")
        space.set_box_aspect((1, 1, 1), zoom=0.85)
        space.legend(loc="upper left", fontsize=8)
        colours = [f"C{at}" for at in range(records["actual_position"].shape[1])]
        for row, (field, unit) in enumerate(
            (("actual_position", "angle, rad"), ("actual_torque", "torque, Nm"), ("actual_velocity", "speed, rad/s"))
        ):
            axes = figure.add_subplot(grid[row, 2:])
            for joint, colour in enumerate(colours):
                axes.plot(seconds, records[field][:, joint], lw=0.9, color=colour, label=f"joint {joint + 1}")
            if field == "actual_position":
                targets = axes.plot(seconds, records["sent_position"], ls=":", lw=1.2, color="red")
                targets[0].set_label("targets")
                axes.legend(ncols=7, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, 1.2), frameon=False)
            axes.set(ylabel=unit, xlim=(0.0, float(seconds[-1])))
            axes.grid(alpha=0.3)
        axes.set(xlabel="time, s")
        setup.draw(f"pick-{done.item}", figure)


def require_virtual(setup: Setup) -> None:
    """Refuse a real arm, whose joystick only a person can move; raises ExperimentFailed."""
    if not setup.is_virtual:
        raise ExperimentFailed(
            "the simulated person needs the virtual arm: on a real one a person moves the joystick (`rtcp user-trial`)"
        )
