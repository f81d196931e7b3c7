"""A recorded joint motion as the few points of a trajectory, which the planner checks like any other."""

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
"""The first of them that a recording has is replayed."""
TOLERANCES_RAD = (1e-4, 3e-4, 9e-4)
"""Largest distance of the trajectory from the recorded positions; the first whose points are not too many."""
_ROUNDING = 1e-10
_SLOPE_S, _SHORTEST_S = 5e-3, 2e-3
"""Time before and after a sample over which its velocity is taken; shortest time between two points."""
_RESTING_RAD = 1e-3
"""A hand-guided arm that turns by less rests."""
_SIGMAS = 4.0
_AT_REST = 5e-3
"""Below this velocity, rad/s, the motion counts as at rest where it begins and ends."""


def trajectory(
    recorded: Recorded, scale: float = 1.0, smooth_hz: float | None = None, rest_s: float | None = None
) -> list[dict[str, Any]]:
    """Return the points `{"t": s, "q": [rad], "v": [rad/s]}` of what moves in a recording; rest around it is left out.

    Args:
        recorded: at least one of `POSITIONS`.
        scale: of the speed; 0.5 takes twice the time.
        smooth_hz: cutoff of `smoothed`; None: as it was recorded.
        rest_s: rests in the motion that last longer last so long, s; None: as they were.

    Raises:
        RecordingError: nothing moves in it, cycles of the motion are missing, the drives were not enabled in all of it,
            or it is too long for a request.
    """
    name = next(name for name in POSITIONS if name in (recorded.records.dtype.names or ()))
    q = recorded.column(name)
    steps = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0)
    moving = np.flatnonzero(steps)
    if not len(moving):
        raise RecordingError("empty", recorded.path, f"nothing moves in it ({name}, {recorded.seconds[-1]:.3f} s)")
    span = slice(moving[0], moving[-1] + 1)
    # By their numbers: a setpoint is one cycle after the one before, however late a loaded host ran that cycle.
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
    # There a joint rests or turns, perhaps at its limit: what is left of a speed would lead beyond.
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
    """Return times and positions without what is faster than a cutoff: a Gaussian of no delay, at half power there.

    Its weights are positive: no joint goes beyond what was recorded of it. The motion begins and ends at rest, and
    takes a little more time for it.

    Args:
        t: s, at equal steps, the recorded ones over `scale`.
        q: rad, shape (len(t), n).
        cutoff_hz: of the recorded motion.
        scale: of the speed.
    """
    from scipy.ndimage import gaussian_filter1d

    step = (t[-1] - t[0]) / (len(t) - 1)
    sigma = sqrt(log(2.0)) / (2.0 * pi * cutoff_hz * scale * step)
    rest = ceil(_SIGMAS * sigma)
    held = np.pad(q, ((rest, rest), (0, 0)), mode="edge")
    return t[0] + step * np.arange(len(held)), gaussian_filter1d(held, sigma, axis=0, mode="nearest", truncate=_SIGMAS)


def deviation(recorded: Recorded, smooth_hz: float) -> float:
    """Return by how much `smoothed` differs from what was recorded, at most, rad."""
    q = recorded.column(next(name for name in POSITIONS if name in (recorded.records.dtype.names or ())))
    t = recorded.period_s * np.arange(len(q), dtype=np.float64)
    whole = smoothed(t, q, smooth_hz)[1]
    rest = (len(whole) - len(q)) // 2
    return float(np.abs(whole[rest : rest + len(q)] - q).max())


def _shortened(q: Array, longest: int) -> npt.NDArray[np.bool_]:
    """Return which samples are kept: a rest begins where no joint leaves `_RESTING_RAD` for `longest` samples."""
    kept = np.ones(len(q), bool)
    begin = 0
    for at in range(1, len(q)):
        if np.abs(q[at] - q[begin]).max() > _RESTING_RAD:
            begin = at
        elif at - begin >= longest:
            kept[at] = False
    return kept


def _sent_again(speeds: Array) -> npt.NDArray[np.int64]:
    """Return the steps without motion, rad/s, before or after which a joint moves: they are no rest.

    Without an answer of the slaves a setpoint is sent again, and the motion goes on afterwards as if nothing had been.
    """
    moving, still = np.flatnonzero(speeds), np.flatnonzero(speeds == 0.0)
    after = np.searchsorted(moving, still)
    around = np.maximum(speeds[moving[after - 1]], speeds[moving[after]])
    found: npt.NDArray[np.int64] = still[around > _AT_REST]
    return found


def _velocities(t: Array, q: Array, reach: int) -> Array:
    at = np.arange(len(t))
    before, after = np.maximum(at - reach, 0), np.minimum(at + reach, len(t) - 1)
    found: Array = (q[after] - q[before]) / (t[after] - t[before])[:, None]
    for end in (0, -1):
        found[end, np.abs(found[end]) < _AT_REST] = 0.0
    return found


def _knots(t: Array, q: Array, v: Array, least: int, tolerance: float) -> list[int]:
    """Return the samples that cubics join which stay within `tolerance`, each as far from the one before as it goes."""
    knots, last = [0], len(t) - 1
    while (at := knots[-1]) < last:
        low = least
        while at + 2 * low <= last and _fits(t, q, v, at, at + 2 * low, tolerance):
            low *= 2
        low, high = min(at + low, last), min(at + 2 * low, last)
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if _fits(t, q, v, at, middle, tolerance) else (low, middle - 1)
        # What is left is long enough for a piece of its own, or part of this one.
        knots.append(low if low == last or last - low >= least else max(at + 1, last - least))
    return knots


def _fits(t: Array, q: Array, v: Array, begin: int, end: int, tolerance: float) -> bool:
    """Return whether one cubic stays within `tolerance` of the samples and within the range of them all."""
    length = t[end] - t[begin]
    x = ((t[begin : end + 1] - t[begin]) / length)[:, None]
    way = q[end] - q[begin]
    bend = v[begin] * length * (1 - x) - v[end] * length * x + way * (2 * x - 1)
    curve = q[begin] + way * x + x * (1 - x) * bend
    inside = (curve >= q.min(axis=0) - _ROUNDING).all() and (curve <= q.max(axis=0) + _ROUNDING).all()
    return bool(inside and np.abs(curve - q[begin : end + 1]).max() <= tolerance)
