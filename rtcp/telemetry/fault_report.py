"""Summary and picture of a black box recording: positions, targets, velocities, frames and events."""

from __future__ import annotations

import io
import os
import secrets
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from rtcp.ipc.recording import FaultRecording
from rtcp.ipc.states import State
from rtcp.telemetry.reading import target_steps

COLOURS = ("#1c6dd0", "#e07a1f", "#2f9e44", "#d1322d", "#7b4fb3", "#8a5a33", "#d264a6", "#6b7280", "#a39b1e", "#1fa5b5")
"""Colour of each joint."""
_PLOTS = {"position, rad": 3.0, "velocity, rad/s": 2.0, "wkc": 0.8, "lost cycles": 0.8}
"""Plots from top to bottom and their relative heights."""
_EVENTS = 12
"""Number of events in the legend: those nearest to the fault."""
_DETAIL_S = (-0.1, 0.4)
"""Time around the fault in the enlarged column, s."""
_LINE_INCH, _LINE_LETTERS = 0.155, 150
"""Height and length of a line of the legend."""
_STATES = {int(state): state.name.lower().replace("_", " ") for state in State}


class Entry(NamedTuple):
    """An entry of the timeline: instant, s after the fault, and message."""

    at_s: float
    message: str


def seconds(recording: FaultRecording) -> npt.NDArray[np.float64]:
    """Return the instant of each cycle, shape (cycles,), s after the fault."""
    instants = recording.records["time_ns"]
    relative: npt.NDArray[np.float64] = (instants - instants[recording.about.at]) * 1e-9
    return relative


def timeline(recording: FaultRecording) -> list[Entry]:
    """Return the messages and each change of the machine's state, ordered by time."""
    about = recording.about
    entries = [Entry((moment.time_ns - about.time_ns) * 1e-9, moment.message) for moment in about.timeline]
    if about.at >= 0:
        states, times = recording.records["state"], seconds(recording)
        names = [_STATES.get(int(state), str(state)) for state in states]
        entries += [
            Entry(float(times[i + 1]), f"state: {names[i]} -> {names[i + 1]}")
            for i in np.flatnonzero(np.diff(states.astype(np.int64)))
        ]
    return sorted(entries, key=lambda entry: entry.at_s)


def summary(recording: FaultRecording) -> dict[str, Any]:
    """Return a recording in SI units, without its cycles."""
    about, records = recording.about, recording.records
    head = {
        "number": about.number,
        "time": about.when.isoformat(timespec="milliseconds"),
        "what": about.what,
        "before": about.before,
        "arm": about.arm,
        "bus": about.bus,
        "cycle_ns": about.period_ns,
        "versions": about.versions,
        "notes": list(about.notes),
        "timeline": [{"t_s": round(entry.at_s, 4), "message": entry.message} for entry in timeline(recording)],
        "joint_names": list(about.joints),
    }
    if about.at < 0:
        return head
    at, times = about.at, seconds(recording)
    return head | {
        "begins_s": round(float(times[0]), 4),
        "ends_s": round(float(times[-1]), 4),
        "cycles": len(times),
        "joints": {
            name: [round(float(value), 7) for value in records[name][at]]
            for name in ("actual_position", "sent_position", "actual_velocity", "actual_torque")
        },
        "largest_step": _largest_step(recording),
        "missed": int(records["missed"][-1]) - int(records["missed"][0]),
        "wkc": {
            "expected": int(records["wkc_expected"][at]),
            "actual": int(records["wkc"][at]),
            "wrong_cycles": int(np.count_nonzero(records["wkc"] != records["wkc_expected"])),
            "without_answer": int(np.count_nonzero(records["wkc"] < 0)),
        },
    }


def _largest_step(recording: FaultRecording) -> dict[str, Any] | None:
    """Return the largest step of a target between two cycles with enabled drives; None where there is none."""
    cycles, steps = target_steps(recording.records)
    if not steps.size:
        return None
    row, joint = np.unravel_index(int(np.argmax(steps)), steps.shape)
    step = float(steps[row, joint])
    return {
        "joint": recording.about.joints[int(joint)],
        "rad": step,
        "rad_per_s": step / (recording.about.period_ns * 1e-9),
        "t_s": round(float(seconds(recording)[cycles[row]]), 4),
    }


