"""Start: bus, configuration, modes, cycle; start and stop; obstacles to real time, with remedies."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from nicegui import ui

from rtcp.config.find import default_config, find_config
from rtcp.config.model import VIRTUAL, ConfigError, ControlModeName, DriveModeName
from rtcp.panel.page import ENABLED, View, button, choice, field, number, on_click, row, table, text

MODES, DRIVE_MODES = get_args(ControlModeName), get_args(DriveModeName)
_CONFIGURED = "as configured"


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Start")
    with ui.element("div").classes("fields"):
        bus = choice("Bus", _interfaces(), VIRTUAL)
        config = field("Configuration (file)", _default(), list="configurations")
        mode = choice("Mode", (_CONFIGURED, *MODES, *DRIVE_MODES), _CONFIGURED)
        cycle = number("Cycle, us (empty: as configured)", min="1")
    if (cell := view.live.partners.cell) is not None:
        text("p", f"Start begins with the file of the cell {cell.name}, {cell.source}, and not with the configuration.")
    with ui.element("datalist").props("id=configurations"):
        for path in sorted(default_config().parent.glob("*.yaml")):
            ui.element("option").props["value"] = str(path)
    with ui.element("div").classes("buttons"):
        begin = button("Start", when="off")
        begin.props["data-start"] = ""
        button(
            "Stop the platform",
            lambda: _end(view),
            when=f"ready fault emergency_stop stopped_by_limit starting {ENABLED}",
            plain=True,
        )
        check = button("Check this host", plain=True)
        scan = button("Scan the bus", plain=True)
    notice = text("pre", "", "text", **{"aria-live": "polite"})
    results = ui.element("div").classes("page")

    def where() -> list[str]:
        arguments = ["--bus", bus.value]
        return [*arguments, "--config", config.value] if config.value.strip() else arguments

    def show(line: str) -> None:
        notice.text = f"{notice.text}\n{line}".strip()[-8000:]

    async def start() -> None:
        notice.text = ""
        cell = view.live.partners.cell
        arguments = where() if cell is None else ["--bus", bus.value, "--cell", str(cell.source)]
        if mode.value != _CONFIGURED:
            arguments += ["--mode", mode.value]
        if cycle.value.strip():
            arguments += ["--cycle-us", cycle.value]
        if not await _start(view, arguments, show):
            view.warn("The platform was not started: the reason stands below the buttons")

    async def doctor() -> None:
        notice.text = "..."
        _, out = await view.rtcp("doctor", "--json", *where())
        results.clear()
        try:
            findings = json.loads(out[out.index("{") :])["findings"]
        except (ValueError, LookupError):
            notice.text = out
            return
        notice.text = ""
        with results:
            body = table(("Check", "", "Found", "Why it matters", "To fix it, as root"), "This host", "stack")
            for entry in findings:
                with row(body, entry["key"].replace("_", " "), entry["severity"], entry["found"], entry["why"]) as line:
                    line.props["data-severity"] = entry["severity"]
                    with ui.element("td"):
                        text("pre", "\n".join(entry["remedy"]), "text remedy")

    async def scan_bus() -> None:
        if not view.claim():
            return
        notice.text = "..."
        code, out = await view.rtcp("scan", "--json", *(["--bus", bus.value] if view.live.status is None else []))
        results.clear()
        if code:
            notice.text = out
            return
        notice.text = ""
        with results:
            body = table(("Slave", "Name", "State", "Vendor", "Product"), "Slaves in the order of the cable")
            for slave in json.loads(out):
                identity = (f"0x{slave[key]:08X}" for key in ("vendor_id", "product_code"))
                row(body, str(slave["position"]), slave["name"], slave["state"], *identity)

    for control, handler in ((begin, start), (check, doctor), (scan, scan_bus)):
        on_click(control, handler)

    text("h2", "Modes")
    with ui.element("div").classes("fields"):
        control_mode = choice("Control mode", MODES, "joint")
        drive_mode = choice("Drive mode", DRIVE_MODES, "csp")
    with ui.element("div").classes("buttons"):
        button(
            "Set control mode",
            lambda: view.act(lambda robot: robot.mode(control_mode.value), f"Control mode {control_mode.value}"),
            when="ready holding",
            plain=True,
        )
        button(
            "Set drive mode",
            lambda: view.act(lambda robot: robot.mode(drive_mode.value), f"Drive mode {drive_mode.value}"),
            when="ready holding",
            plain=True,
        )


async def start_virtual(view: View) -> None:
    """Start the virtual arm as it is configured; show a failure."""
    lines: list[str] = []
    view.say("The virtual arm starts")
    cell = view.live.partners.cell
    arguments = ["--bus", VIRTUAL, *([] if cell is None else ["--cell", str(cell.source)])]
    if not await _start(view, arguments, lines.append):
        view.warn("The virtual arm was not started: " + " ".join(lines[-3:]))


async def _start(view: View, arguments: list[str], show: Callable[[str], None]) -> bool:
    """Start a platform and return whether it runs; `show` gets each line of the command."""
    if not view.claim():
        return True  # the person has been told
    view.live.starting += 1
    try:
        code, _ = await view.rtcp("start", "--detach", *arguments, show=show)
    finally:
        view.live.starting -= 1
    if not code:
        view.say("The platform runs")
    return not code


async def _end(view: View) -> None:
    problems = await view.act(lambda robot: robot.stop(), instead=True)
    if problems:
        view.warn("Stopped, but: " + "; ".join(problems))
    elif problems is not None:
        view.say("The platform has stopped")


def _interfaces() -> list[str]:
    return [VIRTUAL, *sorted(interface for interface in os.listdir("/sys/class/net") if interface != "lo")]


def _default() -> str:
    try:
        return str(find_config())
    except ConfigError:
        return str(Path())
