"""Alarms: events that need a person, with the remedy, until they are acknowledged; all events; recorded faults."""

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
"""Severity of an event -> the person's task."""
_MOST = 50


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Alarms")
    _alarms(view)
    _events(view)
    _faults(view)


def _alarms(view: View) -> None:
    notice = text("p", "", role="status")
    everything = button("Acknowledge all", lambda: acknowledge(list(listed)))
    place = ui.element("div").classes("page")
    listed: list[EventRecord] = []
    drawn: list[object] = []

    def acknowledge(alarms: list[EventRecord]) -> None:
        if view.may_command():
            view.live.acknowledge(alarms, view.page.visitor.name)
            refresh()

    def refresh() -> None:
        alarms = view.live.alarms
        state = [(alarm, view.live.acknowledged_by(alarm)) for alarm in alarms]
        if state == drawn and place.default_slot.children:
            return
        drawn[:], listed[:] = state, alarms
        waiting = sum(not by for _, by in state)
        notice.text = f"{waiting} not acknowledged" if alarms else "Nothing has happened that needs a person."
        everything.set_visibility(waiting > 1)
        place.clear()
        if not alarms:
            return
        with place:
            body = table(("Time", "Kind", "What happened", "What to do", "Acknowledged"), "Alarms", "stack")
        for alarm, by in reversed(state[-_MOST:]):
            kind, message = alarm.severity.replace("_", " "), alarm.message.replace("`", "")
            with row(body, _time(alarm), kind, message, _TO_DO[alarm.severity]) as line, ui.element("td"):
                line.props["data-severity"] = alarm.severity
                if by:
                    text("span", f"by {by}")
                else:
                    line.classes("waits")
                    button("Acknowledge", partial(acknowledge, [alarm]), plain=True)

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
        for event in reversed(events):
            row(body, str(event.number), _time(event), event.name.replace("_", " "), event.message.replace("`", ""))

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
        faults = json.loads(out)["faults"]
        with place:
            if not faults:
                text("p", "None has been recorded.")
                return
            body = table(("#", "Time", "What", ""), "Recorded faults")
        for fault in reversed(faults[-20:]):
            event = str(fault.get("what") or fault.get("error"))
            with row(body, str(fault["number"]), str(fault.get("time", "-"))[:19], event), ui.element("td"):
                button(f"Picture of fault {fault['number']}", partial(draw, fault["number"]), plain=True)

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
