"""How a motion shows its progress: a bar on a terminal, else a line every tenth of the way; Ctrl-C, Ctrl-Z stop it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rtcp.cli.errors import SUSPENDING, CommandError, interruption_code, orderly_signals
from rtcp.cli.output import console, report
from rtcp.ipc.client import ControlClient

Follow = Callable[[Mapping[str, Any]], None]


@contextmanager
def stopping(client: ControlClient) -> Iterator[None]:
    """While inside, Ctrl-C and its kin close the connection, which stops the arm.

    So does what would suspend the command: the arm would move on, and Ctrl-C would not reach whoever could stop it.

    Raises:
        CommandError: that it was interrupted.
    """
    with orderly_signals(*SUSPENDING), client:
        try:
            yield
        except KeyboardInterrupt as interruption:
            client.close()
            code = interruption_code(interruption)
            what = "ended, not suspended" if code - 128 in SUSPENDING else "interrupted"
            raise CommandError(
                f"{what}: the connection is closed, so the arm comes to a controlled stop", code
            ) from None


@contextmanager
def progress() -> Iterator[Follow]:
    """Give a function that shows progress."""
    if not sys.stdout.isatty():
        yield _line_reporter()
        return
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (TextColumn("moving"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"))
    with Progress(*columns, console=console()) as bar:
        task = bar.add_task("move", total=1.0, left="")

        def follow(told: Mapping[str, Any]) -> None:
            bar.update(task, completed=_fraction(told), left=_remaining(told))

        yield follow
        bar.update(task, completed=1.0, left="")


def _line_reporter() -> Follow:
    shown = -1

    def follow(told: Mapping[str, Any]) -> None:
        nonlocal shown
        tenth = int(_fraction(told) * 10)
        if tenth > shown:
            shown = tenth
            report(f"moving: {_fraction(told):4.0%} {_remaining(told)}".rstrip())

    return follow


def _fraction(told: Mapping[str, Any]) -> float:
    value = told.get("fraction")
    return min(1.0, max(0.0, float(value))) if isinstance(value, int | float) else 0.0


def _remaining(told: Mapping[str, Any]) -> str:
    value = told.get("remaining_s")
    return f"{value:.1f} s left" if isinstance(value, int | float) else ""
