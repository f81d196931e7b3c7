"""Limits that change while frames go by: when exactly is not known on the wire, so the wider of both hold meanwhile."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from rtcp.motion.limits import Corners, Values
from tests.sessions.judge import Bounds, Judge

_JOINT_KEYS = {"min": "low", "max": "high", "velocity": "velocity", "acceleration": "acceleration", "torque": "torque"}


@dataclass(frozen=True)
class Change:
    """New limits, in force from some frame between two instants (ns, CLOCK_MONOTONIC) on."""

    asked_ns: int
    done_ns: int
    new: Values


class Limiter:
    """Gives the judge the limits of the time of each frame.

    Args:
        judge: whose bounds are kept up to date.
        first: in force before all changes.
        changes: in their order.
        slack_ns: so long before and after the question and the answer the wider limits hold, too.
    """

    def __init__(self, judge: Judge, first: Values, changes: Iterable[Change], slack_ns: int) -> None:
        self._judge = judge
        self._now = first
        self._changes = [*changes]
        self._slack_ns = slack_ns
        self._between = False

    def at(self, now_ns: int) -> None:
        """Put the limits of `now_ns` into the judge's bounds."""
        while self._changes:
            change = self._changes[0]
            if now_ns < change.asked_ns - self._slack_ns:
                return
            if now_ns <= change.done_ns + self._slack_ns:
                if not self._between:
                    self._between = True
                    put(self._judge.bounds, wider(self._now, change.new))
                return
            self._now, self._between = change.new, False
            del self._changes[0]
            put(self._judge.bounds, self._now)
            self._judge.changed()


def put(bounds: Bounds, new: Values) -> None:
    """Change `bounds` in place."""
    bounds.low[:], bounds.high[:] = new.low, new.high
    bounds.velocity[:], bounds.acceleration[:], bounds.torque[:] = new.velocity, new.acceleration, new.torque
    bounds.box = None if new.box is None else (new.box[:3], new.box[3:])
    bounds.keep_out[:] = [(box[:3], box[3:]) for box in new.keep_out]


def wider(a: Values, b: Values) -> Values:
    """Return limits that allow what either of two allows."""
    return replace(
        a,
        low=tuple(map(min, a.low, b.low)),
        high=tuple(map(max, a.high, b.high)),
        **{
            name: tuple(map(max, getattr(a, name), getattr(b, name))) for name in ("velocity", "acceleration", "torque")
        },
        box=None if a.box is None or b.box is None else _hull(a.box, b.box),
        keep_out=tuple(_common(one, other) for one, other in zip(a.keep_out, b.keep_out, strict=True)),
    )


def _hull(a: Corners, b: Corners) -> Corners:
    return (*map(min, a[:3], b[:3]), *map(max, a[3:], b[3:]))  # type: ignore[return-value]


def _common(a: Corners, b: Corners) -> Corners:
    return (*map(max, a[:3], b[:3]), *map(min, a[3:], b[3:]))  # type: ignore[return-value]


def from_answer(shown: Mapping[str, Any], jerk: tuple[float, ...]) -> Values:
    """Return the limits that an answer to `limits` on the control socket shows (its key `limits`)."""
    found = {name: tuple(shown[key]) for key, name in _JOINT_KEYS.items()}
    return Values(**found, jerk=jerk, box=_corners(shown["box"]), keep_out=tuple(map(_box, shown["keep_out"].values())))


def _box(box: Mapping[str, Any]) -> Corners:
    return (*box["min"], *box["max"])  # type: ignore[return-value]


def _corners(box: Mapping[str, Any] | None) -> Corners | None:
    return None if box is None else _box(box)
