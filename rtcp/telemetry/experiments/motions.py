"""Experiments that move the arm as in the thesis: the step, the square, the picks by joystick."""

from __future__ import annotations

import time
from collections.abc import Mapping
from math import dist, pi
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from kinematics.forward import forward
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose
from rtcp.api import Robot
from rtcp.ipc.events import JOYSTICK_MODES
from rtcp.telemetry.experiments.experiment import SPEED_RAD_S, Experiment, ExperimentFailed, Row, Setup, returned
from rtcp.telemetry.reading import read
from rtcp.telemetry.square import SPEED_M_S, NoSquare, draw, judge, place

Array = npt.NDArray[np.float64]

STEP_RAD, STEP_SPEED = 1.35, 0.2
SOURCE_ERROR_RAD = 0.0007


def geometry(setup: Setup) -> ArmModel:
    """Return the arm's geometry; raises ExperimentFailed where it is unknown."""
    model = setup.arm.arm
    if model is None:
        raise ExperimentFailed("the arm's geometry is not known (key kinematics)")
    return model


class StepExperiment(Experiment):
    """A step of 1.35 rad of joint 1 at 0.2 rad/s."""

    name = "step"
    title = "Step of 1.35 rad at 0.2 rad/s"

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        with setup.platform() as robot:
            start = robot.status().positions
            sign = 1.0 if start[0] + STEP_RAD <= setup.arm.joints[0].position.max else -1.0
            goal = start[0] + sign * STEP_RAD
            with setup.recording(robot) as path:
                robot.move_joints([goal, *start[1:]], speed=STEP_SPEED)
                time.sleep(0.5)
            robot.move_joints(start, speed=SPEED_RAD_S)
        recorded = read(path, ("wkc*", "commanded_position", "actual_position"))
        # A cycle whose frame does not return holds the setpoints: its time does not count.
        records = recorded.records[returned(recorded.records)]
        commanded, actual = records["commanded_position"][:, 0], records["actual_position"][:, 0]
        moving = np.flatnonzero(np.diff(commanded))
        if not len(moving):
            raise ExperimentFailed("joint 1 was not commanded to move")
        seconds = np.arange(len(records)) * recorded.period_s
        begun = moving[0]
        away = np.flatnonzero(np.abs(actual - goal) > SOURCE_ERROR_RAD)
        if len(away) and away[-1] + 1 == len(actual):
            raise ExperimentFailed("joint 1 did not settle while it was recorded")
        settled_s = float(seconds[away[-1] + 1] - seconds[begun]) if len(away) else 0.0
        beyond = float((sign * (actual - goal)).max())
        last = actual[-round(0.2 / recorded.period_s) :]
        self._draw(setup, seconds - seconds[begun], commanded, actual, goal)
        return [
            Row("settling within 0.0007 rad", "s", settled_s, "about 6", most=7.5),
            Row("overshoot", "%", 100.0 * max(beyond, 0.0) / STEP_RAD, most=0.1),
            Row(
                "steady-state error", "rad", float(np.abs(last - goal).mean()), SOURCE_ERROR_RAD, most=SOURCE_ERROR_RAD
            ),
        ]

    @staticmethod
    def _draw(setup: Setup, seconds: Array, commanded: Array, actual: Array, goal: float) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 6.0), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        above.plot(seconds, commanded, label="commanded")
        above.plot(seconds, actual, label="actual")
        above.axhline(goal, color="0.6", lw=0.8, label="goal")
        above.set(ylabel="joint 1, rad")
        above.legend()
        below.plot(seconds, 1e3 * (commanded - actual), lw=0.8)
        below.set(xlabel="time, s", ylabel="following error, mrad")
        for axes in (above, below):
            axes.grid(alpha=0.3)
        setup.draw("step", figure)


