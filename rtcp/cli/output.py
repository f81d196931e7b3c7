"""Output of commands: tables, progress, and how a command ends (exit codes, errors, signals)."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, BinaryIO

import typer

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.table import Table

    from rtcp.api import Progress

    ShowProgress = Callable[[Progress], None]

PIPED_WIDTH = 80
"""Columns of a table that goes to a file or a pipe."""
ABSENT = "-"
_CONTROLS = {code: "?" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\r\t"}
"""Control characters: a name in a file must not control the terminal."""
_LONG_S = 2.0
"""Duration of a transfer from which on its progress is printed, s."""


def emit(text: str) -> None:
    """Print a result; end the command quietly when the reader has closed the pipe (`rtcp status | head -1`)."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        mute()
        raise typer.Exit(0) from None


def emit_json(value: Any) -> None:
    """Print one JSON value on one line."""
    emit(json.dumps(value, default=str))


def report(text: str) -> None:
    """Print one line of progress; continue silently when the reader has closed the pipe."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        mute()


def complain(text: str) -> None:
    """Print an error on standard error, `rtcp: ` before each line."""
    try:
        for line in text.translate(_CONTROLS).splitlines() or [""]:
            print(f"rtcp: {line}", file=sys.stderr, flush=True)
    except OSError:
        pass  # standard error is closed; the exit code still tells


def mute() -> None:
    """Redirect standard output to /dev/null, so that neither a later line nor the flush at exit fails."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, sys.stdout.fileno())
    os.close(null)


def console() -> Console:
    """Return a console on standard output; colour only on a terminal, NO_COLOR and TERM=dumb obeyed."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else PIPED_WIDTH)


def show(*renderables: RenderableType) -> None:
    """Print tables and panels: coloured and as wide as the terminal, or plain at 80 columns in a pipe."""
    canvas = console()
    with canvas.capture() as captured:
        for renderable in renderables:
            canvas.print(renderable)
    emit("\n".join(line.rstrip() for line in captured.get().rstrip().splitlines()))


def table(
    headings: Sequence[str],
    left: Collection[str] = (),
    *,
    title: str | None = None,
    expand: bool = False,
    fill: str = "",
    padding: int = 1,
) -> Table:
    """Return an empty table; columns are right-aligned and do not wrap.

    Args:
        headings: one for each column.
        left: headings of the columns that are left-aligned.
        title: line above the table.
        expand: use the full width.
        fill: heading of the column that takes the remaining width and wraps.
        padding: blanks on each side of a cell.
    """
    from rich import box
    from rich.table import Table

    grid = Table(
        box=box.SIMPLE_HEAD, title=title, title_justify="left", show_edge=False, expand=expand, padding=(0, padding)
    )
    for heading in headings:
        wraps = heading == fill and heading != ""
        grid.add_column(
            heading,
            justify="left" if heading in left or wraps else "right",
            no_wrap=not wraps and "\n" not in heading,
            ratio=1 if wraps else None,
        )
    return grid


def facts() -> Table:
    """Return an empty grid of two columns: a label and its value, which wraps."""
    from rich.table import Table

    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column()
    return grid


@contextmanager
def progress() -> Iterator[ShowProgress]:
    """Yield a function that shows the progress of a motion: a bar on a terminal, else a line every 10 %.

    While the motion is planned, and may still be refused, nothing is shown.
    """
    if not sys.stdout.isatty():
        yield _line_reporter()
        return
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("moving"), BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"))
    bar = Bar(*columns, console=console())
    task = bar.add_task("move", total=1.0, left="")

    def draw(update: Progress) -> None:
        if _has_begun(update):
            bar.start()
            bar.update(task, completed=update.fraction, left=_left(update))

    try:
        yield draw
        bar.update(task, completed=1.0, left="")
    finally:
        if bar.live.is_started:
            bar.stop()


@contextmanager
def transfer(label: str, total: float | None = None, *, quiet: bool = False) -> Iterator[Callable[[float], None]]:
    """Yield a function that shows the progress of a transfer: a bar on a terminal, else a line each 10 % of a long one.

    Args:
        label: text before the progress.
        total: end of the progress; None: unknown, then no lines are printed.
        quiet: nothing but the bar, where the output is for programs.
    """
    reported, began = 0, 0.0

    def line(done: float) -> None:
        nonlocal reported, began
        began = began or time.monotonic()
        if total and not quiet and time.monotonic() - began > _LONG_S and (tenth := int(10 * done / total)) > reported:
            reported = tenth
            report(f"{label}: {10 * tenth} %")

    if not sys.stdout.isatty():
        yield line
        return
    from rich.progress import Progress as Bar

    with Bar(console=console(), transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done: bar.update(task, completed=done)


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file, created before its data is read; an error leaves no empty file.

    Raises:
        CommandError: there is one already, or none can be made there.
    """
    try:
        file = path.open("xb")
    except FileExistsError:
        raise CommandError(f"{path}: there is such a file; it is not overwritten: give another name") from None
    except OSError as error:
        raise CommandError(f"{path}: {error.strerror}; no file can be made there") from error
    try:
        with file:
            yield file
    except BaseException:
        if path.stat().st_size == 0:
            path.unlink()
        raise


