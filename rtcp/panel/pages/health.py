"""Health: how well the cycle holds, what has happened, and the faults of the black box."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
from nicegui import ui

from rtcp.api import Feed, RtcpError
from rtcp.panel.page import View, button, row, table, text

_FIGURES = {"wakeup_ns": "Wake-up, us", "exchange_ns": "Exchange, us", "compute_ns": "Compute, us"}
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
    with ui.element("div").classes("fields").style("grid-template-columns: repeat(auto-fit, minmax(16rem, 1fr))"):
        for key, name in _FIGURES.items():
            charts[key] = _chart(name)
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
            row(body, name, *(f"{figures[one]:.1f}" for one in ("p50", "p99", "p999", "max")))
        why = status.raw["skipped_ticks"]
        skipped.text = f"{status.raw['missed']} of {status.raw['cycles']} cycles skipped" + (
            f": {why['message']}; {why['remedy']}" if why else ""
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
        for key, chart in charts.items():
            recent[key] = np.concatenate([recent[key], records[key] / 1e3])[-_MOST:]
            if not len(recent[key]):
                continue
            high = max(1.0, float(np.percentile(recent[key], 99.9)))
            counts, edges = np.histogram(recent[key], bins=_BINS, range=(0.0, high))
            chart.options["xAxis"]["data"] = [f"{edge:.0f}" for edge in edges[:-1]]
            chart.options["series"][0]["data"] = [int(one) or None for one in counts]
            chart.update()

    def close() -> None:
        if reader[0] is not None:
            reader[0].close()
            reader[0] = None

    refresh()
    ui.timer(1.0, refresh)
    ui.timer(1.0, draw)
    view.leaving.append(close)
    _events(view)
    _faults(view)


def _chart(name: str) -> ui.echart:
    chart = ui.echart(
        {
            "title": {"text": name, "textStyle": {"fontSize": 14}},
            "grid": {"left": 50, "right": 10, "top": 35, "bottom": 25},
            "animation": False,
            "xAxis": {"type": "category", "data": []},
            "yAxis": {"type": "log", "min": 1},
            "series": [{"type": "bar", "data": [], "itemStyle": {"color": "#1864ab"}, "barWidth": "95%"}],
        }
    ).style("height: 14rem; width: 100%")
    chart.props.update({"role": "img", "aria-label": f"Histogram: {name}"})
    return chart


def _events(view: View) -> None:
    text("h2", "Events")
    place = ui.element("div").classes("page")
    last = [-1]

    async def refresh() -> None:
        try:
            events = await view.query(lambda robot: robot.events())
        except RtcpError:
            return
        if events and events[-1].number != last[0]:
            last[0] = events[-1].number
            place.clear()
            with place:
                body = table(("#", "Time", "Event", "Message"), "Events")
            for one in reversed(events[-25:]):
                row(body, str(one.number), one.time[11:23], one.name, one.message)

    ui.timer(1.0, refresh)


def _faults(view: View) -> None:
    text("h2", "Recorded faults")
    place = ui.element("div").classes("page")
    picture = ui.element("div").classes("page")

    async def show() -> None:
        code, out = await view.rtcp("faults", "--json")
        place.clear()
        if code:
            view.warn(out)
            return
        found = json.loads(out)["faults"]
        with place:
            if not found:
                text("p", "None has been recorded.")
                return
            body = table(("#", "Time", "What", ""), "Recorded faults")
        for one in reversed(found[-20:]):
            what = str(one.get("what") or one.get("error"))
            with row(body, str(one["number"]), str(one.get("time", "-"))[:19], what), ui.element("td"):
                button(f"Picture of fault {one['number']}", partial(draw, one["number"]), plain=True)

    async def draw(number: int) -> None:
        code, out = await view.rtcp("faults", "show", str(number), "--json")
        if code:
            view.warn(out)
            return
        file = Path(json.loads(out)["file"])
        code, out = await view.rtcp("faults", "show", str(number), "--plot", str(file.with_suffix(".png")))
        picture.clear()
        with picture:
            if code:
                text("pre", out, "text")
                return
            image = ui.element("img").style("max-width: 100%; background: #fff")
            image.props.update(
                {"src": f"/faults/{file.with_suffix('.png').name}", "alt": f"What happened around fault {number}"}
            )
            text("pre", out, "text")

    button("Show the recorded faults", show, plain=True)
