"""How commands reach the running platform."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtcp.cli.output import complain
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import is_running, read_processes

_PATIENCE_S = 10.0
"""For a gateway that somebody else is starting."""


def connect(command: str) -> ControlClient:
    """Connect under the command's name, which others are told when they are refused.

    A loop that lives and has lost its gateway is given a new one first, and that is told on standard error.

    Raises:
        RtcpError: as `ControlClient` does, `not running` above all.
    """
    name = f"rtcp {command} (pid {os.getpid()})"
    directory = runtime_directory()
    until = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return ControlClient(name)
        except RtcpError as error:
            if error.kind != "not running" or time.monotonic() > until or not _is_our_loop(directory):
                raise
            _replace_gateway(directory, error)
        time.sleep(0.05)


def ask(command: str, verb: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Send one request on a connection of its own and return the result.

    Raises:
        RtcpError: what the platform answered, or that there is none.
    """
    with connect(command) as client:
        return client.call(verb, arguments)


def loop_lives() -> bool:
    """Whether the platform's loop runs, whoever answers for it."""
    return is_running(read_processes(runtime_directory()).loop)


def _is_our_loop(directory: Path) -> bool:
    """Whether a loop lives, of this user: another's could not use a gateway of ours."""
    return loop_lives() and directory.stat().st_uid == os.geteuid()


def _replace_gateway(directory: Path, error: RtcpError) -> None:
    from rtcp.launch.launcher import replace_gateway  # here: it is seldom needed, and loads slowly
    from rtcp.launch.platform import StartError

    try:
        if process := replace_gateway(directory):
            complain(f"the gateway had ended and was started anew (process {process}); nothing was enabled by that")
    except StartError as refused:
        if refused.kind != "refused":
            raise RtcpError("not running", f"{error.message}; {refused}") from refused
    except (OSError, TypeError):
        raise error from None  # what the loop was started with cannot be read: no platform of this version
