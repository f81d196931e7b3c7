"""Tracking of a joint: frequency response from sent to actual position, friction and inertia by least squares."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import cos, pi, sin, tau

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from rtcp.api import Robot
from rtcp.config.loader import segment_path
from rtcp.config.segment import load_segment
from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup, returned
from rtcp.telemetry.experiments.latency import behind, fit_sine
from rtcp.telemetry.reading import Recorded, read
from rtcp.virtual.descriptions import Descriptions
from rtcp.virtual.models.cubemars import CubemarsDrive

Array = npt.NDArray[np.float64]

FREQUENCIES_HZ = (0.25, 0.5, 1.0, 2.0, 4.0)
_PERIODS_MIN, _SWEEP_S = 3, 2.0
_SHARE = 0.6
"""Fraction of a joint's limits of velocity, acceleration and jerk that a sweep uses."""
_REACH_RAD = 0.4
_SAMPLES = 24
"""Points of the trajectory in a period: a spline through their positions, velocities, accelerations is the sine."""
_WINDOW_S = 0.01
_SETTLING_S = 0.01
"""Time after a gap between two samples in which the torque still depends on the gap, s."""
_MOVING_RAD_S = 0.02
_EXACT_NM = 1e-6
_TOLERANCE = 0.05


@dataclass(frozen=True)
class Friction:
    """Inertia, dry and viscous friction of a joint: kg m^2, Nm, Nm s/rad; gravity torques at sin(q) and cos(q), Nm."""

    inertia: float
    coulomb: float
    viscous: float
    gravity: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Response:
    """Response from sent to actual position at a frequency."""

    frequency_hz: float
    gain: float
    phase_rad: float
    error_rad: float
    """Largest following error, rad."""


def sine(frequency_hz: float, amplitude: float) -> Iterator[tuple[float, float, float, float]]:
    """Yield a motion of whole sines from rest to rest: t, s, and position, velocity, acceleration, from its begin.

    Args:
        frequency_hz: frequency, Hz.
        amplitude: rad; the joint moves by twice that, to one side.
    """
    w, periods = tau * frequency_hz, max(_PERIODS_MIN, round(_SWEEP_S * frequency_hz))
    for at in range(periods * _SAMPLES + 1):
        t = at / (_SAMPLES * frequency_hz)
        q, v, a = amplitude * (1.0 - cos(w * t)), amplitude * w * sin(w * t), amplitude * w * w * cos(w * t)
        yield round(t, 9), round(q, 9), round(v, 9), round(a, 9)  # precision of a request


def identify(seconds: Array, torque: Array, velocity: Array, position: Array) -> Friction:
    """Identify a joint by least squares from samples of its motion, shape (n,) each, s, Nm, rad/s, rad.

    torque = J a + c sign(v) + b v - g1 sin(q) - g2 cos(q), each side integrated over short windows, which avoids
    differentiating a noisy velocity. Windows in which the joint hardly moves or reverses (dry friction undefined), and
    windows with a gap between two samples or just after one, are left out. Other disturbances by stalls of the host
    have little weight (loss "soft_l1").

    Raises:
        ExperimentFailed: the joint hardly moved.
    """
    period_s = float(np.median(np.diff(seconds)))
    width = max(2, round(_WINDOW_S / period_s))
    count = (len(torque) - 1) // width
    ends = np.arange(count + 1) * width

    def mean(values: Array) -> Array:
        # The trapezoid rule matches the change from the first to the last sample of a window.
        halves = 0.5 * (values[: count * width] + values[1 : count * width + 1])
        means: Array = halves.reshape(count, width).mean(axis=1)
        return means

    gaps = np.diff(seconds, prepend=seconds[0]) > 1.5 * period_s
    settling = np.convolve(gaps, np.ones(round(_SETTLING_S / period_s) + 1))[: count * width + 1] > 0
    undisturbed = ~(settling[:-1] | settling[1:]).reshape(count, width).any(axis=1)
    speeds = velocity[: count * width].reshape(count, width)
    moving = (np.abs(speeds).min(axis=1) > _MOVING_RAD_S) & (np.abs(np.sign(speeds).sum(axis=1)) == width)
    useful = moving & undisturbed
    if np.count_nonzero(useful) < 20:
        raise ExperimentFailed("the joint hardly moved: nothing can be identified")
    columns = np.column_stack((
        np.diff(velocity[ends]) / np.diff(seconds[ends]), mean(np.sign(velocity)), mean(velocity),
        -mean(np.sin(position)), -mean(np.cos(position)),
    ))  # fmt: skip
    matrix, wanted = columns[useful], mean(torque)[useful]
    plain = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    scale = max(float(np.median(np.abs(wanted - matrix @ plain))), _EXACT_NM)
    robust = least_squares(lambda values: wanted - matrix @ values, plain, loss="soft_l1", f_scale=scale)
    inertia, coulomb, viscous, g1, g2 = robust.x
    return Friction(float(inertia), float(coulomb), float(viscous), (float(g1), float(g2)))


