"""Converts a recorded joint motion to the few points of a trajectory, which the planner checks like any other."""

from __future__ import annotations

from math import ceil, log, pi, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.config.model import MOST_POINTS
from rtcp.ipc.recording import RecordingError
from rtcp.ipc.schema import FLAG_ENABLED
from rtcp.telemetry.reading import Recorded

Array = npt.NDArray[np.float64]
POSITIONS = ("sent_position", "commanded_position", "actual_position")
"""Fields in order of preference: the first one in a recording is replayed."""
TOLERANCES_RAD = (1e-4, 3e-4, 9e-4)
"""Largest distance of the trajectory from the recorded positions, rad; the first that needs few enough points."""
_ROUNDING = 1e-10
_SLOPE_S, _SHORTEST_S = 5e-3, 2e-3
"""Time before and after a sample for its velocity, s; shortest time between two points, s."""
_RESTING_RAD = 1e-3
"""Largest motion of a joint of a hand-guided arm at rest, rad."""
_SIGMAS = 4.0
_AT_REST = 5e-3
"""Velocity, rad/s, below which the motion counts as at rest at its begin and end."""


def trajectory(
    recorded: Recorded, scale: float = 1.0, smooth_hz: float | None = None, rest_s: float | None = None
) -> list[dict[str, Any]]:
    """Return the points `{"t": s, "q": [rad], "v": [rad/s]}` of the motion in a recording, without rest around it.

    Args:
        recorded: with at least one of `POSITIONS`.
        scale: factor of the speed; 0.5 takes twice the time.
        smooth_hz: cutoff of `smoothed`, Hz; None: no smoothing.
        rest_s: longest rest within the motion, s, to which longer ones are shortened; None: unchanged.

    Raises:
        RecordingError: no motion, missing cycles in it, drives not enabled during all of it, or too many points for a
            request.
    """
    name = next(name for name in POSITIONS if name in (recorded.records.dtype.names or ()))
    q = recorded.column(name)
    steps = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0)
    moving = np.flatnonzero(steps)
    if not len(moving):
        raise RecordingError("empty", recorded.path, f"nothing moves in it ({name}, {recorded.seconds[-1]:.3f} s)")
    span = slice(moving[0], moving[-1] + 1)
    # Times from cycle numbers: setpoints are one cycle apart, however late a loaded host ran the cycle.
    cycles = np.diff(recorded.column("number"))
    cycles = cycles[span] / max(1.0, cycles.min())
    if gaps := int((cycles > 1.0).sum()):
        raise RecordingError("gap", recorded.path, f"cycles are missing at {gaps} places of its motion", found=gaps)
    whole = slice(moving[0], moving[-1] + 2)
    if "flags" in (recorded.records.dtype.names or ()) and not (recorded.records["flags"][whole] & FLAG_ENABLED).all():
        defect = "the drives were not enabled in all of its motion: choose a part by --start and --end"
        raise RecordingError("disabled", recorded.path, defect)
    if name != "actual_position":
        cycles[_sent_again(steps[span] / recorded.period_s)] = 0.0
    kept = np.append(True, cycles > 0.0)
    t = np.append(0.0, np.cumsum(cycles))[kept] * (recorded.period_s / scale)
    q = q[whole][kept]
    if rest_s is not None:
        kept = _shortened(q, max(1, round(rest_s / recorded.period_s)))
        t, q = t[: kept.sum()], q[kept]
    if smooth_hz is not None:
        t, q = smoothed(t, q, smooth_hz, scale)
    v = _velocities(t, q, max(1, round(_SLOPE_S / recorded.period_s)))
    low, high = q.min(axis=0), q.max(axis=0)
    rounded = np.clip(np.round(q, 6), low, high)
    # There a joint rests or reverses, perhaps at its limit: a remaining speed would lead beyond.
    v[(rounded == low) | (rounded == high)] = 0.0
    least = ceil(_SHORTEST_S * scale / recorded.period_s)
    points: list[dict[str, Any]] = []
    for tolerance in TOLERANCES_RAD:
        points = [
            {"t": round(t[at] - t[0], 6), "q": rounded[at].tolist(), "v": np.round(v[at], 5).tolist()}
            for at in _knots(t, q, v, least, tolerance)
        ]
        if len(points) <= MOST_POINTS:
            return points
    defect = f"its motion of {t[-1] - t[0]:.1f} s needs {len(points)} points, at most {MOST_POINTS} are allowed"
    raise RecordingError("long", recorded.path, f"{defect}: choose a part by --start and --end", found=len(points))


