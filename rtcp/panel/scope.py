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
"""Fields that no curve shows anything of."""
EVENTS = {"state": "the machine's state changes", "fault": "a fault begins", "inputs": "an input changes"}
SHORTEST_S, LONGEST_S = 0.02, 60.0
MOST_SIGNALS = 8
COLUMNS = 600
"""Of a picture; each has the least and the largest value of its cycles."""
_BEFORE = 0.2
"""Share of the picture before its trigger."""


def signals_of(config: ArmConfig, schema: RecordSchema) -> dict[str, str]:
    """Return the signals, `name` or `name.number`, with what a person reads: every field, and the following error."""
    joints = [joint.name for joint in config.joints]
    vectors = {one.name: one.count for one in schema.fields if one.shape and one.name not in _HIDDEN}
    vectors["following_error"] = len(joints)
    named = {
        f"{name}.{at}": f"{_words(name)} {joints[at] if count == len(joints) else at}"
        for name, count in vectors.items()
        for at in range(count)
    }
    single = [one.name for one in schema.fields if not one.shape and one.name not in _HIDDEN]
    return named | {name: _words(name) for one in single for name in [one[:-3] + "_us" if one.endswith("_ns") else one]}


def _words(name: str) -> str:
    return name.replace("_", " ")


class Scope:
    """One picture.

    Args:
        allowed: the signals that there are, of `signals_of`.
        signals: of `signals_of`, at most `MOST_SIGNALS`.
        span_s: of the picture, s.
        trigger: a signal, or of `EVENTS`; empty: none, the picture rolls.
        level: of a signal that triggers as it rises through it.
        period_ns: of a cycle.

    Raises:
        Invalid: of something else.
    """

    def __init__(
        self, allowed: Collection[str], signals: list[str], span_s: float, trigger: str, level: float, period_ns: int
    ) -> None:
        for one in (*signals, *([trigger] if trigger and trigger not in EVENTS else [])):
            if one not in allowed:
                raise RtcpError("invalid", f'signals: found "{one}", allowed are {", ".join(allowed)}')
        if not 0 < len(signals) <= MOST_SIGNALS:
            raise RtcpError("invalid", f"signals: found {len(signals)}, allowed are 1 to {MOST_SIGNALS}")
        if not SHORTEST_S <= span_s <= LONGEST_S:
            raise RtcpError("invalid", f"time base: found {span_s:g} s, allowed are {SHORTEST_S:g} to {LONGEST_S:g} s")
        self.signals, self.span_s = signals, span_s
        self._trigger, self._level = trigger, level
        count = int(span_s * 1e9 / period_ns) + 2
        self._kept = 2 * count
        self._time = np.empty(0, dtype=np.int64)
        self._values = np.empty((len(signals) + 1, 0), dtype=np.float32)
        """A row a signal, and one of what triggers."""
        self._at_ns = 0
        """Instant of the trigger; 0: it is waited for."""
        self._shown: dict[str, Any] | None = None

    def read(self, records: Records) -> None:
        """Take the next cycle records, oldest first."""
        if not len(records):
            return
        source = self._trigger or self.signals[0]
        rows = [_column(records, one) for one in (*self.signals, source)]
        self._time = np.concatenate([self._time, records["time_ns"]])[-self._kept :]
        self._values = np.concatenate([self._values, np.array(rows, dtype=np.float32)], axis=1)[:, -self._kept :]
        if self._trigger and not self._at_ns:
            self._look_for_trigger(len(records))

    def _look_for_trigger(self, fresh: int) -> None:
        after = self._values[-1][-fresh - 1 :]
        if self._trigger == "fault":
            found = (after[1:] > 0) & (after[:-1] == 0)
        elif self._trigger in EVENTS:
            found = after[1:] != after[:-1]
        else:
            found = (after[:-1] < self._level) & (after[1:] >= self._level)
        if len(hits := np.flatnonzero(found)):
            self._at_ns = int(self._time[-len(after) + 1 + int(hits[0])])

    def block(self) -> dict[str, Any] | None:
        """Return the picture: `t`, s, from its trigger or its end, and `y`, values by signal; None: no new one."""
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
        y = [[round(float(one), 7) for one in line] for line in values]
        return {"t": [round(float(one), 6) for one in time_s], "y": y, "signals": self.signals, "span": self.span_s}


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
        # Any box: a number, exact in float32, that changes whenever one of them does.
        mixed = np.zeros(len(records), np.uint64)
        boxes = [one for one in records.dtype.names or () if one.endswith("_inputs") and records[one].ndim == 1]
        for at, one in enumerate(boxes):
            mixed += records[one].astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15 + 2 * at)
        shown: npt.NDArray[Any] = mixed >> np.uint64(40)
        return shown
    if name.endswith("_us"):
        in_us: npt.NDArray[Any] = records[f"{name[:-3]}_ns"] / 1e3
        return in_us
    single: npt.NDArray[Any] = records[name]
    return single
