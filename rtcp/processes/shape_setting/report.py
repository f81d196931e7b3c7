"""Report of a run of shape setting: a page with pictures, and the same as JSON."""

from __future__ import annotations

import html
import json
from pathlib import Path
from typing import Any

import numpy as np

from rtcp.processes.rod.set_shape import aligned
from rtcp.processes.shape_setting.heat_profile import HeatProfile, target_temperatures
from rtcp.processes.shape_setting.job import Job
from rtcp.processes.shape_setting.profile import temperatures_along
from rtcp.processes.shape_setting.run import Array, Outcome

_SHAPES = (("wanted", "k--"), ("held", "tab:blue"), ("released", "tab:red"))
_PLACES, _MOST_TIMES = 61, 300
"""Size of the grid of temperatures along the rod over time."""


def write_report(folder: Path, job: Job, profile: HeatProfile, outcome: Outcome, problem: str) -> Path:
    """Write `report.html`, `report.json` and, as far as measured, `shape.png`, `heat.png`, `along.png`, `set.png`.

    Returns the page.

    Args:
        folder: which exists.
        job: the shape.
        profile: of the heat.
        outcome: results of the run.
        problem: cause of an early end; empty: none.
    """
    along = _temperatures(profile, outcome)
    facts = _facts(job, profile, outcome, problem)
    (folder / "report.json").write_text(json.dumps(_plain(facts, outcome, along), indent=1))
    drawn = (_shapes(folder, outcome), _heat(folder, outcome), _along(folder, along), _set(folder, outcome))
    pictures = [picture for picture in drawn if picture]
    rows = "".join(f"<tr><th scope=row>{html.escape(k)}<td>{html.escape(str(v))}" for k, v in facts.items())
    steps = "".join(f"<tr><td>{at:.1f} s<td>{html.escape(event)}" for at, event in outcome.steps)
    interlocks = "".join(f"<tr><th scope=row>{name}<td>{state}" for name, state in outcome.interlocks.items())
    images = "".join(
        f'<figure><img src="{name}" alt="{html.escape(text)}"><figcaption>{html.escape(text)}</figcaption></figure>'
        for name, text in pictures
    )
    page = folder / "report.html"
    page.write_text(
        f"<!doctype html><html lang=en><meta charset=utf-8><title>Shape setting</title>"
        "<style>body{font:16px sans-serif;max-width:60em;margin:2em auto}"
        "figure{margin:1em 0}td,th{text-align:left;padding:.2em 1em .2em 0}img{max-width:100%}</style>"
        f"<h1>Shape setting</h1><table>{rows}</table>{images}<h2>Steps</h2><table>{steps}</table>"
        f"<h2>Interlocks at the end</h2><table>{interlocks}</table></html>\n"
    )
    return page


def _facts(job: Job, profile: HeatProfile, outcome: Outcome, problem: str) -> dict[str, str]:
    mean, middle = target_temperatures(profile)
    facts = {
        "result": problem or "the profile is complete",
        "rod": f"{1e3 * job.rod.diameter:g} mm, {job.rod.length:g} m between the chucks",
        "largest strain of the bend": f"{100 * outcome.strain:.2f} %",
        "target": f"{middle}; {mean}",
        "initial resistance": f"{1e3 * outcome.initial_resistance:.3f} mohm",
        "energy": f"{outcome.energy:.0f} J",
    }
    if outcome.samples["middle_temperature"]:
        facts["hottest middle, by the resistance"] = f"{max(outcome.samples['middle_temperature']):.1f} C"
    if outcome.highest is not None:
        facts["hottest place of the rod"] = f"{float(outcome.highest.max()):.1f} C"
    if outcome.released is not None:
        largest, mean_square = outcome.error
        facts["released rod against the wanted one"] = f"{1e3 * mean_square:.2f} mm rms, {1e3 * largest:.2f} mm at most"
        is_straight = sum(outcome.straight) >= job.rod.length
        ends = " and ".join(f"{1e3 * length:.0f} mm" for length in outcome.straight)
        facts["ends that stay straight"] = (
            "the whole rod: less than half of the bend is set anywhere" if is_straight else ends
        )
    return facts


