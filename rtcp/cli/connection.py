"""How commands reach the running platform."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rtcp.cli.errors import SUSPENDING, CommandError, interruption_code, signals_raise
from rtcp.cli.output import complain
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import is_running, read_processes

_TIMEOUT_S = 10.0
"""Time for another command to start the gateway."""


def connect(command: str) -> ControlClient:
    """Connect under the command's name, which other clients see when they are refused.

    A loop that has lost its gateway gets a new one first; standard error reports it.

    Raises:
        RtcpError: `not running` where there is no platform; others as `ControlClient`.
    """
    name = f"rtcp {command} (pid {os.getpid()})"
    directory = runtime_directory()
    until = time.monotonic() + _TIMEOUT_S
    while True:
        try:
            return ControlClient(name)
        except RtcpError as error:
            # A gateway started by this user is of no use to another user's loop.
            mine = loop_process() and directory.stat().st_uid == os.geteuid()
            if error.kind != "not running" or time.monotonic() > until or not mine:
                raise
            _replace_gateway(directory, error)
        time.sleep(0.05)


def ask(command: str, verb: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Send one request on a connection of its own and return the result; raises RtcpError."""
    with connect(command) as client:
        return client.call(verb, arguments)


def loop_process() -> int:
    """Return the process id of the running loop, with or without a gateway; 0 where there is none."""
    loop = read_processes(runtime_directory()).loop
    return loop if is_running(loop) else 0


@contextmanager
def stopping(client: ControlClient) -> Iterator[None]:
    """Close the connection on Ctrl-C, SIGTERM and SIGHUP, which stops the arm.

    Signals that suspend do the same: otherwise the arm would move on while Ctrl-C does not reach the command.

    Raises:
        CommandError: the command was interrupted.
    """
    with signals_raise(*SUSPENDING), client:
        try:
            yield
        except KeyboardInterrupt as interruption:
            client.close()
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
            raise RtcpError("not running", f"{error.message}; {refused}") from refused
    except (OSError, TypeError):
        raise error from None  # the session file cannot be read: not a platform of this version
