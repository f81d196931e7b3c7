"""`rtcp irc5`: run a virtual ABB IRC5, and be its operator."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from inspect import Parameter, Signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import AsJson, option
from rtcp.cli.control_socket import connected, free_path, settle
from rtcp.cli.output import CommandError, emit, emit_json, report
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import irc5_control, runtime_directory

if TYPE_CHECKING:
    from rtcp.virtual.irc5.controller import Controller
    from rtcp.virtual.request_socket import RequestClient

DEVICE = "virtual IRC5"
ControlPath = Annotated[
    Path | None,
    option("--irc5", "PATH", "Control socket of the virtual IRC5. Default: in the runtime directory."),
]

commands = typer.Typer(name="irc5", invoke_without_command=True)


@commands.callback()
def _irc5(
    context: typer.Context,
    config: Annotated[
        Path | None, option("--config", "FILE", "Its mechanical units. Default: the packaged irc5.yaml.")
    ] = None,
) -> None:
    """Run a virtual ABB IRC5 until stopped, or operate a running one."""
    if context.invoked_subcommand is None:
        _run(config or default_config().with_name("irc5.yaml"))
    elif config is not None:
        raise CommandError(f"--config is an option of an IRC5 that starts, not of {context.invoked_subcommand}")


def _run(config: Path) -> None:
    try:
        from rtcp.virtual.irc5.server import run
    except ModuleNotFoundError as error:
        raise CommandError(f"{error}: `pip install 'rtcp[abb]'`") from error
    usual = irc5_control(runtime_directory())
    control = free_path(usual)

    def ready(controller: Controller, interface: str | None) -> None:
        settle(None)
        report(f"{DEVICE} (process {os.getpid()})")
        _show(controller.status(), report)
        where = "" if control == usual else f" --irc5 {control}"
        report(f"operate it with `rtcp irc5 COMMAND{where}` (`rtcp irc5 -h` lists them); control socket {control}")
        report("Ctrl-C ends it")

    try:
        run(config, ready, control)
    except ValueError as error:
        raise CommandError(str(error)) from error
    report("ended")


def _show(status: dict[str, Any], emit: Callable[[str], None]) -> None:
    stops = ", ".join(status["open"]) or "none"
    latched = ", a stop waits for Motors On" if status["latched"] else ""
    emit(
        f"mode {status['mode']}, motors {status['motors']}, enabling device {status['enabling']}, "
        f"open stops: {stops}{latched}"
    )
    if streaming := status.get("streaming"):
        emit(f"RAPID streaming: motion at port {streaming['motion_port']}, state at port {streaming['state_port']}")
        on = [name for name, level in streaming["board"].items() if level]
        emit(f"board DSQC 652: on are {', '.join(on) or 'none'}")
    for name, unit in status["units"].items():
        rapid = "runs" if unit["rapid_running"] else "is stopped"
        joints = " ".join(f"{joint:.2f}" for joint in unit["position_deg"])
        speaks, egm = ("", "") if streaming else (f" speaks to {unit['remote']}", f", EGM is {unit['mci']}")
        emit(f"{name}{speaks}: RAPID {rapid}{egm}, joints {joints} degrees")
        if unit["events"]:
            emit(f"    last event: {unit['events'][-1]}")


# -- the operator ---------------------------------------------------------------------------------------------------


def _client(path: Path | None) -> AbstractContextManager[RequestClient]:
    from rtcp.virtual.request_socket import RequestClient

    return connected(partial(RequestClient, server=DEVICE), path, irc5_control(runtime_directory()), DEVICE)


@commands.command("status")
def _status(as_json: AsJson = False, irc5: ControlPath = None) -> None:
    """Show mode, motors and stops, and what each unit does."""
    with _client(irc5) as client:
        status = client.ask({"do": "status"})
    if as_json:
        emit_json(status)
    else:
        _show(status, emit)


@dataclass(frozen=True)
class _Verb:
    """An operator's action: its help, and the keys of its request with their arguments or options."""

    says: str
    keys: dict[str, tuple[Any, Any]] = field(default_factory=dict)


def _choice(*choices: str) -> tuple[Any, Any]:
    return str, typer.Argument(..., metavar="|".join(choices))


_UNIT = (str | None, typer.Argument(None, metavar="UNIT", help="Name of a unit. Default: all."))
_CIRCUIT = _choice("emergency", "automatic", "general", "superior")
_VERBS = {
    "motors-on": _Verb("Press Motors On: reset stops; in Auto the motors are on then."),
    "motors-off": _Verb("Switch the motors off: a stop of category 1."),
    "mode": _Verb("Turn the key; the motors go off.", {"mode": _choice("hand", "auto")}),
    "enabling": _Verb("Move the enabling device.", {"position": _choice("released", "middle", "through")}),
    "stop": _Verb("Open the circuit of a stop.", {"circuit": _CIRCUIT}),
    "release": _Verb("Close the circuit of a stop; nothing starts by that.", {"circuit": _CIRCUIT}),
    "start-rapid": _Verb("Press Start.", {"unit": _UNIT}),
    "stop-rapid": _Verb("Press Stop.", {"unit": _UNIT}),
    "fault": _Verb(
        "Let a fault happen or begin.",
        {
            "fault": (str, typer.Argument(..., metavar="KIND", help="An unknown kind is answered with all of them.")),
            "unit": (str | None, typer.Option(None, "--unit", metavar="U", help="Name of a unit. Default: all.")),
            "value": (float | None, typer.Option(None, "--value", metavar="N", help="Share, delay in cycles, or %.")),
            "direction": (
                str | None,
                typer.Option(None, "--direction", metavar="to_pc|from_pc", help="Of datagrams."),
            ),
        },
    ),
    "clear": _Verb("End the faults that last.", {"unit": _UNIT}),
    "input": _Verb(
        "Set an input of the board (DSQC 652), with RAPID streaming.",
        {"input": (str, typer.Argument(..., metavar="DI1..DI16")), "level": _choice("on", "off")},
    ),
}
"""Command -> action; the request has the command's name, with _ for -."""


def _add(name: str, verb: _Verb) -> None:
    def operate(irc5: Path | None, **values: str | float | None) -> None:
        keys = {key: value for key, value in values.items() if value is not None}
        with _client(irc5) as client:
            client.ask({"do": name.replace("-", "_"), **keys})
            status = client.ask({"do": "status"})
        report(f"{' '.join(map(str, (name, *keys.values())))}: done")
        _show(status, report)

    parameters = {**verb.keys, "irc5": (ControlPath, None)}
    operate.__annotations__ = {key: kind for key, (kind, _) in parameters.items()}
    operate.__signature__ = Signature(  # type: ignore[attr-defined]
        [
            Parameter(key, Parameter.KEYWORD_ONLY, default=default, annotation=kind)
            for key, (kind, default) in parameters.items()
        ]
    )
    commands.command(name, help=verb.says)(operate)


for _name, _verb in _VERBS.items():
    _add(_name, _verb)
