"""The command `rtcp`, also `python -m rtcp.cli`: all groups, and the one place where an error becomes an exit code."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import typer

import rtcp
from rtcp.api import RtcpError
from rtcp.cli import (
    arm,
    arm_new,  # noqa: F401  registers `rtcp arm new`
    axis,
    bench,  # noqa: F401  registers `rtcp device try`
    bus,
    cell,
    commission,
    demo,
    device,
    doctor,
    experiment,
    faults,
    irc5,
    jog,
    live,
    motion,
    panel,
    platform,
    process,
    record,
    recorded,
    ros,
    segment,
    service,
    shape_set,
    slaves,
    soak,
    status,
    user_trial,
)
from rtcp.cli.arguments import PlatformName, choose_platform
from rtcp.cli.output import CommandError, ExitCode, code_of, complain, emit, interruption_code, mute
from rtcp.config.model import ConfigError
from rtcp.esi.model import EsiError

app = typer.Typer(
    name="rtcp",
    help="Run a six-axis arm of EtherCAT drives at a fixed cycle, on hardware or on a segment in software.",
    epilog="Exit codes: 0 done, 1 internal, 2 usage or configuration, 3 refused, 4 not running, 5 fault or timeout.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        emit(f"rtcp {rtcp.__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version.", callback=_version, is_eager=True)
    ] = False,
    name: PlatformName = None,
) -> None:
    choose_platform(name)
    if context.invoked_subcommand is None:
        text = context.get_help()  # with rich this call prints, and returns nothing
        if text.strip():
            emit(text.rstrip())


_GROUPS = (
    platform, status, cell, commission, motion, axis, process, jog, arm, bus, device, slaves, segment, irc5, demo,
    service, doctor, soak, faults, record, recorded, live, experiment, user_trial, panel, ros, shape_set,
)  # fmt: skip
for _group in _GROUPS:
    app.add_typer(_group.commands)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; a user's mistake ends in a message, never in a traceback.

    Args:
        arguments: the command line without the program's name; that of the process when None.
    """
    _replace_closed_streams()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")  # a terminal without UTF-8 loses a letter, not the output
    code: int = ExitCode.DONE
    try:
        app(args=None if arguments is None else list(arguments), prog_name="rtcp")
    except SystemExit as ending:
        code = ending.code if isinstance(ending.code, int) else ExitCode.DONE
    except RtcpError as error:
        complain(error.message)
        code = code_of(error.kind)
    except (ConfigError, EsiError) as error:
        complain(str(error))
        code = ExitCode.USAGE
    except CommandError as error:
        complain(error.message)
        code = error.code
    except KeyboardInterrupt as error:
        code = interruption_code(error)
    except OSError as error:
        where = f": {error.filename}" if error.filename else " (standard output)" if error.errno == errno.ENOSPC else ""
        complain(f"{error.strerror or error}{where}")
        code = ExitCode.INTERNAL
    except Exception as error:
        if os.environ.get("RTCP_TRACEBACK"):
            import traceback

            traceback.print_exc()
        complain(f"internal error: {type(error).__name__}: {error} (RTCP_TRACEBACK=1 shows where)")
        code = ExitCode.INTERNAL
    try:
        sys.stdout.flush()  # here, so that a closed pipe causes no message at exit
    except OSError:
        mute()
    return int(code)


def _replace_closed_streams() -> None:
    """Open /dev/null for a standard stream that the shell has closed, as by `>&-`."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


if __name__ == "__main__":
    raise SystemExit(main())
