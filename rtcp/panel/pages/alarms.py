"""Alarms: what a person has to know of, with what to do, until it is acknowledged; all events; recorded faults."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

from nicegui import ui

from rtcp.api import EventRecord
from rtcp.panel.page import View, button, row, table, text

_TO_DO = {
    "emergency_stop": "Release the emergency stop, remove the cause, then Reset and Enable",
    "fault": "Remove the cause, then Reset and Enable",
    "limit": "Reset, then move away from the limit",
    "warning": "Nothing has to be reset: look at the cause",
}
"""Severity of an event -> what a person does about it."""
_MOST = 50


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Alarms")
    _alarms(view)
    _events(view)
    _faults(view)


def _alarms(view: View) -> None:
    said = text("p", "", role="status")
    everything = button("Acknowledge all", lambda: acknowledge(list(shown)))
    place = ui.element("div").classes("page")
    shown: list[EventRecord] = []
    drawn: list[object] = []

    def acknowledge(alarms: list[EventRecord]) -> None:
        if view.may_command():
            view.live.acknowledge(alarms, view.page.visitor.name)
            refresh()

    def refresh() -> None:
        alarms = view.live.alarms
        state = [(one, view.live.acknowledged_by(one)) for one in alarms]
        if state == drawn and place.default_slot.children:
            return
        drawn[:], shown[:] = state, alarms
        waiting = sum(not by for _, by in state)
        said.text = f"{waiting} not acknowledged" if alarms else "Nothing has happened that needs a person."
        everything.set_visibility(waiting > 1)
        place.clear()
        if not alarms:
            return
        with place:
            body = table(("Time", "Kind", "What happened", "What to do", "Acknowledged"), "Alarms", "stack")
        for one, by in reversed(state[-_MOST:]):
            kind, message = one.severity.replace("_", " "), one.message.replace("`", "")
            with row(body, _time(one), kind, message, _TO_DO[one.severity]) as made, ui.element("td"):
                made.props["data-severity"] = one.severity
                if by:
                    text("span", f"by {by}")
                else:
                    made.classes("waits")
                    button("Acknowledge", partial(acknowledge, [one]), plain=True)

    refresh()
    ui.timer(0.5, refresh)


def _time(event: EventRecord) -> str:
    return event.time[11:19]


def _events(view: View) -> None:
    text("h2", "Events")
    place = ui.element("div").classes("page")
    last: list[EventRecord] = []

    def refresh() -> None:
        events = view.live.events[-25:]
        if events == last:
            return
        last[:] = events
        place.clear()
        with place:
            body = table(("#", "Time", "Event", "Message"), "Events", "stack")
        for one in reversed(events):
            row(body, str(one.number), _time(one), one.name.replace("_", " "), one.message.replace("`", ""))

    refresh()
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