def draw(recording: FaultRecording, out: Path) -> None:
    """Draw a recording into a file; its ending chooses the format.

    Raises:
        OSError: the file cannot be written.
    """
    about = recording.about
    nearest = sorted(timeline(recording), key=lambda entry: abs(entry.at_s))[:_EVENTS]
    events = sorted(nearest, key=lambda entry: entry.at_s)
    legend = "\n".join(
        textwrap.fill(f"{i}  {event.at_s:+.3f} s  {event.message}", _LINE_LETTERS, subsequent_indent=" " * 8)
        for i, event in enumerate(events, 1)
    )
    legend_inch = _LINE_INCH * (legend.count("\n") + 1)
    height = 8.8 + legend_inch
    figure = Figure(figsize=(13.0, height))
    title = textwrap.shorten(about.what.partition(";")[0], 95, placeholder=" ...")
    figure.text(0.065, 1 - 0.3 / height, f"fault {about.number}: {title}", fontsize=13, weight="bold")
    head = f"{about.when:%Y-%m-%d %H:%M:%S}, {about.arm} on {about.bus}, every {about.period_ns / 1000:g} us"
    head += f", {about.before} before; targets dashed; gaps: no data"
    figure.text(0.065, 1 - 0.55 / height, head, fontsize=10)
    grid = figure.add_gridspec(
        len(_PLOTS), 2, height_ratios=tuple(_PLOTS.values()), width_ratios=(2, 1), hspace=0.09, wspace=0.07,
        left=0.065, right=0.88, top=1 - 0.95 / height, bottom=(0.8 + legend_inch) / height,
    )  # fmt: skip
    whole = [figure.add_subplot(grid[row, 0]) for row in range(len(_PLOTS))]
    detail = [figure.add_subplot(grid[row, 1], sharey=whole[row]) for row in range(len(_PLOTS))]
    if about.at >= 0:
        times = seconds(recording)
        first, last = float(times[0]), float(times[-1])
        for axes, begin, end in ((whole, first, last), (detail, *_DETAIL_S)):
            _curves(axes, recording, max(begin, first), max(min(end, last), begin + 1e-3))
        for row in (0, 2, 3):
            detail[row].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8.5, frameon=False)
    for plot, name in zip(whole, _PLOTS, strict=True):
        plot.set_ylabel(name)
    for axes in (whole, detail):
        for plot in axes[:-1]:
            plot.tick_params(labelbottom=False)
        axes[-1].set_xlabel("s after the fault")
        _mark(axes, events)
    for plot in detail:
        plot.tick_params(labelleft=False)
    figure.text(0.065, 0.15 / height, legend, fontsize=8.5, va="bottom", linespacing=1.25)
    save(figure, out)


def save(figure: Figure, out: Path) -> None:
    """Write a picture to a new file and rename it, which does not overwrite the target of a link at that path.

    Raises:
        OSError: it cannot be written.
    """
    drawn = io.BytesIO()
    figure.savefig(drawn, format=out.suffix[1:].lower(), dpi=110)
    new = out.with_name(f".{out.stem}-{secrets.token_hex(4)}{out.suffix}")
    try:
        with open(new, "xb") as file:
            file.write(drawn.getbuffer())
        os.replace(new, out)
    finally:
        new.unlink(missing_ok=True)


def _curves(axes: Sequence[Any], recording: FaultRecording, begin: float, end: float) -> None:
    records, times = recording.records, seconds(recording)
    positions, velocities, counter, lost = axes
    # Drive data is valid only with the expected working counter; elsewhere the record repeats the last value.
    valid = records["lost"] == 0
    for at, name in enumerate(recording.about.joints):
        actual, speed = (np.where(valid, records[key][:, at], np.nan) for key in ("actual_position", "actual_velocity"))
        positions.plot(times, actual, color=COLOURS[at], lw=1.3, label=name)
        positions.plot(times, records["sent_position"][:, at], color=COLOURS[at], lw=1.1, ls=(0, (4, 3)))
        velocities.plot(times, speed, color=COLOURS[at], lw=1.0)
    counter.plot(times, records["wkc"], color=COLOURS[0], lw=1.1, drawstyle="steps-post", label="found")
    counter.plot(times, records["wkc_expected"], color="black", lw=0.9, ls=":", label="expected")
    lost.plot(times, records["lost"], color=COLOURS[3], lw=1.1, drawstyle="steps-post", label="in a row")
    missed = np.diff(records["missed"].astype(np.int64), prepend=int(records["missed"][0])) > 0
    if missed.any():
        lost.plot(times[missed], np.zeros(np.count_nonzero(missed)), "|", color=COLOURS[4], ms=9, label="no frame sent")
    for plot in (counter, lost):
        plot.yaxis.get_major_locator().set_params(integer=True, nbins=4)
    for plot in axes:
        plot.set_xlim(begin, end)
        plot.grid(alpha=0.25)


def _mark(axes: Sequence[Any], events: Sequence[Entry]) -> None:
    """Draw a line for each event; numbers that would overlap are joined."""
    for plot in axes:
        plot.axvline(0.0, color="#d1322d", lw=1.4, alpha=0.8)
        for event in events:
            plot.axvline(event.at_s, color="black", lw=0.6, alpha=0.35)
    left, right = axes[0].get_xlim()
    groups: list[list[tuple[int, float]]] = []
    for number, (at_s, _) in enumerate(events, 1):
        if not left <= at_s <= right:
            continue
        if groups and at_s - groups[-1][0][1] < 0.07 * (right - left):
            groups[-1].append((number, at_s))
        else:
            groups.append([(number, at_s)])
    for group in groups:
        first, last = group[0][0], group[-1][0]
        text = str(first) if first == last else f"{first}-{last}"
        place = axes[0].get_xaxis_transform()
        axes[0].text(group[0][1], 1.01, text, transform=place, fontsize=8.5, ha="center", va="bottom")
