"""How the loop ended: it writes that down itself, last of all; where it has not, it did not end as it should."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from rtcp.ipc.session import Pid, SessionError, identify, is_ours, read_json

LEFT = 3
"""Exit code of a loop that ended by itself and could not leave everything as it should."""


def _file(directory: Path) -> Path:
    return directory / "ended.json"


def forget_end(directory: Path) -> None:
    """Remove what an earlier loop wrote."""
    _file(directory).unlink(missing_ok=True)


def write_end(directory: Path, pid: int, left: Sequence[str]) -> None:
    """Write that the loop (this process) has left the bus, and in sentences what is not as it should be."""
    told = {"pid": pid, "started": identify(pid).started, "left": list(left)}
    try:
        fresh = _file(directory).with_suffix(".new")
        fresh.write_text(json.dumps(told))
        fresh.replace(_file(directory))
    except OSError as error:
        # Whoever asks is then told that the loop did not end in order: rather that than the contrary.
        with contextlib.suppress(OSError):
            sys.stderr.write(f"{_file(directory)} cannot be written: {error.strerror}\n")


def end_of(directory: Path, loop: Pid, lived: bool) -> tuple[str, ...]:
    """Return in sentences what the end of a platform's loop has left otherwise than drives disabled and slaves in INIT.

    Args:
        directory: the runtime directory.
        loop: the loop's process; 0: there was none.
        lived: it was there when its end was asked for.
    """
    if not loop:
        return ()
    with contextlib.suppress(SessionError):
        told = read_json(_file(directory), dict)
        left = told.get("left")
        if (told.get("pid"), told.get("started")) == (loop, loop.started) and isinstance(left, list):
            return tuple(str(sentence) for sentence in left)
    if is_ours(loop):
        return (f"the loop (process {loop}) does not end, also not by SIGKILL: its drives were left to their watchdog",)
    fate = "did not end in time and was killed" if lived else "had ended before, and not in order"
    return (f"the loop (process {loop}) {fate}: its drives were left to their watchdog",)
