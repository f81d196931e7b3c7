"""How a joint follows: frequency response from sent to actual position, and friction and inertia by least squares."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi, sin, tau

import numpy as np
import numpy.typing as npt

from rtcp.api import Robot
from rtcp.config.loader import segment_path
from rtcp.config.segment import load_segment
from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup
from rtcp.telemetry.experiments.latency import behind, fit_sine
from rtcp.telemetry.reading import Recorded, read
from rtcp.virtual.device import create
from rtcp.virtual.models.cubemars import CubemarsDrive

Array = npt.NDArray[np.float64]

FREQUENCIES_HZ = (0.25, 0.5, 1.0, 2.0, 4.0)
_PERIODS_MIN, _SWEEP_S = 3, 2.0
_SHARE = 0.6
"""Of a joint's limits of velocity, acceleration and jerk that a sweep takes."""
_REACH_RAD = 0.4
_SAMPLE_S = 0.02
_WINDOW_S = 0.02
_MOVING_RAD_S = 0.02
_TOLERANCE = 0.05


@dataclass(frozen=True)
class Friction:
    """What turns with a joint and what holds it: kg m^2, Nm, Nm s/rad; Nm of gravity at sin(q) and cos(q)."""

    inertia: float
    coulomb: float
    viscous: float
    gravity: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Response:
    """From sent to actual position at a frequency."""

    frequency_hz: float
    gain: float
    phase_rad: float
    error_rad: float
    """Largest following error."""


def sweep(amplitudes: Mapping[float, float]) -> list[tuple[float, float, float, float]]:
    """Return a motion of whole sines, each of a frequency (Hz) with its amplitude (rad), that begin and end at rest.

    Returns:
        t, s, and position, velocity, acceleration there, relative to the beginning.
    """
    points, begun = [], 0.0
    for f, amplitude in amplitudes.items():
        w, duration = tau * f, _duration(f)
        for at in range(round(duration / _SAMPLE_S)):
            t = at * _SAMPLE_S
            points.append((begun + t, amplitude * (1.0 - cos(w * t)), amplitude * w * sin(w * t),
                           amplitude * w * w * cos(w * t)))  # fmt: skip
        begun += duration
    return [*points, (begun, 0.0, 0.0, 0.0)]


def _duration(f: float) -> float:
    return max(_PERIODS_MIN, round(_SWEEP_S * f)) / f


def identify(torque: Array, velocity: Array, position: Array, period_s: float) -> Friction:
    """Identify a joint by least squares from samples of its motion, shape (n,) each, Nm, rad/s, rad.

    torque = J a + c sign(v) + b v - g1 sin(q) - g2 cos(q), each side integrated over short windows: the acceleration
    need not be had from the noise of the velocity. Windows in which the joint hardly moves or turns round tell nothing
    of dry friction, and are left out.

    Raises:
        ExperimentFailed: it hardly moved.
    """
    width = max(2, round(_WINDOW_S / period_s))
    count = (len(torque) - 1) // width
    ends = np.arange(count + 1) * width

    def mean(values: Array) -> Array:
        # The trapezoid rule: the integral belongs to the change from the first to the last sample of a window.
        halves = 0.5 * (values[: count * width] + values[1 : count * width + 1])
        means: Array = halves.reshape(count, width).mean(axis=1)
        return means

    speeds = velocity[: count * width].reshape(count, width)
    useful = (np.abs(speeds).min(axis=1) > _MOVING_RAD_S) & (np.abs(np.sign(speeds).sum(axis=1)) == width)
    if np.count_nonzero(useful) < 20:
        raise ExperimentFailed("the joint hardly moved: nothing can be identified")
    columns = np.column_stack((
        np.diff(velocity[ends]) / (width * period_s), mean(np.sign(velocity)), mean(velocity),
        -mean(np.sin(position)), -mean(np.cos(position)),
    ))  # fmt: skip
    (inertia, coulomb, viscous, g1, g2), *_ = np.linalg.lstsq(columns[useful], mean(torque)[useful], rcond=None)
    return Friction(float(inertia), float(coulomb), float(viscous), (float(g1), float(g2)))


