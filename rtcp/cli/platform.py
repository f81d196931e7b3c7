"""`rtcp start` and `rtcp stop`, in the foreground or detached; and how commands reach the running platform."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.api import NotRunning, Robot, RtcpError, State
from rtcp.cli.arguments import BusName, ConfigFile, PlatformName, Poll, choose_platform, option, positive
from rtcp.cli.output import (
    SUSPENDING,
    CommandError,
    ExitCode,
    complain,
    interruptible,
    interruption_code,
    report,
    signals_raise,
)
from rtcp.cli.panel import require_panel
from rtcp.ipc.runtime_directory import platform_name, runtime_directory
from rtcp.ipc.session import is_running, read_processes

if TYPE_CHECKING:
    from rtcp.launch.launcher import StartOptions
    from rtcp.launch.platform import Platform

READY_TIMEOUT_S = 5.0
"""Time for the machine to leave `starting`: its frames must return first, or be missing for long enough."""
_NOT_READY = frozenset({State.STARTING, State.FAULT, State.EMERGENCY_STOP})
MODES = ("joint", "cartesian", "joystick", "velocity", "torque", "csp", "csv", "cst")
_TIMEOUT_S = 10.0
"""Time for another command to start the gateway."""

_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *SUSPENDING)

commands = typer.Typer()


@commands.command("start")
def _start(
    config: ConfigFile = None,
    bus: BusName = None,
    controller: Annotated[
        str | None,
        option("--controller", "ADDRESS", "IPv4 address of the robot controller, for the buses egm and rapid."),
    ] = None,
    mode: Annotated[str | None, option("--mode", "NAME", f"Initial mode: {', '.join(MODES)}.")] = None,
    cycle_us: Annotated[float | None, option("--cycle-us", "N", "Cycle, us. Default: the configured one.")] = None,
    poll: Poll = False,
    enable: Annotated[bool, option("--enable", "Then reset a fault of the start and enable the drives once.")] = False,
    detach: Annotated[bool, option("--detach", "Return when it runs; `rtcp stop` ends it.")] = False,
    panel: Annotated[bool, option("--panel", "Serve the panel too, and open it where there is a screen.")] = False,
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="With --panel: its port; 0: a free one. Default: 8080."),
    ] = None,
    name: PlatformName = None,
    cell: Annotated[Path | None, option("--cell", "FILE", "File of the cell to which the arm --name belongs.")] = None,
) -> None:
    """Start the platform: bring the slaves to OP and wait for commands."""
    choose_platform(name)
    if cell is not None and config is not None:
        raise CommandError("--cell says which file the arm has: leave --config out")
    if cell is not None and not platform_name():
        raise CommandError("--cell needs --name NAME: which of its arms this is")
    mode = None if mode is None else mode.lower()
    if mode is not None and mode not in MODES:
        raise CommandError(f"--mode {mode} is not known: {', '.join(MODES)}")
    positive("--cycle-us", cycle_us, "us")
    if panel and detach:
        raise CommandError("--panel ends with this command, --detach leaves it at once: start `rtcp panel` beside")
    if port is not None and not panel:
        raise CommandError("--port is for the panel: give --panel --port N")
    if panel:
        require_panel()
    from rtcp.launch.launcher import StartOptions

    cell_config = None
    if cell is not None:
        from rtcp.config.cell_file import load_cell

        cell_config = load_cell(cell)
    options = StartOptions(config, bus, controller, mode, cycle_us, poll, cell_config)
    if detach:
        running = launch(options)  # the processes have sessions of their own and outlive this command
        hint = "`rtcp enable` and `rtcp move` command it, `rtcp status` shows it, `rtcp stop`"
        message, ready = _wait_ready(running, hint, enable)
        if not ready:
            raise CommandError(message, ExitCode.FAULT)
        report(message)
        return

    def announce(running: Platform) -> None:
        report(_wait_ready(running, "`rtcp enable` in another terminal; Ctrl-C or `rtcp stop`", enable)[0])

    with _panel(8080 if port is None else port) if panel else nullcontext():
        code = serve(options, announce)
    report("stopped" if code == 0 else "the platform has ended")
    raise typer.Exit(code)


@contextmanager
def _panel(port: int) -> Iterator[None]:
    """Serve the panel in a process of its own while inside; raises Exit where it cannot, as at a busy port."""
    screen = ["--open"] if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") else []
    command = [sys.executable, "-m", "rtcp.cli", "panel", "--port", str(port), *screen]
    serving = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert serving.stdout is not None
    try:
        address = serving.stdout.readline().rstrip()
        if not address:
            raise typer.Exit(serving.wait())  # it has printed the reason
        report(address)
        yield
    finally:
        serving.terminate()
        serving.wait()


def _wait_ready(running: Platform, hint: str, enable: bool) -> tuple[str, bool]:
    """Wait until the machine leaves `starting`; return a message and whether the start succeeded.

    A loop that only got its gateway back may be in any state: the start failed only if that is a fault.

    Args:
        running: the platform.
        hint: commands for the message.
        enable: whether to reset a fault of the start and to enable the drives. An emergency stop is never reset here,
            and neither is a fault of a loop that ran before: its cause may be the motion that it ended. The loop
            refuses to enable while an emergency stop is pressed, or while an enabling switch is not held.
    """
    until = time.monotonic() + READY_TIMEOUT_S
    try:
        with connect("start") as robot:
            while (status := robot.status()).state is State.STARTING and time.monotonic() < until:
                time.sleep(0.02)
            if enable:
                of_start = status.state is State.FAULT and running.started_loop
                if of_start:
                    robot.reset()
                if of_start or status.state is State.READY:
                    robot.enable()
                    status = robot.status()
    except RtcpError as error:
        return f"started, but: {error.message}", False
    state, message = status.state, status.message
    if state is State.READY:
        return f"ready: {hint} ends it", True
    if state is State.STARTING:
        message = f"not ready within {READY_TIMEOUT_S:g} s (`rtcp status`): {message}"
    if state in _NOT_READY:
        return f"started, but: {message}", False
    return f"{state.name.lower().replace('_', ' ')}: {message}", True


@commands.command("stop")
def _stop() -> None:
    """Stop the platform: drives disabled, slaves in INIT, processes ended."""
    from rtcp.launch import launcher

    problems = launcher.stop(report)
    if problems:
        raise CommandError("\n".join(f"stopped, but: {problem}" for problem in problems), ExitCode.FAULT)
    report("stopped")


def refuse_second_platform() -> None:
    """Raise CommandError while a platform runs, with or without a gateway."""
    if loop := loop_process():
        raise CommandError(
            f"a platform runs already (loop process {loop}): `rtcp status` shows it, `rtcp stop` ends it",
            ExitCode.REFUSED,
        )


def launch(options: StartOptions, log: Callable[[str], None] = report) -> Platform:
    """Start the platform and return it in the state ready; `log` receives a line for each step.

    Raises:
        RtcpError: the launcher refused; nothing is left running.
        CommandError: a signal ended the start; nothing is left running.
        ConfigError: names every mistake of the configuration.
    """
    from rtcp.launch import launcher
    from rtcp.virtual.segment import check_segment

    with interruptible("interrupted while starting: nothing is left running"):
        return launcher.start(options, log, check_segment)


@contextmanager
def running_platform(options: StartOptions) -> Iterator[float]:
    """Run a platform and yield the duration of its start, s; stop it on exit, also on a second Ctrl-C."""
    begun = time.monotonic()
    running = launch(options)
    try:
        yield time.monotonic() - begun
    finally:
        handlers = {number: signal.signal(number, signal.SIG_IGN) for number in _ENDING}
        try:
            problems = running.stop(report)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        if not problems:
            report("stopped")


def serve(options: StartOptions, announce: Callable[[Platform], None]) -> int:
    """Start the platform, call `announce` when it is up, supervise it to its end and return the exit code."""
    from rtcp.launch.supervisor import supervise

    with signals_raise():
        running = launch(options)
        try:
            announce(running)
            return supervise(running, report)
        except KeyboardInterrupt:  # a signal before `supervise` has installed its handlers
            return ExitCode.FAULT if running.stop(report) else ExitCode.DONE


# -- the running platform -------------------------------------------------------------------------------------------


def connect(command: str) -> Robot:
    """Connect under the command's name, which other clients see when they are refused.

    A loop that has lost its gateway gets a new one first; standard error reports it.

    Raises:
        NotRunning: there is no platform.
        RtcpError: as `Robot`.
    """
    name = f"rtcp {command} (pid {os.getpid()})"
    directory = runtime_directory()
    until = time.monotonic() + _TIMEOUT_S
    while True:
        try:
            return Robot(name)
        except NotRunning as error:
            # A gateway started by this user is of no use to another user's loop.
            mine = loop_process() and directory.stat().st_uid == os.geteuid()
            if time.monotonic() > until or not mine:
                raise
            _replace_gateway(directory, error)
        time.sleep(0.05)


def loop_process() -> int:
    """Return the process id of the running loop, with or without a gateway; 0 where there is none."""
    loop = read_processes(runtime_directory()).loop
    return loop if is_running(loop) else 0


@contextmanager
def stoppable(
    command: str, ends: str = "the connection is closed, the arm comes to a controlled stop"
) -> Iterator[Robot]:
    """Connect; on Ctrl-C, SIGTERM and SIGHUP close the connection, which stops the arm, and say how it `ends`.

    Signals that suspend do the same: otherwise the arm would move on while Ctrl-C does not reach the command.

    Raises:
        CommandError: the command was interrupted.
        RtcpError: as `connect`.
    """
    with signals_raise(*SUSPENDING), connect(command) as robot:
        try:
            yield robot
        except KeyboardInterrupt as interruption:
            robot.close()
            code = interruption_code(interruption)
            outcome = "ended, not suspended" if code - 128 in SUSPENDING else "interrupted"
            raise CommandError(f"{outcome}: {ends}", code) from None


def _replace_gateway(directory: Path, error: RtcpError) -> None:
    from rtcp.launch.launcher import replace_gateway  # seldom needed, loads slowly

    try:
        if process := replace_gateway(directory):
            complain(f"the gateway had ended; a new one was started (process {process}), nothing was enabled")
    except RtcpError as refused:
        if refused.kind != "refused":
            raise NotRunning("not running", f"{error.message}; {refused}") from refused
    except (OSError, TypeError):
        raise error from None  # the session file cannot be read: not a platform of this version
