"""Picture of a recording: a plot over time for each signal, with all joints; peaks of a single cycle stay visible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from rtcp.ipc.observer import WARNING
from rtcp.ipc.recording import RecordingError
from rtcp.ipc.states import State
from rtcp.telemetry.fault_report import COLOURS
from rtcp.telemetry.reading import Part, Reader

Array = npt.NDArray[np.float64]
FOLLOWING_ERROR = "following_error"
SIGNALS = ("sent_position", "actual_position", FOLLOWING_ERROR, "actual_velocity", "actual_torque", "wakeup_ns")
"""Default signals; `following_error` is the difference of the first two."""
_BINS = 4096
"""Most spans of time in a plot: more than a picture's width in pixels."""
_MARKS = 30
_STATES = {int(state): state.words for state in State}


class Envelope:
    """Least and greatest value in each of up to 4096 spans of time; the spans grow with the data.

    Args:
        width_s: initial width of a span, s.
        columns: number of values at each instant.
    """

    def __init__(self, width_s: float, columns: int) -> None:
        self._width_s = width_s
        self._low, self._high = np.full((_BINS, columns), np.inf), np.full((_BINS, columns), -np.inf)

    def add(self, seconds: Array, values: Array) -> None:
        """Add values, shape (n, columns), at rising instants of 0 or more, shape (n,), s."""
        while seconds[-1] >= self._width_s * _BINS:
            empty = np.full((_BINS // 2, values.shape[1]), np.inf)
            self._low = np.vstack((np.minimum(self._low[::2], self._low[1::2]), empty))
            self._high = np.vstack((np.maximum(self._high[::2], self._high[1::2]), -empty))
            self._width_s *= 2.0
        bins = (seconds / self._width_s).astype(np.int64)
        starts = np.flatnonzero(np.diff(bins, prepend=-1))
        touched = bins[starts]
        self._low[touched] = np.minimum(self._low[touched], np.minimum.reduceat(values, starts))
        self._high[touched] = np.maximum(self._high[touched], np.maximum.reduceat(values, starts))

    def curve(self) -> tuple[Array, Array]:
        """Return instants, shape (m,), s, and values, shape (m, columns): least and greatest of each span."""
        filled = np.flatnonzero(self._low[:, 0] <= self._high[:, 0])
        values = np.stack((self._low[filled], self._high[filled]), axis=1)
        return np.repeat((filled + 0.5) * self._width_s, 2), values.reshape(-1, values.shape[2])


def figure(reader: Reader) -> Figure:
    """Return the picture of a reader's recording: its signals, or `SIGNALS` where none were chosen.

    Raises:
        RecordingError: none of them can be drawn, or the recording cannot be read.
    """
    names = [name for name in reader.names if name not in ("number", "time_ns")] if reader.signals else list(SIGNALS)
    envelopes: dict[str, Envelope] = {}
    marks: list[tuple[float, str, str]] = []
    state, begin_s = -1, -1.0
    following = _FollowingError()
    for part in reader:
        marks += [(reader.at_s(moment), moment.message, COLOURS[3]) for moment in part.log if moment.level >= WARNING]
        if not len(part.records):
            continue
        seconds = (part.records["time_ns"] - reader.first_ns) * 1e-9
        begin_s = float(seconds[0]) if begin_s < 0.0 else begin_s
        for name in names:
            values = following.of(part) if name == FOLLOWING_ERROR else _values(part, name)
            if values is not None:
                if name not in envelopes:
                    envelopes[name] = Envelope(reader.period_s or 1e-3, values.shape[1])
                envelopes[name].add(seconds - begin_s, values)
        if "state" in reader.names:
            states = part.records["state"].astype(np.int64)
            for at in np.flatnonzero(np.diff(states, prepend=states[0] if state < 0 else state)).tolist():
                marks.append((float(seconds[at]), _STATES.get(int(states[at]), str(states[at])), COLOURS[7]))
            state = int(states[-1])
    if not envelopes:
        allowed = [name for name in reader.names if name not in ("number", "time_ns")]
        raise RecordingError("signals", reader.path, f"there is nothing to draw; it has {', '.join(allowed)}")
    return _draw(reader, envelopes, marks, begin_s)


class _FollowingError:
    """Sent minus actual position: the answer to a frame shows the effect of the frame before."""

    def __init__(self) -> None:
        self._number = -1
        self._sent: Array = np.empty((0, 0))

    def of(self, part: Part) -> Array | None:
        """Return the following error, rad, shape (records, joints), 0 after a gap; None: a position is missing."""
        records = part.records
        if not {"number", "sent_position", "actual_position"} <= set(records.dtype.names or ()):
            return None
        sent, numbers = records["sent_position"], records["number"].astype(np.int64)
        before = np.vstack((self._sent if len(self._sent) else sent[:1], sent[:-1]))
        follows = np.diff(numbers, prepend=self._number) == 1
        self._number, self._sent = int(numbers[-1]), sent[-1:].copy()
        return np.where(follows[:, None], before - records["actual_position"], 0.0)


def _values(part: Part, name: str) -> Array | None:
    """Return a signal, shape (records, columns); None: not in the recording."""
    records = part.records
    return records[name].astype(np.float64).reshape(len(records), -1) if name in (records.dtype.names or ()) else None


def _draw(
    reader: Reader, envelopes: dict[str, Envelope], marks: Sequence[tuple[float, str, str]], begin_s: float
) -> Figure:
    picture = Figure(figsize=(13.0, 1.0 + 2.2 * len(envelopes)), layout="constrained")
    plots: Any = picture.subplots(len(envelopes), 1, sharex=True, squeeze=False)[:, 0]
    joints = reader.about.get("joints", "").split(", ")
    for axes, (name, envelope) in zip(plots, envelopes.items(), strict=True):
        times, values = envelope.curve()
        for at, column in enumerate(values.T):
            label = joints[at] if len(joints) == values.shape[1] > 1 else None
            axes.plot(times + begin_s, column, color=COLOURS[at % len(COLOURS)], lw=0.9, label=label)
        unit = "rad" if name == FOLLOWING_ERROR else reader.schema[name].unit
        axes.set_ylabel(name.removesuffix(f"_{unit}").replace("_", " ") + (f"\n{unit}" if unit else ""))
        axes.grid(alpha=0.25)
        axes.margins(x=0.0)
        for at_s, _, colour in marks[:_MARKS]:
            axes.axvline(at_s, color=colour, lw=0.8, alpha=0.6)
    for at_s, text, colour in marks[:_MARKS]:
        plots[0].text(
            at_s, 1.02, text[:40], transform=plots[0].get_xaxis_transform(), color=colour, fontsize=7, rotation=25
        )
    if handles := plots[0].get_legend_handles_labels()[0]:
        plots[0].legend(handles=handles, ncols=len(handles), fontsize=8, loc="upper right")
    plots[-1].set_xlabel("s from the first record")
    picture.suptitle(f"{reader.path.name}   {reader.about.get('arm', '')}", fontsize=11)
    return picture