class SquareExperiment(Experiment):
    """The square of 200 mm at 50 mm/s in a plane.

    Args:
        planes: some of `xy`, `yz`, `xz`.
    """

    name = "square"
    title = "Square of 200 x 200 mm at 50 mm/s"

    def __init__(self, planes: tuple[str, ...] = ("xy", "yz")) -> None:
        self._planes = planes

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        model, rows = geometry(setup), []
        try:
            squares = [place(setup.arm, plane) for plane in self._planes]
            with setup.platform() as robot:
                home = robot.status().positions
                for square in squares:
                    robot.move_joints(square.start, speed=SPEED_RAD_S)
                    with setup.recording(robot, f"recording-{square.plane}") as path:
                        robot.move_line(square.poses, SPEED_M_S)
                    driven = judge(model, square, read(path, ("wkc*", "*_position", "*_velocity", "*_torque")))
                    for ending in ("png", "svg"):
                        draw(driven, setup.folder / f"square-{square.plane}.{ending}")
                    setup.pictures.append(f"square-{square.plane}")
                    commanded, actual = (1e3 * worst for worst in driven.worst)
                    rows += [
                        Row(f"{square.plane}: largest deviation, commanded", "mm", commanded, most=1.0),
                        Row(f"{square.plane}: largest deviation, actual", "mm", actual, "tracked", most=3.0),
                    ]
                robot.move_joints(home, speed=SPEED_RAD_S)
        except NoSquare as error:
            raise ExperimentFailed(str(error)) from error
        return rows


# -- picks by joystick -----------------------------------------------------------------------------------------------

BASE_ABOVE_GROUND_M = 0.45
NEUTRAL, FORWARD, BACKWARD, LEFT, RIGHT, PADDLE_UP = 63, 62, 61, 59, 55, 47
ITEMS: Mapping[str, tuple[float, float, float]] = {
    "table": (-0.55, -0.20, 0.72 - BASE_ABOVE_GROUND_M),
    "ground": (-0.50, 0.15, 0.05 - BASE_ABOVE_GROUND_M),
    "shelf": (-0.65, 0.2375, 0.80 - BASE_ABOVE_GROUND_M),
}
"""Positions of the items from the base, m; as in the thesis the highest 0.8 m above ground, the furthest 0.692 m."""
LEVEL = Pose.from_xyzrpy(-0.5, 0.0, 0.3, 0.0, -pi / 2, 0.0)
"""First pose of the tool: the gripper level, pointing away from the user."""
LIFT_M = 0.1
_NEAR_M, _FAR_M = 0.004, 0.04
_MOST_PUSHES = 400


def begin_pose(model: ArmModel) -> tuple[float, ...]:
    """Return the joint positions, rad, at the begin of the picks; raises ExperimentFailed."""
    joints = InverseKinematics(model).solve_near(LEVEL, (0.0, 0.23, 2.38, 0.0, 0.57, 0.0)).q
    if joints is None:
        raise ExperimentFailed("the arm does not reach the pose from which the picks begin")
    return tuple(joints)


class Arm(Protocol):
    """A person's view of the arm, and the joystick."""

    @property
    def tool(self) -> tuple[float, float, float]:
        """Position of the tool, m."""

    @property
    def mode(self) -> int:
        """Mode of the joystick: 0 X-Y, 1 Z-yaw, 2 roll-pitch, 3 gripper."""

    def hold(self, code: int, seconds: float) -> None:
        """Hold the joystick at the byte `code` for a time, s."""


