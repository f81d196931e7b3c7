"""Processes: fields, lamps, commands and picture of each, made from its description."""

from __future__ import annotations

import dataclasses
from enum import IntEnum
from typing import Any

from nicegui import ui

from rtcp.api import RtcpError
from rtcp.config.model import ProcessConfig
from rtcp.panel.page import Field, View, button, choice, live_value, no_platform, number, table, text
from rtcp.panel.pages.scope import ScopeView
from rtcp.panel.scope import Scope, signals_of

_PICTURE_S = 60.0


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Processes")
    config, feed = view.live.config, view.live.feed
    if config is None or feed is None:
        no_platform()
        return
    if not config.processes:
        text("p", "This platform has no process beside motion: docs/processes.md.")
    for process in config.processes:
        text("h2", process.name)
        with ui.element("p"):
            text("span", f"{process.kind}: ")
            live_value(f"processes.{process.name}.state", tag="span")
        _lamps(process)
        _commands(view, process)
        _fields(view, process)
        _limits(process)
    if plotted := [f"{process.name}_{name}" for process in config.processes for name in process.PLOT]:
        allowed = signals_of(config, feed.schema)
        text("h2", "Picture")
        ScopeView(allowed)
        view.page.scope = Scope(allowed, plotted, _PICTURE_S, "", 0.0, feed.period_ns)


def _lamps(process: ProcessConfig) -> None:
    if not process.LAMPS:
        return
    with ui.element("div").classes("lamps"):
        for colour, channel in process.LAMPS.items():
            with ui.element("span").classes("lamp").props(f"data-colour={colour}"):
                text("span", f"{colour}: ")
                live_value(f"processes.{process.name}.lamps.{channel}", tag="span")


def _fields(view: View, process: ProcessConfig) -> None:
    assert view.live.feed is not None
    with table(("Field", "Value", "Unit", "Meaning"), f"Fields of {process.name}"):
        for field in view.live.feed.schema.fields:
            if field.part != process.name or field.local_name == "state":
                continue
            with ui.element("tr"):
                text("th", field.local_name.replace("_", " "), scope="row")
                live_value(f"processes.{process.name}.fields.{field.local_name}")
                text("td", field.unit)
                text("td", field.description)


def _limits(process: ProcessConfig) -> None:
    numbers = {
        field.name: value
        for field in dataclasses.fields(process)
        if isinstance(value := getattr(process, field.name), int | float) and not isinstance(value, bool)
    }
    if not numbers:
        return
    text("h2", f"Limits and settings of {process.name}")
    with table(("Key", "Value"), f"Limits and settings of {process.name}", "numbers"):
        for name, value in numbers.items():
            with ui.element("tr"):
                text("th", name, scope="row")
                text("td", f"{value:g}")


def _commands(view: View, process: ProcessConfig) -> None:
    plain = [kind for kind in process.COMMANDS if not kind.field_types]
    with ui.element("div").classes("buttons"):
        for kind in plain:
            _button(view, kind, {})
    for kind in process.COMMANDS:
        if kind in plain:
            continue
        with ui.element("fieldset"):
            text("legend", _words(kind))
            with ui.element("div").classes("fields"):
                controls = {name: _control(name, hint) for name, hint in kind.field_types.items()}
            with ui.element("div").classes("buttons"):
                _button(view, kind, controls)


def _control(name: str, hint: Any) -> Field:
    label = name.replace("_", " ").capitalize()
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return choice(label, [member.name.lower() for member in hint], next(iter(hint)).name.lower())
    if hint is bool:
        return choice(label, ("no", "yes"), "no")
    return number(label)


def _button(view: View, kind: type[Any], controls: dict[str, Field]) -> None:
    async def send() -> None:
        try:
            values = {name: _value(control, kind.field_types[name]) for name, control in controls.items()}
        except RtcpError as error:
            view.warn(error.message)
            return
        # A command without lease only makes the process safer: it ends the command of this page.
        done, instead = f"{_words(kind)}: done", not kind.needs_lease
        await view.act(lambda robot: robot.command(kind.name, **values), done, instead=instead)

    button(_words(kind), send, plain=not kind.needs_lease)


def _value(control: Field, hint: Any) -> Any:
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return control.value
    if hint is bool:
        return control.value == "yes"
    return int(control.number()) if hint is int else control.number()


def _words(kind: type[Any]) -> str:
    return str(kind.name).replace("_", " ").capitalize()
