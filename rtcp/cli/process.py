"""`rtcp process`: processes beside motion, their states, and any of their commands."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Any

import typer

from rtcp.api import RtcpError
from rtcp.api.robot import command_fields
from rtcp.cli.output import CommandError, facts, report, show, table
from rtcp.cli.platform import connect, stoppable
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_session

commands = typer.Typer()
_TYPES = {bool: "true, false", int: "integer", float: "number", str: "text"}


@commands.command("process")
def _process(
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="Its name; without one all are listed.")] = "",
    command: Annotated[str, typer.Argument(metavar="[COMMAND]", help="One of its commands; without: shown.")] = "",
    fields: Annotated[list[str] | None, typer.Argument(metavar="[FIELD=VALUE ...]", help="Of the command.")] = None,
) -> None:
    """Show processes beside motion, or send one a command; one that lasts ends with Ctrl-C."""
    if not command:
        _show(name)
        return
    try:
        values = command_fields(fields or [])
    except ValueError as error:
        raise CommandError(str(error)) from None
    ends = f"the connection is closed, {name} ends what it has begun"
    with stoppable(f"process {name}", ends) as robot:
        if name not in robot.processes:
            raise RtcpError("refused", _unknown(name, list(robot.processes)), "no_process")
        if command not in (allowed := robot.processes[name].commands):
            raise CommandError(f"{command!r} is not a command of {name}: {', '.join(allowed)}")
        robot.processes[name].command(command, **values)
        report(f"{command}: done; {name} is {robot.processes[name].state or 'without a state'}")


def _show(name: str) -> None:
    with connect("process") as robot:
        states = {key: process.state for key, process in robot.processes.items()}
        published = robot.processes[name].fields if name in states else {}
    if name and name not in states:
        raise RtcpError("refused", _unknown(name, list(states)), "no_process")
    configs = {config.name: config for config in read_session(runtime_directory()).config.processes}
    if not name:
        listed = table(("process", "kind", "state", "commands"), ("process", "kind", "state"), fill="commands")
        for key, state in states.items():
            listed.add_row(key, configs[key].kind, state, ", ".join(kind.name for kind in configs[key].COMMANDS))
        show(listed)
        return
    rows = facts()
    rows.add_row("state", states[name])
    for field, value in published.items():
        if field != "state":
            rows.add_row(field.replace("_", " "), f"{value:g}" if isinstance(value, float) else str(value))
    listed = table(("command", "fields"), ("command",), fill="fields")
    for kind in configs[name].COMMANDS:
        listed.add_row(kind.name, ", ".join(_described(kind)))
    show(rows, "", listed)


def _unknown(name: str, allowed: list[str]) -> str:
    return f"this platform has no process {name!r}: {', '.join(allowed) or 'it has none'}"


def _described(kind: type[Any]) -> list[str]:
    """Return the allowed values of each field of a command."""
    return [f"{name}: {_allowed(hint)}" for name, hint in kind.field_types.items()]


def _allowed(hint: Any) -> str:
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return " | ".join(member.name.lower() for member in hint)
    return _TYPES.get(hint, "value")
