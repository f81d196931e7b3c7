"""The scope: signals of every cycle over 20 ms to 60 s, decimated by least and largest value, held by a trigger."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.api import RecordSchema, RtcpError
from rtcp.api.feed import Records
from rtcp.config.model import ArmConfig

_HIDDEN = frozenset({"number", "cycle", "time_ns", "dc_time_ns", "flags", "held", "statusword", "wkc_expected"})
"""Fields that are of no use as curves."""
EVENTS = {"state": "the machine's state changes", "fault": "a fault begins", "inputs": "an input changes"}
SHORTEST_S, LONGEST_S = 0.02, 60.0
MOST_SIGNALS = 8
COLUMNS = 600
"""Columns of a picture; each has the least and the largest value of its cycles."""
_BEFORE = 0.2
"""Share of the picture before its trigger."""


def signals_of(config: ArmConfig, schema: RecordSchema) -> dict[str, str]:
    """Return the signals, `name` or `name.number`, with their labels: every field, and the following error."""
    joints = [joint.name for joint in config.joints]
    vectors = {field.name: field.count for field in schema.fields if field.shape and field.name not in _HIDDEN}
    vectors["following_error"] = len(joints)
    named = {
        f"{name}.{at}": f"{_words(name)} {joints[at] if count == len(joints) else at}"
        for name, count in vectors.items()
        for at in range(count)
    }
    single = [field.name for field in schema.fields if not field.shape and field.name not in _HIDDEN]
    return named | {name: _words(name) for key in single for name in [key[:-3] + "_us" if key.endswith("_ns") else key]}


def _words(name: str) -> str:
    return name.replace("_", " ")


class Scope:
    """One picture.

    Args:
        allowed: all signals of the platform, the keys of `signals_of`.
        signals: the signals of the picture, 1 to `MOST_SIGNALS`.
        span_s: duration that the picture shows, s.
        trigger: a signal, or a key of `EVENTS`; empty: none, the picture rolls.
        level: value of the trigger signal whose rising crossing triggers.
        period_ns: period of the cycle, ns.

    Raises:
        RtcpError: `invalid`: an unknown signal, or a number of signals or a duration out of range.
    """

    def __init__(
        self, allowed: Collection[str], signals: list[str], span_s: float, trigger: str, level: float, period_ns: int
    ) -> None:
        for signal in (*signals, *([trigger] if trigger and trigger not in EVENTS else [])):
            if signal not in allowed:
                raise RtcpError("invalid", f'signals: found "{signal}", allowed are {", ".join(allowed)}')
        if not 0 < len(signals) <= MOST_SIGNALS:
            raise RtcpError("invalid", f"signals: found {len(signals)}, allowed are 1 to {MOST_SIGNALS}")
        if not SHORTEST_S <= span_s <= LONGEST_S:
            raise RtcpError("invalid", f"time base: found {span_s:g} s, allowed are {SHORTEST_S:g} to {LONGEST_S:g} s")
        self.signals, self.span_s = signals, span_s
        self._trigger, self._level = trigger, level
        count = int(span_s * 1e9 / period_ns) + 2
        self._capacity = 2 * count
        self._time = np.empty(0, dtype=np.int64)
        self._values = np.empty((len(signals) + 1, 0), dtype=np.float32)
        """One row for each signal, then that of the trigger."""
        self._at_ns = 0
        """Instant of the trigger; 0: not triggered yet."""
        self._shown: dict[str, Any] | None = None

    def read(self, records: Records) -> None:
        """Read the next cycle records, oldest first."""
        if not len(records):
            return
        trigger = self._trigger or self.signals[0]
        rows = [_column(records, signal) for signal in (*self.signals, trigger)]
        self._time = np.concatenate([self._time, records["time_ns"]])[-self._capacity :]
        self._values = np.concatenate([self._values, np.array(rows, dtype=np.float32)], axis=1)[:, -self._capacity :]
        if self._trigger and not self._at_ns:
            self._find_trigger(len(records))

    def _find_trigger(self, fresh: int) -> None:
        """Search the last `fresh` records for the trigger."""
        values = self._values[-1][-fresh - 1 :]
        if self._trigger == "fault":
            triggered = (values[1:] > 0) & (values[:-1] == 0)
        elif self._trigger in EVENTS:
            triggered = values[1:] != values[:-1]
        else:
            triggered = (values[:-1] < self._level) & (values[1:] >= self._level)
        if len(hits := np.flatnonzero(triggered)):
            self._at_ns = int(self._time[-len(values) + 1 + int(hits[0])])

    def block(self) -> dict[str, Any] | None:
        """Return the picture: `t`, s, from its trigger or its end, and `y`, values by signal; None: it is unchanged."""
        if not len(self._time):
            return None
        span_ns = int(self.span_s * 1e9)
        if self._trigger:
            if not self._at_ns or self._time[-1] < self._at_ns + (1 - _BEFORE) * span_ns:
                return None
            zero = self._at_ns
            begin = zero - int(_BEFORE * span_ns)
            self._at_ns = 0
        else:
            zero = int(self._time[-1])
            begin = zero - span_ns
        inside = (self._time >= begin) & (self._time <= begin + span_ns)
        time_s, values = (self._time[inside] - zero) * 1e-9, self._values[:-1, inside]
        time_s, values = decimated(time_s, values)
        y = [[round(float(value), 7) for value in line] for line in values]
        return {"t": [round(float(t), 6) for t in time_s], "y": y, "signals": self.signals, "span": self.span_s}


def decimated(time_s: npt.NDArray[Any], values: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return at most `COLUMNS` times two samples of each line: the least and the largest of every column."""
    count = len(time_s)
    if count <= 2 * COLUMNS:
        return time_s, values
    edges = np.linspace(0, count, COLUMNS + 1).astype(int)[:-1]
    least, largest = np.minimum.reduceat(values, edges, axis=1), np.maximum.reduceat(values, edges, axis=1)
    both = np.stack([least, largest], axis=2).reshape(len(values), -1)
    return np.repeat(time_s[edges], 2), both


def _column(records: Records, signal: str) -> npt.NDArray[Any]:
    name, _, joint = signal.partition(".")
    if joint:
        at = int(joint)
        if name == "following_error":
            error: npt.NDArray[Any] = records["commanded_position"][:, at] - records["actual_position"][:, at]
            return error
        column: npt.NDArray[Any] = records[name][:, at]
        return column
    if name == "inputs":
        # A hash of the inputs of all boxes: 24 bits, so exact in float32; it changes when an input does.
        mixed = np.zeros(len(records), np.uint64)
        boxes = [box for box in records.dtype.names or () if box.endswith("_inputs") and records[box].ndim == 1]
        for at, box in enumerate(boxes):
            mixed += records[box].astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15 + 2 * at)
        code: npt.NDArray[Any] = mixed >> np.uint64(40)
        return code
    if name.endswith("_us"):
        in_us: npt.NDArray[Any] = records[f"{name[:-3]}_ns"] / 1e3
        return in_us
    single: npt.NDArray[Any] = records[name]
    return single