def _line_reporter() -> ShowProgress:
    reported = -1

    def line(update: Progress) -> None:
        nonlocal reported
        tenth = int(update.fraction * 10)
        if _has_begun(update) and tenth > reported:
            reported = tenth
            report(f"moving: {update.fraction:4.0%}{_left(update)}")

    return line


def _has_begun(update: Progress) -> bool:
    return update.remaining_s > 0 or update.fraction > 0


def _left(update: Progress) -> str:
    return f" {update.remaining_s:.1f} s left" if update.remaining_s > 0 else ""


# -- the end of a command -------------------------------------------------------------------------------------------


class ExitCode(IntEnum):
    """Exit codes of `rtcp`, for scripts."""

    DONE = 0
    INTERNAL = 1
    USAGE = 2
    """The command line or the configuration is wrong; nothing was started or moved."""
    REFUSED = 3
    """The platform runs and refuses the command in its present state."""
    NOT_RUNNING = 4
    FAULT = 5
    """The command started and failed, or timed out."""
    INTERRUPTED = 130


_CODES = {
    "invalid": ExitCode.USAGE,
    "usage": ExitCode.USAGE,
    "config": ExitCode.USAGE,
    "refused": ExitCode.REFUSED,
    "not running": ExitCode.NOT_RUNNING,
    "internal": ExitCode.INTERNAL,
}
SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
"""Signals that suspend a command: Ctrl-Z, and terminal access from the background."""


class CommandError(Exception):
    """A failed command: the message (one line for each problem) and the exit code."""

    def __init__(self, message: str, code: int = ExitCode.USAGE) -> None:
        super().__init__(message)
        self.message = message
        self.code = int(code)


class Interrupted(KeyboardInterrupt):
    """A signal that ends the command with the same clean-up as Ctrl-C."""

    def __init__(self, number: int) -> None:
        super().__init__(f"ended by {signal.Signals(number).name}")
        self.code = 128 + number


def code_of(kind: str) -> ExitCode:
    """Return the exit code of an error kind; kinds that are not listed (fault, timeout, lost) give FAULT."""
    return _CODES.get(kind, ExitCode.FAULT)


def interruption_code(error: KeyboardInterrupt) -> int:
    """Return 130 for Ctrl-C and 128 + number for another signal, as shells do."""
    return error.code if isinstance(error, Interrupted) else ExitCode.INTERRUPTED


@contextmanager
def interruptible(message: str, *more: signal.Signals) -> Iterator[None]:
    """Turn Ctrl-C, SIGTERM, SIGHUP and `more` into a CommandError with this message, after all `finally` blocks."""
    try:
        with signals_raise(*more):
            yield
    except KeyboardInterrupt as interruption:
        raise CommandError(message, interruption_code(interruption)) from None


@contextmanager
def asking(instead: str) -> Iterator[None]:
    """Turn an end of the input at a question, as without a terminal, into a CommandError; `instead`: what to do."""
    try:
        yield
    except (RuntimeError, UnicodeDecodeError):  # `typer.Abort`, or an input that is closed or no text
        if sys.stdin is not None and sys.stdin.isatty():
            raise
        raise CommandError(f"standard input has ended at a question: {instead}") from None


def confirm(question: str) -> None:
    """Ask a question that the option --yes leaves out; end the command unless the answer is yes.

    Raises:
        CommandError: nobody answers.
    """
    with asking("answer it, or pass --yes"):
        answer = typer.confirm(question)
    if not answer:
        raise typer.Abort


@contextmanager
def signals_raise(*more: signal.Signals) -> Iterator[None]:
    """Raise `Interrupted` on SIGTERM, SIGHUP and `more` while inside, so that `finally` blocks run."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise Interrupted(number)

    handlers = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP, *more)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