def smoothed(t: Array, q: Array, cutoff_hz: float, scale: float = 1.0) -> tuple[Array, Array]:
    """Return low-pass filtered times and positions: a Gaussian without delay, half power at the cutoff.

    Its weights are positive, so no joint exceeds its recorded range. The motion begins and ends at rest, which makes it
    slightly longer.

    Args:
        t: s, at equal steps, the recorded times divided by `scale`.
        q: rad, shape (len(t), n).
        cutoff_hz: cutoff frequency in the recorded motion, Hz.
        scale: factor of the speed.
    """
    from scipy.ndimage import gaussian_filter1d

    step = (t[-1] - t[0]) / (len(t) - 1)
    sigma = sqrt(log(2.0)) / (2.0 * pi * cutoff_hz * scale * step)
    rest = ceil(_SIGMAS * sigma)
    wide = np.pad(q, ((rest, rest), (0, 0)), mode="edge")
    return t[0] + step * np.arange(len(wide)), gaussian_filter1d(wide, sigma, axis=0, mode="nearest", truncate=_SIGMAS)


def deviation(recorded: Recorded, smooth_hz: float) -> float:
    """Return the largest difference of `smoothed` from the recording, rad."""
    q = recorded.column(next(name for name in POSITIONS if name in (recorded.records.dtype.names or ())))
    t = recorded.period_s * np.arange(len(q), dtype=np.float64)
    whole = smoothed(t, q, smooth_hz)[1]
    rest = (len(whole) - len(q)) // 2
    return float(np.abs(whole[rest : rest + len(q)] - q).max())


def _shortened(q: Array, longest: int) -> npt.NDArray[np.bool_]:
    """Return the mask of samples to keep: a rest begins where no joint leaves `_RESTING_RAD` for `longest` samples."""
    kept = np.ones(len(q), bool)
    begin = 0
    for at in range(1, len(q)):
        if np.abs(q[at] - q[begin]).max() > _RESTING_RAD:
            begin = at
        elif at - begin >= longest:
            kept[at] = False
    return kept


def _sent_again(speeds: Array) -> npt.NDArray[np.int64]:
    """Return the indices of steps without motion within a motion; `speeds` in rad/s. They are no rest.

    Without an answer of the slaves a setpoint is repeated, and the motion then continues.
    """
    moving, still = np.flatnonzero(speeds), np.flatnonzero(speeds == 0.0)
    after = np.searchsorted(moving, still)
    around = np.maximum(speeds[moving[after - 1]], speeds[moving[after]])
    repeated: npt.NDArray[np.int64] = still[around > _AT_REST]
    return repeated


def _velocities(t: Array, q: Array, reach: int) -> Array:
    at = np.arange(len(t))
    before, after = np.maximum(at - reach, 0), np.minimum(at + reach, len(t) - 1)
    velocities: Array = (q[after] - q[before]) / (t[after] - t[before])[:, None]
    for end in (0, -1):
        velocities[end, np.abs(velocities[end]) < _AT_REST] = 0.0
    return velocities


def _knots(t: Array, q: Array, v: Array, least: int, tolerance: float) -> list[int]:
    """Return indices of samples, as far apart as possible, between which cubics stay within `tolerance`, rad."""
    knots, last = [0], len(t) - 1
    while (at := knots[-1]) < last:
        low = least
        while at + 2 * low <= last and _fits(t, q, v, at, at + 2 * low, tolerance):
            low *= 2
        low, high = min(at + low, last), min(at + 2 * low, last)
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if _fits(t, q, v, at, middle, tolerance) else (low, middle - 1)
        # The rest is long enough for another piece, or becomes part of this one.
        knots.append(low if low == last or last - low >= least else max(at + 1, last - least))
    return knots


def _fits(t: Array, q: Array, v: Array, begin: int, end: int, tolerance: float) -> bool:
    """Return whether one cubic stays within `tolerance` of the samples and within their range."""
    length = t[end] - t[begin]
    x = ((t[begin : end + 1] - t[begin]) / length)[:, None]
    change = q[end] - q[begin]
    bend = v[begin] * length * (1 - x) - v[end] * length * x + change * (2 * x - 1)
    curve = q[begin] + change * x + x * (1 - x) * bend
    inside = (curve >= q.min(axis=0) - _ROUNDING).all() and (curve <= q.max(axis=0) + _ROUNDING).all()
    return bool(inside and np.abs(curve - q[begin : end + 1]).max() <= tolerance)
