"""Scope: signals of every cycle, chosen, triggered, paused, measured, kept as CSV."""

from __future__ import annotations

from pathlib import Path

import nicegui
from nicegui import ui
from nicegui.element import Element

from rtcp.api import RtcpError
from rtcp.panel.page import View, button, choice, no_platform, number, text
from rtcp.panel.scope import EVENTS, LONGEST_S, MOST_SIGNALS, SHORTEST_S, Scope, signals_of

_ECHARTS = Path(nicegui.__file__).parent / "elements" / "echart" / "dist"


class ScopeView(Element, component="../static/scope_view.js", esm={"nicegui-echart": str(_ECHARTS)}):
    """The picture; `names`: label of each signal."""

    def __init__(self, names: dict[str, str]) -> None:
        super().__init__()
        self.props["names"] = names


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Scope")
    config, feed = view.live.config, view.live.feed
    if config is None or feed is None:
        no_platform()
        return
    allowed = signals_of(config, feed.schema)
    chosen = ["actual_position.0", "commanded_position.0"]
    with ui.element("div").classes("fields"):
        signal = choice("Signal", allowed, "actual_position.0")
        signal.place.classes("long")
        span = number(f"Time base, s ({SHORTEST_S:g} to {LONGEST_S:g})", "5", min=str(SHORTEST_S), max=str(LONGEST_S))
        trigger = choice(
            "Trigger",
            {
                "": "none, it rolls",
                **{key: f"when {label}" for key, label in EVENTS.items()},
                **{key: f"{name} rises through" for key, name in allowed.items()},
            },
            "",
        )
        level = number("Level", "0")
    listed = text("p", "", role="status")
    picture = ScopeView(allowed)

    def apply() -> None:
        names = ", ".join(allowed[signal] for signal in chosen)
        listed.text = f"Shown: {names or 'nothing'} (at most {MOST_SIGNALS})"
        if not chosen:
            view.page.scope = None
            return
        try:
            view.page.scope = Scope(allowed, list(chosen), span.number(), trigger.value, level.number(), feed.period_ns)
        except RtcpError as error:
            listed.text = error.message

    def add() -> None:
        if signal.value not in chosen:
            chosen.append(signal.value)
        apply()

    def clear() -> None:
        chosen.clear()
        apply()

    paused = [False]

    def pause() -> None:
        paused[0] = not paused[0]
        picture.run_method("pause", paused[0])
        hold.text = "Follow" if paused[0] else "Freeze"

    with ui.element("div").classes("buttons"):
        button("Add the signal", add)
        button("Remove all", clear, plain=True)
        hold = button("Freeze", pause, plain=True)
        button("CSV of what is shown", lambda: picture.run_method("csv"), plain=True)
    for control in (span, trigger, level):
        control.on_change(apply)
    apply()
