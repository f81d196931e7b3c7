"""How commands reach the running platform."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rtcp.api import NotRunning, Robot, RtcpError
from rtcp.cli.errors import SUSPENDING, CommandError, interruption_code, signals_raise
from rtcp.cli.output import complain
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import is_running, read_processes

_TIMEOUT_S = 10.0
"""Time for another command to start the gateway."""


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
def stoppable(command: str) -> Iterator[Robot]:
    """Connect; on Ctrl-C, SIGTERM and SIGHUP close the connection, which stops the arm.

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
            what = "ended, not suspended" if code - 128 in SUSPENDING else "interrupted"
            raise CommandError(f"{what}: the connection is closed, the arm comes to a controlled stop", code) from None


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
