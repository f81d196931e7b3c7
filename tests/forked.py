"""Processes that begin as a copy of a server which has imported the platform: `python -m` without its half second.

A forked process is a process of its own, with one thread, as a segment and a master need to join a network namespace.
"""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import runpy
import signal
import sys
import warnings
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection
from typing import Any

_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload(
    [
        "rtcp.launch.offline",
        "rtcp.virtual.server",
        "rtcp.virtual.faults.frames",
        "rtcp.virtual.faults.slaves",
        "rtcp.virtual.models.cubemars",
        "rtcp.virtual.models.diewu",
        "tests.fieldbus.watcher_child",
        "tests.virtual.any_child",
    ]
)


class Forked:
    """`python -m module *arguments`, with its output; `given` is its standard input. Its errors go to the test's."""

    def __init__(self, module: str, *arguments: str, given: str = "") -> None:
        reading, writing = _SERVER.Pipe(duplex=False)
        self._output = os.fdopen(os.dup(reading.fileno()), encoding="utf-8")
        reading.close()
        errors = Connection(os.dup(2), readable=False)
        self._process = _SERVER.Process(
            target=_run, args=(module, arguments, given, dict(os.environ), os.getcwd(), writing, errors), daemon=True
        )
        self._process.start()
        writing.close()
        errors.close()
        self.pid: int = self._process.pid

    def line(self) -> str:
        """Wait for a line of its output; empty where it has ended without one."""
        return self._output.readline()

    def output(self) -> str:
        """Wait for its end; return the output that was not read yet."""
        text = self._output.read()
        self._process.join()
        return text

    @property
    def code(self) -> int:
        """Exit code, or the negative number of the signal that ended it."""
        return self._process.exitcode

    def send_signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM if it still runs."""
        self._process.terminate()

    def end(self) -> None:
        """Kill it if it still runs."""
        self._process.kill()
        self._process.join()
        self._output.close()


def answer_of(module: str, *arguments: str, given: str = "") -> Any:
    """Run a module until it ends; return its output, which is JSON. Without an output: None."""
    process = Forked(module, *arguments, given=given)
    try:
        output = process.output()
    finally:
        process.end()
    return json.loads(output) if output else None


def _run(
    module: str,
    arguments: Sequence[str],
    given: str,
    environment: Mapping[str, str],
    directory: str,
    writing: Connection,
    errors: Connection,
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(directory)
    for connection, standard in ((writing, 1), (errors, 2)):
        os.dup2(connection.fileno(), standard)
        connection.close()
    sys.stdin = io.TextIOWrapper(io.BytesIO(given.encode()))
    sys.argv = [module, *arguments]
    warnings.simplefilter("ignore")  # of runpy: the module is imported already
    runpy.run_module(module, run_name="__main__", alter_sys=True)
