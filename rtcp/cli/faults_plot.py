"""The picture of a fault: positions and targets, velocities, frames, with a mark where something happened."""

from __future__ import annotations

import io
import os
import secrets
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rtcp.cli.faults_summary import Mark, marks, seconds
from rtcp.gateway.blackbox_file import Recording

COLOURS = ("#1c6dd0", "#e07a1f", "#2f9e44", "#d1322d", "#7b4fb3", "#8a5a33", "#d264a6", "#6b7280", "#a39b1e", "#1fa5b5")
"""One a joint."""
_ROWS = {"position, rad": 3.0, "velocity, rad/s": 2.0, "wkc": 0.8, "lost cycles": 0.8}
"""From top to bottom, with their heights."""
_MARKS = 12
"""So many are named; those nearest to the fault."""
_NEAR = (-0.1, 0.4)
"""s around the fault, drawn larger."""
_LINE = 0.155
"""inch"""
_WIDTH = 150
"""Letters of a line below the picture."""


def draw(recording: Recording, out: Path) -> None:
    """Draw a recording into a file; its ending chooses the format.

    Raises:
        OSError: it cannot be written.
    """
    about = recording.about
    named = sorted(sorted(marks(recording), key=lambda mark: abs(mark.at_s))[:_MARKS], key=lambda mark: mark.at_s)
    legend = [_wrapped(f"{i}  {mark.at_s:+.3f} s  {mark.sentence}") for i, mark in enumerate(named, 1)]
    rows = sum(text.count("\n") + 1 for text in legend)
    height = 8.8 + _LINE * rows
    figure = Figure(figsize=(13.0, height))
    figure.text(0.065, 1 - 0.3 / height, f"fault {about.number}: {_short(about.what)}", fontsize=13, weight="bold")
    below = f"{about.when:%Y-%m-%d %H:%M:%S}, {about.arm} on {about.bus}, every {about.period_ns / 1000:g} us"
    figure.text(
        0.065, 1 - 0.55 / height, f"{below}, {about.before} before; targets dashed; gaps: not heard", fontsize=10
    )
    grid = figure.add_gridspec(
        len(_ROWS), 2, height_ratios=tuple(_ROWS.values()), width_ratios=(2, 1), hspace=0.09, wspace=0.07,
        left=0.065, right=0.88, top=1 - 0.95 / height, bottom=(0.8 + _LINE * rows) / height,
    )  # fmt: skip
    whole = [figure.add_subplot(grid[row, 0]) for row in range(len(_ROWS))]
    near = [figure.add_subplot(grid[row, 1], sharey=whole[row]) for row in range(len(_ROWS))]
    if about.at >= 0:
        times = seconds(recording)
        for axes, begin, end in ((whole, float(times[0]), float(times[-1])), (near, *_NEAR)):
            _curves(axes, recording, max(begin, float(times[0])), max(min(end, float(times[-1])), begin + 1e-3))
        for row in (0, 2, 3):
            near[row].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize=8.5, frameon=False)
    for one, name in zip(whole, _ROWS, strict=True):
        one.set_ylabel(name)
    for axes in (whole, near):
        for one in axes[:-1]:
            one.tick_params(labelbottom=False)
        axes[-1].set_xlabel("s from the fault on")
        _mark(axes, named)
    for one in near:
        one.tick_params(labelleft=False)
    figure.text(0.065, 0.15 / height, "\n".join(legend), fontsize=8.5, va="bottom", linespacing=1.25)
    _save(figure, out)


def _save(figure: Figure, out: Path) -> None:
    """Write the picture beside and rename it: what a link at that place leads to stays as it is."""
    drawn = io.BytesIO()
    figure.savefig(drawn, format=out.suffix[1:].lower(), dpi=110)
    new = out.with_name(f".{out.stem}-{secrets.token_hex(4)}{out.suffix}")
    try:
        with open(new, "xb") as file:
            file.write(drawn.getbuffer())
        os.replace(new, out)
    finally:
        new.unlink(missing_ok=True)


def _curves(axes: Sequence[Any], recording: Recording, begin: float, end: float) -> None:
    records, times = recording.records, seconds(recording)
    where, speed, counter, lost = axes
    # What a drive says is taken over only with the right working counter: else the last of it would be drawn on.
    heard = records["lost"] == 0
    for at, name in enumerate(recording.about.joints):
        where.plot(times, np.where(heard, records["position"][:, at], np.nan), color=COLOURS[at], lw=1.3, label=name)
        where.plot(times, records["target"][:, at], color=COLOURS[at], lw=1.1, ls=(0, (4, 3)))
        speed.plot(times, np.where(heard, records["velocity"][:, at], np.nan), color=COLOURS[at], lw=1.0)
    counter.plot(times, records["wkc"], color=COLOURS[0], lw=1.1, drawstyle="steps-post", label="found")
    counter.plot(times, records["wkc_expected"], color="black", lw=0.9, ls=":", label="expected")
    lost.plot(times, records["lost"], color=COLOURS[3], lw=1.1, drawstyle="steps-post", label="in a row")
    missed = np.diff(records["missed"].astype(np.int64), prepend=int(records["missed"][0])) > 0
    if missed.any():
        lost.plot(times[missed], np.zeros(np.count_nonzero(missed)), "|", color=COLOURS[4], ms=9, label="no frame sent")
    for one in (counter, lost):
        one.yaxis.get_major_locator().set_params(integer=True, nbins=4)
    for one in axes:
        one.set_xlim(begin, end)
        one.grid(alpha=0.25)


def _mark(axes: Sequence[Any], named: Sequence[Mark]) -> None:
    """Draw a line for each mark; numbers of marks that would stand on each other stand together."""
    for one in axes:
        one.axvline(0.0, color="#d1322d", lw=1.4, alpha=0.8)
        for mark in named:
            one.axvline(mark.at_s, color="black", lw=0.6, alpha=0.35)
    left, right = axes[0].get_xlim()
    shown = [(number, mark.at_s) for number, mark in enumerate(named, 1) if left <= mark.at_s <= right]
    groups: list[list[tuple[int, float]]] = []
    for number, at_s in shown:
        if groups and at_s - groups[-1][0][1] < 0.07 * (right - left):
            groups[-1].append((number, at_s))
        else:
            groups.append([(number, at_s)])
    for group in groups:
        numbers = [number for number, _ in group]
        text = str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]}-{numbers[-1]}"
        place = axes[0].get_xaxis_transform()
        axes[0].text(group[0][1], 1.01, text, transform=place, fontsize=8.5, ha="center", va="bottom")


def _short(what: str) -> str:
    return textwrap.shorten(what.partition(";")[0], 95, placeholder=" ...")


def _wrapped(text: str) -> str:
    return textwrap.fill(text, _WIDTH, subsequent_indent=" " * 8)