class Person:
    """A simulated person who observes the tool and moves the joystick, the arm's only command."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    def pick(self, item: tuple[float, float, float]) -> tuple[float, float, float]:
        """Pick an item and lift it; return the tool's position when the gripper closed, m."""
        self._grip(close=False)
        self._bring(item)
        closed_at = self._arm.tool
        self._grip(close=True)
        self._bring((item[0], item[1], item[2] + LIFT_M))
        self._arm.hold(NEUTRAL, 0.5)
        return closed_at

    def _choose(self, mode: int) -> None:
        for _ in range(_MOST_PUSHES):
            if self._arm.mode == mode:
                return
            self._arm.hold(PADDLE_UP, 0.05)
            self._arm.hold(NEUTRAL, 0.05)
        raise ExperimentFailed(f"the joystick does not change from mode {self._arm.mode} to {mode}")

    def _bring(self, target: tuple[float, float, float]) -> None:
        self._choose(0)
        self._push(target, ((0, FORWARD, BACKWARD), (1, LEFT, RIGHT)))
        self._choose(1)
        self._push(target, ((2, BACKWARD, FORWARD),))

    def _push(self, target: tuple[float, float, float], ways: tuple[tuple[int, int, int], ...]) -> None:
        for _ in range(_MOST_PUSHES):
            code, far = NEUTRAL, 0.0
            for axis, plus, minus in ways:
                error = target[axis] - self._arm.tool[axis]
                if abs(error) > _NEAR_M:
                    # Active low: a direction clears its bit.
                    code &= plus if error > 0 else minus
                    far = max(far, abs(error)) if far == 0.0 else min(far, abs(error))
            if code == NEUTRAL:
                return
            self._arm.hold(code, 0.1 if far > _FAR_M else 0.03)
            if far <= _FAR_M:
                self._arm.hold(NEUTRAL, 0.35)
        raise ExperimentFailed(f"the tool is at {self._arm.tool}, not at {target}")

    def _grip(self, close: bool) -> None:
        self._choose(3)
        self._arm.hold(BACKWARD if close else FORWARD, 0.1)
        self._arm.hold(NEUTRAL, 0.1)


class _VirtualJoystick:
    """The arm of a running platform, with its virtual joystick moved by requests."""

    def __init__(self, robot: Robot, model: ArmModel) -> None:
        self._robot = robot
        self._model = model

    @property
    def tool(self) -> tuple[float, float, float]:
        return forward(self._model, self._robot.status().positions).position

    @property
    def mode(self) -> int:
        return JOYSTICK_MODES.index(self._robot.status().raw["joystick"]["mode"])

    def hold(self, code: int, seconds: float) -> None:
        self._robot.joystick(byte=code, hold_s=min(max(2 * seconds, 0.5), 1.0))
        time.sleep(seconds)


class PicksExperiment(Experiment):
    """Three items picked by joystick bytes alone: from the table, the ground and the shelf.

    Args:
        items: some of `ITEMS`.
    """

    name = "picks"
    title = "Three picks by joystick"

    def __init__(self, items: tuple[str, ...] = tuple(ITEMS)) -> None:
        self._items = items

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`; with a real arm a person holds the joystick, so this needs the virtual one."""
        if not setup.is_virtual:
            raise ExperimentFailed("the picks need the virtual arm: on a real one a person moves the joystick")
        model, rows, paths, picked = geometry(setup), [], {}, []
        with setup.platform() as robot:
            for name in self._items:
                robot.move_joints(begin_pose(model), speed=SPEED_RAD_S)
                robot.mode("joystick")
                person = Person(_VirtualJoystick(robot, model))
                begun = time.monotonic()
                with setup.recording(robot, f"recording-{name}", ("actual_position", "outputs", "inputs")) as path:
                    picked.append(person.pick(ITEMS[name]))
                away = dist(picked[-1], ITEMS[name])
                setup.report(f"{name}: picked {1e3 * away:.1f} mm from the item in {time.monotonic() - begun:.0f} s")
                rows.append(Row(f"{name}: distance to the item", "mm", 1e3 * away, most=20.0))
                paths[name] = read(path, ("actual_position",)).records["actual_position"]
                robot.mode("joint")
        rows += [
            Row("highest item above ground", "m", max(z for _, _, z in picked) + BASE_ABOVE_GROUND_M, 0.8),
            Row("furthest item", "m", max(float(np.hypot(x, y)) for x, y, _ in picked), 0.692),
        ]
        self._draw(setup, model, paths)
        return rows

    @staticmethod
    def _draw(setup: Setup, model: ArmModel, paths: Mapping[str, Any]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(8.0, 7.0), layout="constrained")
        axes = figure.add_subplot(projection="3d")
        for name, positions in paths.items():
            step = max(1, len(positions) // 500)
            points = np.array([forward(model, q).position for q in positions[::step].tolist()])
            (line,) = axes.plot(*points.T, lw=1.2, label=name)
            axes.scatter(*ITEMS[name], color=line.get_color(), s=60)
        axes.set(xlabel="x, m", ylabel="y, m", zlabel="z, m", title="tool on its way to each item and up again")
        axes.legend()
        setup.draw("picks", figure)