class TrackingExperiment(Experiment):
    """A sweep of each joint by itself.

    Args:
        joints: from 0; None: all.
    """

    name = "tracking"
    title = "Following error, frequency response, friction and inertia of each joint"

    def __init__(self, joints: Sequence[int] | None = None, frequencies_hz: Sequence[float] = FREQUENCIES_HZ) -> None:
        self._joints = joints
        self._frequencies_hz = frequencies_hz

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        rows: list[Row] = []
        found: dict[str, list[Response]] = {}
        truth = _truth(setup) if setup.is_virtual else {}
        with setup.platform() as robot:
            for joint in range(len(setup.arm.joints)) if self._joints is None else self._joints:
                name = setup.arm.joints[joint].name
                amplitudes = self._amplitudes(setup, joint)
                recorded = _drive(setup, robot, joint, amplitudes)
                found[name] = _responses(recorded, joint, amplitudes)
                torque, velocity, position = (
                    recorded.column(f"actual_{key}")[:, joint] for key in ("torque", "velocity", "position")
                )
                values = identify(torque, velocity, position, recorded.period_s)
                setup.report(
                    f"{name}: inertia {values.inertia:.3f} kg m^2, friction {values.coulomb:.3f} Nm and "
                    f"{values.viscous:.3f} Nm s/rad"
                )
                rows += _rows(name, found[name], values, truth.get(name))
        self._draw(setup, found)
        return rows

    def _amplitudes(self, setup: Setup, joint: int) -> dict[float, float]:
        limits = setup.arm.joints[joint]
        amplitudes = {}
        for f in self._frequencies_hz:
            w = tau * f
            most = min(limits.velocity / w, limits.acceleration / w**2, limits.jerk / w**3)
            amplitudes[f] = min(_SHARE * most, _REACH_RAD)
        return amplitudes

    @staticmethod
    def _draw(setup: Setup, found: Mapping[str, Sequence[Response]]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 8.0), layout="constrained")
        gain, phase, error = figure.subplots(3, 1, sharex=True)
        for name, responses in found.items():
            frequencies = [one.frequency_hz for one in responses]
            gain.plot(frequencies, [20 * np.log10(one.gain) for one in responses], "o-", label=name)
            phase.plot(frequencies, [np.degrees(one.phase_rad) for one in responses], "o-")
            error.plot(frequencies, [1e3 * one.error_rad for one in responses], "o-")
        gain.set(ylabel="gain, dB", xscale="log", title="sent to actual position")
        gain.legend(ncols=3)
        phase.set(ylabel="phase, degrees")
        error.set(ylabel="largest following error, mrad", xlabel="frequency, Hz")
        for axes in (gain, phase, error):
            axes.grid(alpha=0.3, which="both")
        setup.draw("bode", figure)


def _drive(setup: Setup, robot: Robot, joint: int, amplitudes: Mapping[float, float]) -> Recorded:
    """Move one joint along its sweep and return the recording of it."""
    base = list(robot.status().positions)
    n, limits = len(base), setup.arm.joints[joint].position
    away = 2 * max(amplitudes.values())
    sign = 1.0 if base[joint] + away < limits.max else -1.0
    points = []
    for t, q, v, a in sweep(amplitudes):
        positions, velocities, accelerations = list(base), [0.0] * n, [0.0] * n
        positions[joint] += sign * q
        velocities[joint], accelerations[joint] = sign * v, sign * a
        points.append({"t": t, "q": positions, "v": velocities, "a": accelerations})
    with setup.recording(
        robot, f"recording-{setup.arm.joints[joint].name}", ("*_position", "*_velocity", "*_torque")
    ) as path:
        robot.run_trajectory(points)
        time.sleep(0.1)
    return read(path, ("*_position", "actual_velocity", "actual_torque"))


def _responses(recorded: Recorded, joint: int, amplitudes: Mapping[float, float]) -> list[Response]:
    sent = recorded.records["sent_position"][:, joint]
    actual = recorded.records["actual_position"][:, joint]
    t = recorded.seconds
    moving = np.flatnonzero(np.diff(sent))
    if not len(moving):
        raise ExperimentFailed("the joint was not commanded to move")
    found, begun = [], float(t[moving[0]])
    for f in amplitudes:
        duration = _duration(f)
        # Without the first period, in which what came before dies down.
        inside = (t >= begun + 1 / f) & (t < begun + duration)
        one, other = (fit_sine(t[inside] - begun, values[inside], 1 / f) for values in (actual, sent))
        delay, _ = behind(one, other)
        error = float(np.abs(actual - sent)[inside].max())
        found.append(Response(f, one.amplitude / other.amplitude, -tau * f * delay, error))
        begun += duration
    return found


def _truth(setup: Setup) -> dict[str, Friction]:
    """Return what the models of the virtual drives were given, by joint."""
    arm = setup.arm
    slots = {slave.name: entry for slave, entry in zip(arm.slaves, load_segment(segment_path(arm)).slaves, strict=True)}
    found = {}
    for joint in arm.joints:
        entry = slots[joint.slave]
        model = create(entry.model, **entry.options)
        if isinstance(model, CubemarsDrive):
            mechanics = model.mechanics
            found[joint.name] = Friction(mechanics.inertia, mechanics.coulomb, mechanics.viscous)
    return found


def _rows(name: str, responses: Sequence[Response], values: Friction, truth: Friction | None) -> list[Row]:
    rows = []
    for key, unit in (("inertia", "kg m^2"), ("coulomb", "Nm"), ("viscous", "Nm s/rad")):
        here = getattr(values, key)
        given = None if truth is None else getattr(truth, key)
        if given is None:
            rows.append(Row(f"{name}: {key}", unit, here))
        else:
            bounds = (1 - _TOLERANCE) * given, (1 + _TOLERANCE) * given
            rows.append(Row(f"{name}: {key}", unit, here, f"model: {given:g}", *bounds))
    for one in responses:
        rows.append(Row(f"{name}, {one.frequency_hz:g} Hz: gain", "", one.gain))
        rows.append(Row(f"{name}, {one.frequency_hz:g} Hz: phase", "degrees", one.phase_rad * 180 / pi))
        rows.append(Row(f"{name}, {one.frequency_hz:g} Hz: following error", "mrad", 1e3 * one.error_rad))
    return rows
