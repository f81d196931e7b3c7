"""`rtcp start` and `rtcp stop`: the platform's processes, in the foreground or on their own."""

from __future__ import annotations

import math
import time
from typing import Annotated

import typer

from rtcp.cli.connection import connect
from rtcp.cli.errors import CommandError, ExitCode, code_of
from rtcp.cli.launch import launch, serve
from rtcp.cli.options import BusName, ConfigFile, Poll
from rtcp.cli.output import report
from rtcp.ipc.errors import RtcpError

PATIENCE_S = 5.0
"""For a machine that is still starting: its frames have to come back first, or to be missed for long enough."""
_ASK_S = 0.02
_NOT_WELL = frozenset({"starting", "fault", "emergency_stop"})
MODES = ("joint", "cartesian", "joystick", "velocity", "torque", "csp", "csv", "cst")


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("start")(_start)
    app.command("stop")(_stop)


def _start(
    config: ConfigFile = None,
    bus: BusName = None,
    mode: Annotated[
        str | None, typer.Option("--mode", metavar="NAME", help=f"At the start: {', '.join(MODES)}.")
    ] = None,
    cycle_us: Annotated[
        float | None, typer.Option("--cycle-us", metavar="N", help="Cycle, us; else the configuration's.")
    ] = None,
    poll: Poll = False,
    detach: Annotated[bool, typer.Option("--detach", help="Return once it runs; `rtcp stop` ends it.")] = False,
) -> None:
    """Start the platform: bring the slaves to OP and wait for commands."""
    mode = None if mode is None else mode.lower()
    if mode is not None and mode not in MODES:
        raise CommandError(f"--mode {mode} is not known: {', '.join(MODES)}")
    if cycle_us is not None and not (math.isfinite(cycle_us) and cycle_us > 0):
        raise CommandError(f"--cycle-us {cycle_us:g} is not allowed: a number of us above 0")
    from rtcp.launch.launcher import StartOptions

    request = StartOptions(config=config, bus=bus, mode=mode, cycle_us=cycle_us, poll=poll)
    if detach:
        # The processes have sessions of their own: nothing needs to stay behind for them.
        launch(request, report)
        said, well = _outcome("`rtcp enable` and `rtcp move` command it, `rtcp status` shows it, `rtcp stop` ends it")
        if not well:
            raise CommandError(said, ExitCode.FAULT)
        report(said)
        return
    ready = "`rtcp enable` and `rtcp move` in another terminal; Ctrl-C or `rtcp stop` ends it"
    ending = serve(request, report, lambda: report(_outcome(ready)[0]))
    report("stopped" if ending == 0 else "the platform has ended")
    raise typer.Exit(ending)


def _outcome(ready: str) -> tuple[str, bool]:
    """Wait until the machine has left its start; return in a sentence what came of it, and whether that is well.

    A loop that was only given its gateway back may be doing anything: that is no failed start, unless it is in a fault.
    """
    until = time.monotonic() + PATIENCE_S
    try:
        with connect("start") as client:
            while (status := client.call("status"))["state"] == "starting" and time.monotonic() < until:
                time.sleep(_ASK_S)
    except RtcpError as error:
        return f"started, but: {error.message}", False
    state, message = str(status["state"]), str(status["message"])
    if state == "ready":
        return f"ready: {ready}", True
    if state == "starting":
        message = f"not ready within {PATIENCE_S:g} s (`rtcp status`): {message}"
    if state in _NOT_WELL:
        return f"started, but: {message}", False
    return f"{state.replace('_', ' ')}: {message}", True


def _stop() -> None:
    """Stop the platform: drives disabled, slaves in INIT, processes ended."""
    from rtcp.launch import launcher
    from rtcp.launch.platform import StartError

    try:
        left = launcher.stop(report)
    except StartError as error:
        raise CommandError(str(error), code_of(error.kind)) from error
    if left:
        raise CommandError("\n".join(f"stopped, but: {sentence}" for sentence in left), ExitCode.FAULT)
    report("stopped")
