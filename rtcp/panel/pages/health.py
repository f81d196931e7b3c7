"""Health: how well the cycle holds, and the last hour of temperatures, torques and times."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from nicegui import ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement

from rtcp.api import Feed, RtcpError
from rtcp.panel.page import View, row, table, text
from rtcp.panel.trends import SAMPLE_S

_FIGURES = {"wakeup_ns": "Wake-up", "exchange_ns": "Exchange", "compute_ns": "Compute"}
_BINS = 40
_MOST = 100_000
"""Cycles in a histogram."""


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Health")
    with table(("", "p50 us", "p99 us", "p99.9 us", "largest us"), "Times of the cycle") as body:
        pass
    skipped = text("p", "", role="status")
    charts = {}
    with ui.element("div").classes("columns"):
        for key, name in _FIGURES.items():
            charts[key] = _histogram(name)
    recent: dict[str, np.ndarray] = {key: np.zeros(0) for key in _FIGURES}
    reader: list[Feed | None] = [None]

    def refresh() -> None:
        status = view.live.status
        if status is None:
            skipped.text = view.live.problem
            return
        body.clear()
        for name, key in (("wake-up", "wakeup_us"), ("exchange", "exchange_us"), ("compute", "compute_us")):
            figures = status.raw[key]
            row(body, name, *(f"{figures[quantile]:.1f}" for quantile in ("p50", "p99", "p999", "max")))
        why = status.raw["skipped_ticks"]
        skipped.text = f"{status.raw['missed']} of {status.raw['cycles']} cycles skipped" + (
            f": {why['message']}; {why['remedy']}".replace("`", "") if why else ""
        )

    def draw() -> None:
        try:
            feed = reader[0] = reader[0] or Feed()
            if feed.ended(0.0):
                raise RtcpError("not running", "the loop has ended")
            records, _ = feed.records()
        except RtcpError:
            close()
            return
        for key, (path, caption) in charts.items():
            recent[key] = np.concatenate([recent[key], records[key] / 1e3])[-_MOST:]
            if not len(recent[key]):
                continue
            high = max(1.0, float(np.percentile(recent[key], 99.9)))
            counts, _ = np.histogram(recent[key], bins=_BINS, range=(0.0, high))
            path.props["d"] = _bars(counts)
            caption.text = f" 0 to {high:.0f} us, {len(recent[key])} cycles, logarithmic"

    def close() -> None:
        if reader[0] is not None:
            reader[0].close()
            reader[0] = None

    refresh()
    ui.timer(1.0, refresh)
    ui.timer(1.0, draw)
    view.leaving.append(close)
    _trends(view)


def _histogram(name: str) -> tuple[Element, TextElement]:
    """Show a histogram; return its path and the element with its range."""
    with ui.element("figure"):
        with ui.element("svg").classes("histogram") as picture:
            picture.props.update({"viewBox": f"0 0 {_BINS} 1", "preserveAspectRatio": "none", "role": "img"})
            picture.props["aria-label"] = f"Histogram: {name}"
            path = ui.element("path")
        with ui.element("figcaption"):
            text("b", name)
            return path, text("small", "")


def _bars(counts: npt.NDArray[np.int64]) -> str:
    """Return the outline of bars, their heights by the logarithm of the counts: rare late cycles are seen."""
    heights = np.log10(counts + 1.0) / max(1.0, np.log10(counts.max() + 1.0))
    return " ".join(f"M{at} 1V{1.0 - height:.3f}h0.9V1Z" for at, height in enumerate(heights) if height)


def _trends(view: View) -> None:
    """Show each figure of the last hour as a small line, with its numbers."""
    text("h2", "The last hour")
    text("p", f"Sampled every {SAMPLE_S:g} s while the panel runs; each point is the largest value of its time.")
    place = ui.element("div").classes("page")

    def refresh() -> None:
        place.clear()
        with place:
            body = table(("", "60 min ago to now", "least", "largest", "now", ""), "Trends", "numbers trends")
        now = time.monotonic()
        for trend in view.live.trends.all.values():
            values = [value for _, value in trend.samples]
            least, largest = min(values), max(values)
            figures = (f"{value:.4g}" for value in (least, largest, values[-1]))
            with row(body, trend.name) as line, ui.element("td"):
                _line(trend.line(now), least, largest)
            with line:
                for figure in (*figures, trend.unit):
                    text("td", figure)

    refresh()
    ui.timer(SAMPLE_S, refresh)


def _line(points: list[tuple[float, float]], least: float, largest: float) -> None:
    height = (largest - least) or 1.0
    steps = (f"{180.0 * (1.0 - age):.0f},{22.0 - 20.0 * (value - least) / height:.1f}" for age, value in points)
    with ui.element("svg").classes("trend").props('viewBox="0 0 180 24" preserveAspectRatio=none aria-hidden=true'):
        ui.element("polyline").props["points"] = " ".join(steps)
