"""Control sockets of virtual devices: where a command that runs one listens, and how the other commands find it."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from rtcp.cli.output import CommandError, ExitCode
from rtcp.ipc.runtime_directory import (
    RuntimeDirectoryError,
    free_control,
    is_listening,
    make_runtime_directory,
    runtime_directory,
)

if TYPE_CHECKING:
    from rtcp.virtual.request_socket import RequestClient

_Client = TypeVar("_Client", bound="RequestClient")


def free_path(usual: Path) -> Path:
    """Return a free path for a control socket, in the runtime directory where that is possible."""
    try:
        make_runtime_directory(runtime_directory())
    except RuntimeDirectoryError:
        return Path(tempfile.gettempdir()) / f"rtcp-{usual.stem}-{os.getpid()}.sock"
    return free_control(usual)


def settle(cpu: int | None) -> None:
    """Leave the CPU of a cycle, unless one was chosen; end when the terminal closes as by SIGTERM."""
    from rtcp.realtime.scheduling import available_cpus, choose_cpu

    if cpu is None and (others := set(available_cpus()) - {choose_cpu(None)}):
        os.sched_setaffinity(0, others)
    signal.signal(signal.SIGHUP, signal.getsignal(signal.SIGTERM))


@contextmanager
def connected(client: Callable[[Path], _Client], path: Path | None, usual: Path, device: str) -> Iterator[_Client]:
    """Connect to the device at `path`, or to the running one of those at `usual` and beside it.

    `device` names it in messages; its option has the name of the file `usual`.

    Raises:
        CommandError: none runs, several run, or the device refuses.
    """
    from rtcp.virtual.request_socket import RequestRefused, ServerAway

    try:
        with client(path or _running(usual, device)) as connection:
            yield connection
    except ServerAway as error:
        raise CommandError(str(error), ExitCode.NOT_RUNNING) from error
    except RequestRefused as error:
        raise CommandError(str(error), ExitCode.REFUSED) from error


def _running(usual: Path, device: str) -> Path:
    beside = sorted(usual.parent.glob(f"{usual.stem}-*.sock"))
    paths = [path for path in (usual, *beside) if is_listening(path)]
    if not paths:
        raise CommandError(f"no {device} is running: nothing listens at {usual}", ExitCode.NOT_RUNNING)
    if len(paths) > 1:
        raise CommandError(f"several are running: choose by --{usual.stem} {' or '.join(map(str, paths))}")
    return paths[0]