class TrackingExperiment(Experiment):
    """A sweep of each joint separately.

    Args:
        joints: indices of the joints, from 0; None: all.
    """

    name = "tracking"
    title = "Following error, frequency response, friction and inertia of each joint"

    def __init__(self, joints: Sequence[int] | None = None, frequencies_hz: Sequence[float] = FREQUENCIES_HZ) -> None:
        self._joints = joints
        self._frequencies_hz = frequencies_hz

    def run(self, setup: Setup) -> list[Row]:
        """See `Experiment.run`."""
        rows: list[Row] = []
        responses_of: dict[str, list[Response]] = {}
        truth = _truth(setup) if setup.is_virtual else {}
        with setup.platform() as robot:
            for joint in range(len(setup.arm.joints)) if self._joints is None else self._joints:
                name = setup.arm.joints[joint].name
                recorded, responses_of[name] = _drive(setup, robot, joint, self._amplitudes(setup, joint))
                came = returned(recorded.records)
                torque, velocity, position = (
                    recorded.column(f"actual_{key}")[came, joint] for key in ("torque", "velocity", "position")
                )
                values = identify(recorded.seconds[came], torque, velocity, position)
                setup.report(
                    f"{name}: inertia {values.inertia:.3f} kg m^2, friction {values.coulomb:.3f} Nm and "
                    f"{values.viscous:.3f} Nm s/rad"
                )
                rows += _rows(name, responses_of[name], values, truth.get(name))
        self._draw(setup, responses_of)
        return rows

    def _amplitudes(self, setup: Setup, joint: int) -> dict[float, float]:
        limits = setup.arm.joints[joint]
        amplitudes = {}
        for f in self._frequencies_hz:
            w = tau * f
            most = min(limits.velocity / w, limits.acceleration / w**2, limits.jerk / w**3)
            amplitudes[f] = min(_SHARE * most, _REACH_RAD)
        return amplitudes

    def _draw(self, setup: Setup, responses_of: Mapping[str, Sequence[Response]]) -> None:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 8.0), layout="constrained")
        gain, phase, error = figure.subplots(3, 1, sharex=True)
        frequencies = self._frequencies_hz
        for name, responses in responses_of.items():
            gain.plot(frequencies, [20 * np.log10(response.gain) for response in responses], "o-", label=name)
            phase.plot(frequencies, [np.degrees(response.phase_rad) for response in responses], "o-")
            error.plot(frequencies, [1e3 * response.error_rad for response in responses], "o-")
        gain.set(ylabel="gain, dB", xscale="log", title="sent to actual position")
        gain.legend(ncols=3)
        phase.set(ylabel="phase, degrees")
        error.set(ylabel="largest following error, mrad", xlabel="frequency, Hz")
        error.set_xticks(frequencies, [f"{f:g}" for f in frequencies], minor=False)
        error.minorticks_off()
        for axes in (gain, phase, error):
            axes.grid(alpha=0.3)
        setup.draw("bode", figure)


