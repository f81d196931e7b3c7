"""`rtcp status`: what the platform does, for people and for programs, once or continuously."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from typing import Annotated, Any

import typer

from rtcp.cli.connection import connect, loop_lives
from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import console, emit, emit_json, show
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError

REFRESH_S = 0.1
"""Time between two pictures of `--watch` on a terminal, and between two lines of JSON."""

PIPED_REFRESH_S = 1.0
"""Time between two pictures of `--watch` in a pipe, where each one is a whole table."""


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("status")(_status)


def _status(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line, SI units.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Refresh until Ctrl-C.")] = False,
) -> None:
    """Show state, joints, slaves, cycle times and clocks of the running platform."""
    with connect("status") as client:
        if not watch:
            status = client.call("status")
            if as_json:
                emit_json(status)
                return
            from rtcp.cli.status_view import picture

            show(picture(status))
            return
        try:
            _watch(client, as_json)
        except KeyboardInterrupt:
            raise typer.Exit(ExitCode.DONE) from None  # Ctrl-C is how a watch ends


def _watch(client: ControlClient, as_json: bool) -> None:
    if as_json:
        for status in _pictures(client, REFRESH_S):
            emit_json(status)
        return
    from rtcp.cli.status_view import picture

    if not sys.stdout.isatty():
        for status in _pictures(client, PIPED_REFRESH_S):
            show(picture(status))
            emit("")
        return
    from rich.live import Live

    with Live(console=console(), auto_refresh=False, vertical_overflow="crop") as live:
        for status in _pictures(client, REFRESH_S):
            live.update(picture(status), refresh=True)


def _again(client: ControlClient) -> ControlClient:
    """Connect again where only the gateway has ended.

    Raises:
        CommandError: the loop has ended too.
        RtcpError: it lives, and nobody answers for it.
    """
    client.close()
    try:
        return connect("status")
    except RtcpError as error:
        if loop_lives():
            raise
        raise CommandError("the platform has ended", ExitCode.NOT_RUNNING) from error


def _pictures(client: ControlClient, interval_s: float) -> Iterator[dict[str, Any]]:
    """Yield the status on an even grid; a platform that ends while it is watched is `not running`."""
    due = time.monotonic()
    try:
        while True:
            try:
                status = client.call("status")
            except RtcpError as error:
                if error.kind != "lost":
                    raise
                client = _again(client)
                continue
            yield status
            due = max(due + interval_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    finally:
        client.close()  # also one that took the first one's place
