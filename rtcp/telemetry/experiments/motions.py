"""Experiments that move the arm by targets, as in the thesis: the step and the square."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kinematics.model import ArmModel
from rtcp.api import Faulted, Robot
from rtcp.telemetry.experiments.experiment import SPEED_RAD_S, Experiment, ExperimentFailed, Row, Setup, returned
from rtcp.telemetry.reading import read
from rtcp.telemetry.square import SPEED_M_S, Driven, NoSquare, draw, judge, place

Array = npt.NDArray[np.float64]

STEP_RAD, STEP_SPEED = 1.35, 0.2
SOURCE_ERROR_RAD = 0.0007
SOURCE_PLANES = ("xy", "yz")
_HALF_PERIOD_S = 9.0
"""Time at each level of the square signal, s: the step takes 6.75 s at 0.2 rad/s."""
_SEND_S, _ATTEMPTS = 0.02, 3
_SOURCE_LESS_TIME = 33.0
"""Less time for the square in Y-Z than for that in X-Y, %: the thesis."""
_LAST_S = 5.0
"""Last part of the square in which the thesis compares joints 1 and 3, s. At 50 mm/s a side takes 4.2 s: this part is
the last side, along Y in X-Y and along Z in Y-Z, and the end of the side before."""


def geometry(setup: Setup) -> ArmModel:
    """Return the arm's geometry; raises ExperimentFailed where it is unknown."""
    model = setup.arm.arm
    if model is None:
        raise ExperimentFailed("the arm's geometry is not known (key kinematics)")
    return model


class Response(NamedTuple):
    """Response to a step: time until the position stays within 0.0007 rad, s; overshoot, rad; error at the end, rad."""

    settled_s: float
    overshoot: float
    error: float


def respond(actual: Array, begin: float, goal: float, period_s: float) -> Response:
    """Return the response of a joint to a step from `begin` to `goal`, rad.

    Args:
        actual: positions of consecutive cycles from the beginning of the step on, shape (n,), rad.
        begin: rad
        goal: rad
        period_s: interval of the positions, s.

    Raises:
        ExperimentFailed: the joint did not settle.
    """
    away = np.flatnonzero(np.abs(actual - goal) > SOURCE_ERROR_RAD)
    if len(away) and away[-1] + 1 == len(actual):
        raise ExperimentFailed("joint 1 did not settle while it was recorded")
    settled_s = float(away[-1] + 1) * period_s if len(away) else 0.0
    beyond = float((np.sign(goal - begin) * (actual - goal)).max())
    last = actual[-round(0.2 / period_s) :]
    return Response(settled_s, max(beyond, 0.0), float(np.abs(last - goal).mean()))