def _drive(
    setup: Setup, robot: Robot, joint: int, amplitudes: Mapping[float, float]
) -> tuple[Recorded, list[Response]]:
    """Move one joint at each frequency; return the recording and the responses."""
    base = list(robot.status().positions)
    n, name = len(base), setup.arm.joints[joint].name
    away = 2 * max(amplitudes.values())
    sign = 1.0 if base[joint] + away < setup.arm.joints[joint].position.max else -1.0
    spans = []
    with setup.recording(robot, f"recording-{name}", ("wkc*", "*_position", "*_velocity", "*_torque")) as path:
        for f, amplitude in amplitudes.items():
            points = []
            for t, q, v, a in sine(f, amplitude):
                positions, velocities, accelerations = list(base), [0.0] * n, [0.0] * n
                positions[joint] += sign * q
                velocities[joint], accelerations[joint] = sign * v, sign * a
                points.append({"t": t, "q": positions, "v": velocities, "a": accelerations})
            begun = time.monotonic_ns()
            robot.run_trajectory(points)
            spans.append((begun, time.monotonic_ns()))
    recorded = read(path, ("wkc*", "*_position", "actual_velocity", "actual_torque"))
    return recorded, [_response(recorded, joint, f, span) for f, span in zip(amplitudes, spans, strict=True)]


def _response(recorded: Recorded, joint: int, f: float, span: tuple[int, int]) -> Response:
    """Return the response of a joint to a sine between two instants, ns."""
    records = recorded.records[slice(*np.searchsorted(recorded.records["time_ns"], span))]
    # The sent values of a record leave with the next cycle; a cycle whose frame did not return has no new values.
    came = returned(records)[1:]
    sent, actual = records["sent_position"][:-1, joint][came], records["actual_position"][1:, joint][came]
    moving = np.flatnonzero(np.diff(sent))
    if not len(moving):
        raise ExperimentFailed(f"the joint was not commanded to move at {f:g} Hz")
    # Without the first period, which has transients.
    instants = records["time_ns"][1:][came]
    t = (instants - instants[moving[0]]) * 1e-9
    inside = (t >= 1 / f) & (np.arange(len(t)) <= moving[-1])
    actual_sine, sent_sine = (fit_sine(t[inside], values[inside], 1 / f, t[inside].mean()) for values in (actual, sent))
    delay, _ = behind(actual_sine, sent_sine)
    error = float(np.abs(actual - sent)[inside].max())
    return Response(f, actual_sine.amplitude / sent_sine.amplitude, -tau * f * delay, error)


def _truth(setup: Setup) -> dict[str, Friction]:
    """Return joint name -> parameters of the virtual drive's model."""
    arm = setup.arm
    slots = {slave.name: entry for slave, entry in zip(arm.slaves, load_segment(segment_path(arm)).slaves, strict=True)}
    descriptions = Descriptions(segment_path(arm).parent)
    frictions = {}
    for joint in arm.joints:
        entry = slots[joint.slave]
        model = descriptions.make(entry)
        if isinstance(model, CubemarsDrive):
            mechanics = model.mechanics
            frictions[joint.name] = Friction(mechanics.inertia, mechanics.coulomb, mechanics.viscous)
    return frictions


def _rows(name: str, responses: Sequence[Response], values: Friction, truth: Friction | None) -> list[Row]:
    rows = []
    for key, unit in (("inertia", "kg m^2"), ("coulomb", "Nm"), ("viscous", "Nm s/rad")):
        here = getattr(values, key)
        modelled = None if truth is None else getattr(truth, key)
        if modelled is None:
            rows.append(Row(f"{name}: {key}", unit, here))
        else:
            bounds = (1 - _TOLERANCE) * modelled, (1 + _TOLERANCE) * modelled
            rows.append(Row(f"{name}: {key}", unit, here, f"model: {modelled:g}", *bounds))
    for response in responses:
        rows.append(Row(f"{name}, {response.frequency_hz:g} Hz: gain", "", response.gain))
        rows.append(Row(f"{name}, {response.frequency_hz:g} Hz: phase", "degrees", response.phase_rad * 180 / pi))
        rows.append(Row(f"{name}, {response.frequency_hz:g} Hz: following error", "mrad", 1e3 * response.error_rad))
    return rows
