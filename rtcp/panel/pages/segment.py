"""Segment: the slaves in the order of the cable, their counters, objects, and the faults of a virtual bus."""

from __future__ import annotations

import json
from typing import Any

from nicegui import ui

from rtcp.api import RtcpError
from rtcp.config.model import VIRTUAL
from rtcp.panel.page import Field, View, button, choice, field, number, row, table, text

_COUNTERS = (
    "Slave",
    "Name",
    "State",
    "AL status code",
    "Left OP",
    "Came back",
    "Damaged frames at its ports 0 / 1 / 2 / 3",
    "Forwarded at ports 0 / 1 / 2 / 3",
    "Lost links at ports 0 / 1 / 2 / 3",
)

_KINDS: dict[str, Any] = {}
"""Kinds of faults, as `rtcp segment kinds --json` has them; asked for once."""


async def build(view: View) -> None:
    """Build the page."""
    text("h1", "Segment")
    slaves = ui.element("div").classes("page")
    clock = text("p", "", role="status")
    drawn: list[object] = [None]

    def refresh() -> None:
        status = view.live.status
        rows = [_cells(slave) for slave in (status.raw["slaves"] if status is not None else ())]
        if rows != drawn[0] or not slaves.default_slot.children:
            drawn[0] = rows
            slaves.clear()
            with slaves:
                body = table(_COUNTERS, "Slaves in the order of the cable", "lines")
            for cells in rows:
                row(body, *cells).classes("bad" if cells[2] == "no answer" else "")
        if status is not None:
            dc, wkc = status.raw["dc"], status.raw["wkc"]
            clocks = ""
            if dc is not None:
                clocks = (
                    f"Distributed clocks {'locked' if dc['locked'] else 'not locked'}, offset "
                    f"{dc['offset_ns'] / 1e3:.1f} us, filtered {dc['filtered_ns'] / 1e3:.1f} us. "
                )
            clock.text = (
                f"Working counter {wkc['actual']} of {wkc['expected']}. {clocks}Cycles skipped: {status.raw['missed']}."
            )
        else:
            clock.text = view.live.problem

    refresh()
    ui.timer(0.5, refresh)
    text("h2", "Messages")
    messages = text("pre", "", "text")

    def read_messages() -> None:
        status = view.live.status
        if status is not None:
            lines = zip(status.raw["message_times"], status.raw["messages"], strict=True)
            messages.text = "\n".join(f"{when[11:23]}  {message}" for when, message in lines).replace("`", "")

    read_messages()
    ui.timer(0.5, read_messages)
    status = view.live.status
    if status is None or status.raw["bus_kind"] == "ethercat":
        _objects(view)
        await _faults(view)


def _cells(slave: dict[str, Any]) -> list[str]:
    """Return the row of a slave, under `_COUNTERS`."""
    figures = (slave["state"], f"0x{slave['al_status_code']:04X}", slave["lost"], slave["recovered"])
    ports = (" / ".join(map(str, slave["errors"][kind])) for kind in ("rx", "forwarded", "links"))
    return [*map(str, (slave["position"], slave["name"], *figures)), *ports]


def _objects(view: View) -> None:
    text("h2", "Objects (SDO)")
    with ui.element("div").classes("fields"):
        slave = number("Slave, from 1", "2", min="1", step="1")
        index = field("Index, hex", "6041")
        subindex = number("Subindex", "0", min="0", max="255", step="1")
        data = field("Bytes, hex (to write)")
    notice = text("p", "", role="status", **{"aria-live": "polite"})

    def place() -> tuple[int, int, int]:
        try:
            return int(slave.number()), int(index.value.removeprefix("0x"), 16), int(subindex.number())
        except ValueError:
            raise RtcpError("invalid", f'Index: found "{index.value}", allowed is a hexadecimal number') from None

    async def read() -> None:
        try:
            where = place()
            value = await view.query(lambda robot: robot.sdo_read(*where))
        except RtcpError as error:
            notice.text = error.message
            return
        notice.text = f"0x{where[1]:04X}:{where[2]} = {value.hex(' ')} ({int.from_bytes(value, 'little')})"

    async def write() -> None:
        try:
            where, value = place(), bytes.fromhex(data.value)
        except (RtcpError, ValueError) as error:
            notice.text = str(error)
            return
        notice.text = ""
        await view.act(lambda robot: robot.sdo_write(*where, value), "Written")

    with ui.element("div").classes("buttons"):
        button("Read", read, when="ready holding moving fault stopped_by_limit emergency_stop")
        button("Write", write, when="ready", plain=True)


async def _faults(view: View) -> None:
    status = view.live.status
    if status is None or status.raw["bus"] != VIRTUAL or view.page.visitor.role != "operator":
        return
    text("h2", "Faults of the virtual bus")
    place = ui.element("div").classes("page")
    if not _KINDS:
        code, out = await view.rtcp("segment", "kinds", "--json")
        if code:
            view.warn(out)
            return
        _KINDS.update({kind["name"]: kind for kind in json.loads(out)})
    kinds = _KINDS
    keys: dict[str, Field] = {}
    with place:
        with ui.element("div").classes("fields"):
            kind = choice("Kind", list(kinds), "loss")
            lasts = number("Lasts, s (empty: until cleared)", "2", min="0")
        says = text("p", "")
        keys_part = ui.element("div").classes("fields")

    def show_keys() -> None:
        says.text = kinds[kind.value]["says"]
        keys_part.clear()
        keys.clear()
        with keys_part:
            for name, allowed in kinds[kind.value]["keys"].items():
                keys[name] = field(f"{name}: {allowed}")

    kind.on_change(show_keys)
    show_keys()

    async def make() -> None:
        if not view.claim():
            return
        fields = [f"{name}={control.value.strip()}" for name, control in keys.items() if control.value.strip()]
        more = ["--lasts", lasts.value] if lasts.value.strip() else []
        code, out = await view.rtcp("segment", "fault", kind.value, *fields, *more)
        view.warn(out) if code else view.say(out)
        await show()

    async def clear() -> None:
        if view.claim():
            code, out = await view.rtcp("segment", "clear")
            view.warn(out) if code else view.say(out)
            await show()

    async def show() -> None:
        code, out = await view.rtcp("segment", "faults", "--json")
        active.clear()
        with active:
            for fault in json.loads(out) if code == 0 else ():
                text("p", f"fault {fault['id']}: {fault['fault']['fault']}, for {fault['since_s']:.1f} s")

    with place:
        buttons = ui.element("div").classes("buttons")
        active = ui.element("div").classes("page")
    with buttons:
        button("Make the fault", make)
        button("Clear all", clear, plain=True)
        button("Show what is active", show, plain=True)