class StepExperiment(Experiment):
    """A step of 1.35 rad of joint 1 at 0.2 rad/s: as a planned move, then as a square signal."""

    name = "step"
    title = "Step of 1.35 rad at 0.2 rad/s"

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`."""
        with setup.platform() as robot:
            start = robot.status().positions
            sign = 1.0 if start[0] + STEP_RAD <= setup.arm.joints[0].position.max else -1.0
            goal = (start[0] + sign * STEP_RAD, *start[1:])
            with setup.recording(robot) as path:
                robot.move_joints(goal, speed=STEP_SPEED)
                time.sleep(0.5)
            recorded = read(path, ("wkc*", "commanded_position", "actual_position"))
            # A cycle whose frame does not return holds the setpoints: its time does not count.
            records = recorded.records[returned(recorded.records)]
            commanded, actual = records["commanded_position"][:, 0], records["actual_position"][:, 0]
            moving = np.flatnonzero(np.diff(commanded))
            if not len(moving):
                raise ExperimentFailed("joint 1 was not commanded to move")
            yield from _rows("", [respond(actual[moving[0] :], start[0], goal[0], recorded.period_s)])
            seconds = (np.arange(len(records)) - moving[0]) * recorded.period_s
            reference = np.full(len(records), start[0])
            reference[moving[0] :] = goal[0]
            self._draw(setup, "step", seconds, reference, commanded, actual)
            robot.move_joints(start, speed=SPEED_RAD_S)
            robot.set_limits({f"{setup.arm.joints[0].name}.velocity": STEP_SPEED})
            for attempt in range(1, _ATTEMPTS + 1):
                try:
                    path, edges_ns = self._send_square_signal(setup, robot, start, goal)
                    break
                except Faulted as error:
                    # A busy host may keep the sender waiting for longer than a stream lasts. The arm then holds; if it
                    # does not, the move is refused.
                    if attempt == _ATTEMPTS:
                        raise
                    setup.note(f"the square signal is sent anew: {error}")
                    time.sleep(_HALF_PERIOD_S)
                    robot.move_joints(start, speed=SPEED_RAD_S)
            robot.move_joints(start, speed=SPEED_RAD_S)
        yield from self._square_signal(setup, path, edges_ns, start, goal)

    @staticmethod
    def _send_square_signal(
        setup: Setup, robot: Robot, start: Sequence[float], goal: Sequence[float]
    ) -> tuple[Path, list[int]]:
        """Send a target that jumps to and fro twice; the loop leads the joint there under its limits.

        Returns:
            The recording, and when each target was sent first, ns of CLOCK_MONOTONIC.
        """
        rest, edges_ns = (0.0,) * len(start), list[int]()
        with setup.recording(robot, "recording-square-signal") as path, robot.open_stream() as stream:
            for target in (start, goal, start, goal, start):
                edges_ns.append(time.monotonic_ns())
                until = time.monotonic() + (_HALF_PERIOD_S if len(edges_ns) > 1 else 0.5)
                while time.monotonic() < until:
                    stream.send(target, velocity=rest)
                    time.sleep(_SEND_S)
        return path, edges_ns

    def _square_signal(
        self, setup: Setup, path: Path, edges_ns: Sequence[int], start: Sequence[float], goal: Sequence[float]
    ) -> Iterator[Row]:
        """Return the figures of a square signal, and draw it."""
        recorded = read(path, ("wkc*", "commanded_position", "actual_position"))
        records = recorded.records[returned(recorded.records)]
        commanded, actual = records["commanded_position"][:, 0], records["actual_position"][:, 0]
        # The records of an edge: from the first motion after its target was sent to the next target.
        bounds = [int(np.searchsorted(records["time_ns"], instant)) for instant in edges_ns[1:]] + [len(records)]
        reference, responses = np.full(len(records), start[0]), []
        for at, (edge, end) in enumerate(pairwise(bounds)):
            begin, level = (start[0], goal[0]) if at % 2 == 0 else (goal[0], start[0])
            reference[edge:end] = level
            moving = edge + np.flatnonzero(np.diff(commanded[edge:end]))
            if not len(moving):
                raise ExperimentFailed("joint 1 was not commanded to follow the square signal")
            responses.append(respond(actual[moving[0] : end], begin, level, recorded.period_s))
        yield from _rows("square signal, ", responses)
        seconds = np.arange(len(records), dtype=np.float64) * recorded.period_s
        self._draw(setup, "square-signal", seconds, reference, commanded, actual)

    @staticmethod
    def _draw(setup: Setup, name: str, seconds: Array, reference: Array, commanded: Array, actual: Array) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 6.0), layout="constrained")
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        above.plot(seconds, reference, color="0.6", lw=0.8, label="reference")
        above.plot(seconds, commanded, label="commanded")
        above.plot(seconds, actual, label="actual")
        above.set(ylabel="joint 1, rad")
        above.legend()
        below.plot(seconds, 1e3 * (commanded - actual), lw=0.8)
        below.set(xlabel="time, s", ylabel="following error, mrad")
        for axes in (above, below):
            axes.grid(alpha=0.3)
        setup.draw(name, figure)


def _rows(label: str, responses: Sequence[Response]) -> Iterator[Row]:
    """Return the figures of steps: settling of each, and the worst overshoot and error."""
    for number, response in enumerate(responses, 1):
        edge = f"edge {number}: " if len(responses) > 1 else ""
        yield Row(f"{label}{edge}settling within 0.0007 rad", "s", response.settled_s, "about 6", most=7.5)
    overshoot = 100.0 * max(response.overshoot for response in responses) / STEP_RAD
    error = max(response.error for response in responses)
    yield Row(f"{label}overshoot", "%", overshoot, most=0.1)
    yield Row(f"{label}steady-state error", "rad", error, SOURCE_ERROR_RAD, most=SOURCE_ERROR_RAD)


class SquareExperiment(Experiment):
    """The square of 200 mm in each plane at each speed.

    Args:
        planes: some of `xy`, `yz`, `xz`.
        speeds: of the tool, m/s.
    """

    name = "square"
    title = "Square of 200 x 200 mm"

    def __init__(self, planes: Sequence[str] = SOURCE_PLANES, speeds: Sequence[float] = (SPEED_M_S,)) -> None:
        self._planes = planes
        self._speeds = speeds

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; the squares that were driven before a failure keep their figures."""
        geometry(setup)
        with setup.platform() as robot:
            home = robot.status().positions
            for speed in self._speeds:
                driven: dict[str, Driven] = {}
                for plane in self._planes:
                    try:
                        driven[plane] = self._drive(setup, robot, plane, speed)
                    except NoSquare as error:
                        raise ExperimentFailed(str(error)) from error
                    yield from _figures(f"{plane}, {1e3 * speed:g} mm/s", driven[plane])
                if {"xy", "yz"} <= driven.keys():
                    yield from _compared(f"yz against xy, {1e3 * speed:g} mm/s", driven["xy"], driven["yz"])
            robot.move_joints(home, speed=SPEED_RAD_S)

    @staticmethod
    def _drive(setup: Setup, robot: Robot, plane: str, speed: float) -> Driven:
        square = place(setup.arm, plane, speed)
        name = f"square-{plane}-{1e3 * speed:g}"
        robot.move_joints(square.start, speed=SPEED_RAD_S)
        with setup.recording(robot, f"recording-{plane}-{1e3 * speed:g}") as path:
            robot.move_line(square.poses, speed)
        driven = judge(geometry(setup), square, read(path, ("wkc*", "*_position", "*_velocity", "*_torque")))
        for ending in ("png", "svg"):
            draw(driven, setup.folder / f"{name}.{ending}")
        setup.pictures.append(name)
        return driven


def _figures(label: str, driven: Driven) -> Iterator[Row]:
    commanded, actual = (1e3 * worst for worst in driven.worst)
    yield Row(f"{label}: largest deviation, commanded", "mm", commanded, most=1.0)
    yield Row(f"{label}: largest deviation, actual", "mm", actual, "tracked", most=3.0)
    yield Row(f"{label}: elapsed time", "s", float(driven.seconds[-1]))
    for joint, torque in enumerate(np.abs(driven.torques).max(axis=0), 1):
        yield Row(f"{label}: largest torque, joint {joint}", "Nm", float(torque))


def _compared(label: str, xy: Driven, yz: Driven) -> Iterator[Row]:
    """Return what the thesis compares between the planes: time, torques, and which joint moves in the last 5 s."""
    less = 100.0 * (1.0 - float(yz.seconds[-1]) / float(xy.seconds[-1]))
    yield Row(f"{label}: less time", "%", less, _SOURCE_LESS_TIME)
    for joint in (2, 3):
        more = np.abs(yz.torques[:, joint - 1]).max() / np.abs(xy.torques[:, joint - 1]).max()
        yield Row(f"{label}: torque, joint {joint}, yz / xy", "", float(more), "increased")
    for plane, driven, source in (("xy", xy, 1), ("yz", yz, 3)):
        last = driven.joints[driven.seconds >= driven.seconds[-1] - _LAST_S]
        for joint in (1, 3):
            note = "the most" if joint == source else None
            yield Row(
                f"{label}: {plane}, last 5 s, travel of joint {joint}", "rad", float(np.ptp(last[:, joint - 1])), note
            )
