"""What the commands print: answers on standard output, sentences about trouble on standard error."""

from __future__ import annotations

import json
import os
import sys
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

PIPED_WIDTH = 80
"""Columns of tables that go to a file or a pipe."""


def emit(text: str) -> None:
    """Print an answer at once; end the command quietly when its reader has gone (`rtcp status | head -1`)."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        mute()
        raise typer.Exit(0) from None


def emit_json(value: Any) -> None:
    """Print one JSON value on one line."""
    emit(json.dumps(value, default=str))


def report(text: str) -> None:
    """Print one line of progress; go on silently when its reader has gone."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        mute()


def complain(text: str) -> None:
    """Print a sentence about trouble on standard error, each line marked as ours."""
    try:
        for line in text.splitlines() or [""]:
            print(f"rtcp: {line}", file=sys.stderr, flush=True)
    except OSError:
        pass  # nobody is left to tell; the exit code still says it


def show(*renderables: RenderableType) -> None:
    """Print rich's tables and panels: coloured and as wide as the terminal, or plain at 80 columns in a pipe."""
    canvas = console()
    with canvas.capture() as captured:
        for renderable in renderables:
            canvas.print(renderable)
    emit("\n".join(line.rstrip() for line in captured.get().rstrip().splitlines()))


def console() -> Console:
    """Return a console on standard output; colour only on a terminal, NO_COLOR and TERM=dumb obeyed."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else PIPED_WIDTH)


def mute() -> None:
    """Point standard output at nothing, so that neither a later line nor the interpreter's last flush fails."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, sys.stdout.fileno())
    os.close(nothing)