def _temperatures(profile: HeatProfile, outcome: Outcome) -> tuple[Array, Array, Array] | None:
    """Return the temperatures along the rod over time: times, s, (k,), places, m, (n,), and the grid, (n, k), C."""
    if len(outcome.times) < 2:
        return None
    chosen = np.linspace(0, len(outcome.times) - 1, min(_MOST_TIMES, len(outcome.times))).round().astype(int)
    places = np.linspace(0.0, profile.ends.length, _PLACES)
    middle = np.array(outcome.samples["middle_temperature"])[chosen]
    return np.array(outcome.times)[chosen], places, temperatures_along(profile, places, middle)


def _plain(facts: dict[str, str], outcome: Outcome, along: tuple[Array, Array, Array] | None) -> dict[str, Any]:
    content: dict[str, Any] = {"facts": facts}
    if along is not None:
        times, places, grid = along
        content["along"] = {"times": times.tolist(), "s": places.tolist(), "celsius": grid.round(1).tolist()}
    for name, value in vars(outcome).items():
        content[name] = value.tolist() if isinstance(value, np.ndarray) else value
    return content


def _shapes(folder: Path, outcome: Outcome) -> tuple[str, str] | None:
    if outcome.wanted is None:
        return None
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for name, style in _SHAPES:
        curve: Array | None = getattr(outcome, name)
        if curve is None:
            continue
        if name == "released":
            curve = aligned(curve, outcome.wanted)
        for axis, (across, words) in zip(axes, ((1, "y"), (2, "z")), strict=True):
            axis.plot(1e3 * curve[:, 0], 1e3 * curve[:, across], style, label=name)
            axis.set_xlabel("x, mm")
            axis.set_ylabel(f"{words}, mm")
            axis.set_aspect("equal", "datalim")
            axis.grid(visible=True)
    axes[1].legend()
    figure.savefig(folder / "shape.png", dpi=120)
    plt.close(figure)
    return "shape.png", "the rod from two sides: wanted, held by the arms, and after its release"


def _heat(folder: Path, outcome: Outcome) -> tuple[str, str] | None:
    if not outcome.times:
        return None
    import matplotlib.pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, figsize=(10, 6), sharex=True, layout="constrained")
    for name, style in (
        ("setpoint_middle", "k--"),
        ("middle_temperature", "tab:red"),
        ("mean_temperature", "tab:blue"),
    ):
        above.plot(outcome.times, outcome.samples[name], style, label=name.replace("_", " "))
    above.set_ylabel("C")
    above.legend()
    below.plot(outcome.times, outcome.samples["average_current"], "tab:green")
    below.set_ylabel("average current, A")
    below.set_xlabel("s")
    for axis in (above, below):
        axis.grid(visible=True)
    figure.savefig(folder / "heat.png", dpi=120)
    plt.close(figure)
    return "heat.png", "temperatures by the resistance, and the average current, over time"


def _along(folder: Path, along: tuple[Array, Array, Array] | None) -> tuple[str, str] | None:
    if along is None:
        return None
    import matplotlib.pyplot as plt

    times, places, grid = along
    figure, axis = plt.subplots(figsize=(10, 3.5), layout="constrained")
    mesh = axis.pcolormesh(times, 1e3 * places, grid, cmap="inferno", shading="gouraud")
    figure.colorbar(mesh, ax=axis, label="C")
    axis.set_xlabel("s")
    axis.set_ylabel("along the rod, mm")
    figure.savefig(folder / "along.png", dpi=120)
    plt.close(figure)
    return "along.png", "temperature along the rod over time, by the resistance and the cold ends of the profile"


def _set(folder: Path, outcome: Outcome) -> tuple[str, str] | None:
    if outcome.s is None or outcome.fraction is None or outcome.highest is None:
        return None
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(10, 3.5), layout="constrained")
    axis.plot(1e3 * outcome.s, outcome.highest, "tab:red")
    axis.set_ylabel("highest temperature, C")
    axis.set_xlabel("along the rod, mm")
    axis.grid(visible=True)
    right_axis = axis.twinx()
    right_axis.plot(1e3 * outcome.s, outcome.fraction, "tab:blue")
    right_axis.set_ylabel("set, 0 to 1")
    figure.savefig(folder / "set.png", dpi=120)
    plt.close(figure)
    return "set.png", "highest temperature along the rod, red, and which part of the bend is set, blue"
