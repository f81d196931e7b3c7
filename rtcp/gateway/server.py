"""The gateway: the control socket, and the picture of the platform that it serves.

It may die and be started again while the loop holds the arm still: a motion that it was carrying ends with its lease.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtcp.gateway.arguments import Arguments
from rtcp.gateway.blackbox import BlackBox
from rtcp.gateway.blackbox_file import faults_directory
from rtcp.gateway.carrier import CommandFailed, Progress
from rtcp.gateway.held import Caller
from rtcp.gateway.picture import Picture
from rtcp.gateway.verbs import Verb, Verbs
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, log_format, stop_marker
from rtcp.ipc.session import (
    SessionError,
    exit_problems,
    is_running,
    processes_file,
    read_json,
    read_processes,
    read_session,
    terminate,
    wait_for_exit,
)

_FOLLOW_S = 0.02
_COMPLAINT_S = 10.0
"""Between two lines of the log on the same defect."""
_LINE_LIMIT = 1 << 16
_TOO_LONG = b""
"""Stands for a line beyond the limit; a true one has its newline at least."""
_LET_GO_S = 1.0
log = logging.getLogger("rtcp.gateway")


class Gateway:
    """Serves one running platform.

    Args:
        directory: the runtime directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        session = read_session(directory)
        self._observer = Observer(blackboard_file(directory))
        started = read_json(directory / "started.json", dict)
        self._picture = Picture(self._observer, session, started)
        self._picture.follow()  # what an earlier gateway has logged, with its time, is not logged again
        self._arm = Verbs(self._observer, self._picture, session.config, session.bus, directory)
        self._box = BlackBox(self._observer, session, faults_directory(), self._picture.note)
        self._complained: dict[str, float] = {}
        """When a defect was logged, by what met it."""
        self._connections = 0
        self._ended = asyncio.Event()
        self._stopping = False
        self._following: asyncio.Task[None] | None = None
        self._verbs: dict[str, Verb] = {
            "status": self._status,
            "scan": self._scan,
            "stop": self._stop,
            **self._arm.table,
        }

    async def serve(self, ready: Callable[[], None]) -> None:
        """Serve until the platform is stopped or SIGTERM comes; call `ready` when the socket listens."""
        path = control_socket(self._directory)
        path.unlink(missing_ok=True)
        before = os.umask(0o177)
        try:
            server = await asyncio.start_unix_server(self._client, path, limit=_LINE_LIMIT)
        finally:
            os.umask(before)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._ended.set)
        self._watch_loop(loop)
        self._following = asyncio.create_task(self._follow())
        # An earlier gateway may have died with inputs forced.
        await self._arm.stick.let_go()
        watching = asyncio.create_task(self._arm.stick.watch())
        ready()
        await self._ended.wait()
        # Not waiting for clients that are still there (`status --watch`): they learn it by the closed connection.
        server.close()
        watching.cancel()
        if self._picture.loop_lives and not self._stopping:
            await self._arm.stick.let_go()
        self._following.cancel()
        path.unlink(missing_ok=True)
        await asyncio.to_thread(self._box.finish)

    def _watch_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        try:
            descriptor = os.pidfd_open(self._observer.loop_pid)
        except OSError:
            self._loop_has_ended()
            return

        def gone() -> None:
            loop.remove_reader(descriptor)
            os.close(descriptor)
            self._loop_has_ended()
            log.error("the loop (process %d) has ended", self._observer.loop_pid)

        loop.add_reader(descriptor, gone)

    def _loop_has_ended(self) -> None:
        self._picture.loop_lives = False
        self._box.loop_has_ended()

    async def _follow(self) -> None:
        while True:
            self._go_on("the picture", self._tell_news)
            self._go_on("the black box", self._box.look)
            await asyncio.sleep(_FOLLOW_S)

    def _tell_news(self) -> None:
        for sentence in self._picture.follow():
            log.info("%s", sentence)

    def _go_on(self, what: str, turn: Callable[[], None]) -> None:
        """Take one turn; a defect in it is logged, now and then, and ends neither the others nor the next one."""
        try:
            turn()
        except Exception:
            now = time.monotonic()
            if now - self._complained.get(what, -_COMPLAINT_S) >= _COMPLAINT_S:
                self._complained[what] = now
                log.exception("%s cannot follow the loop; it is tried again", what)

    # -- clients ------------------------------------------------------------------------------------------------

    async def _client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        connection = self._connections
        try:
            with contextlib.suppress(ConnectionError, asyncio.CancelledError):
                await self._converse(reader, writer, connection)
        finally:
            await self._arm.gone(connection)
        with contextlib.suppress(ConnectionError):
            writer.close()

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, connection: int) -> None:
        line = asyncio.ensure_future(_read_line(reader))
        while True:
            given = await line
            if given is None:
                return
            if given is _TOO_LONG:
                sentence = f"the request is a line longer than {_LINE_LIMIT} bytes: the connection is closed"
                await _send(writer, _refusal(None, "invalid", sentence))
                await _let_go(reader)
                return
            line = asyncio.ensure_future(_read_line(reader))
            work = asyncio.ensure_future(self._answer(given, writer, connection))
            # A client that goes away ends what it asked for: its lease goes with it.
            await asyncio.wait({line, work}, return_when=asyncio.FIRST_COMPLETED)
            if not work.done() and line.done() and line.result() is None:
                work.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await work
                return
            await work

    async def _answer(self, given: bytes, writer: asyncio.StreamWriter, connection: int) -> None:
        number: Any = None
        try:
            request = _parse(given)
            number = request.get("id")

            async def tell(progress: dict[str, Any]) -> None:
                await _send(writer, {"id": number, "progress": progress})

            verb = self._verbs.get(str(request.get("do")))
            if verb is None:
                raise CommandFailed("invalid", f"{request.get('do')!r} is unknown: one of {', '.join(self._verbs)}")
            args = request.get("args") or {}
            if not isinstance(args, dict):
                raise CommandFailed("invalid", f"args must be an object, not {type(args).__name__}")
            client = Caller(str(request.get("client") or "an unnamed client"), connection)
            result = await verb(client, Arguments(args), tell)
            await _send(writer, {"id": number, "ok": True, "result": result})
        except CommandFailed as failed:
            await _send(writer, _refusal(number, failed.kind, str(failed)))
        except (KeyError, TypeError, ValueError, OverflowError, struct.error, BlackboardError) as error:
            sentence = f"the request's arguments are not of the verb's form: {type(error).__name__} {error}"
            await _send(writer, _refusal(number, "invalid", sentence))
        except ConnectionError:
            raise
        except Exception as error:
            # One request's defect is answered and logged; the others are served on.
            log.exception("request %.200r", given)
            sentence = f"the gateway met a defect: {type(error).__name__} {error}"
            await _send(writer, _refusal(number, "internal", sentence))
        if self._stopping:
            self._ended.set()

    # -- verbs --------------------------------------------------------------------------------------------------

    async def _status(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        self._picture.follow()
        return self._picture.status(read_processes(self._directory))

    async def _scan(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        try:
            slaves = read_json(self._directory / "scan.json", list)
        except SessionError as error:
            raise CommandFailed("internal", str(error)) from error
        states = self._picture.status(read_processes(self._directory))["slaves"]
        for slave, now in zip(slaves, states, strict=False):
            slave["state"] = now["state"]
        return {"slaves": slaves}

    async def _stop(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        processes = read_processes(self._directory)
        lived = is_running(processes.loop)
        if processes.loop and not lived:
            # It has died before it was told to, and whoever saw that was quicker here than its end.
            self._loop_has_ended()
        self._box.end_is_wanted()
        stop_marker(self._directory).touch(mode=0o600)
        if self._picture.loop_lives:
            with contextlib.suppress(BlackboardError):
                await self._arm.commander.shut_down()
            # The blocking waits run beside, so that this process goes on answering `status`.
            if not await asyncio.to_thread(wait_for_exit, processes.loop, 6.0):
                await asyncio.to_thread(terminate, processes.loop, 4.0)
        await asyncio.to_thread(terminate, processes.segment, 3.0)
        if self._following is not None:
            self._following.cancel()
        await asyncio.to_thread(self._box.finish)
        blackboard_file(self._directory).unlink(missing_ok=True)
        processes_file(self._directory).unlink(missing_ok=True)
        self._stopping = True
        return {"left": list(exit_problems(self._directory, processes.loop, lived))}


async def _read_line(reader: asyncio.StreamReader) -> bytes | None:
    """Return the next line, `_TOO_LONG` in place of one beyond the limit, None where the client is gone."""
    try:
        line = await reader.readline()
    except ConnectionError:
        return None
    except ValueError:
        return _TOO_LONG
    return line or None


async def _let_go(reader: asyncio.StreamReader) -> None:
    """Take what a client still sends, for a while: it reads its answer only when it has sent all."""

    async def rest() -> None:
        while await reader.read(_LINE_LIMIT):
            pass

    with contextlib.suppress(asyncio.TimeoutError):
        await asyncio.wait_for(rest(), _LET_GO_S)


def _parse(given: bytes) -> dict[str, Any]:
    try:
        request = json.loads(given, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise CommandFailed("invalid", f"the request is no JSON: {error}") from None
    if not isinstance(request, dict):
        raise CommandFailed("invalid", f"the request must be an object, not {type(request).__name__}")
    if type(number := request.get("id")) not in (int, str, type(None)):
        raise CommandFailed("invalid", f"id: found {type(number).__name__}, allowed is an integer or a text")
    return request


def _no_constant(found: str) -> float:
    """NaN and Infinity, which Python takes for JSON, are none."""
    raise ValueError(f"{found} is no number")


def _refusal(number: Any, kind: str, sentence: str) -> dict[str, Any]:
    return {"id": number, "ok": False, "error": {"kind": kind, "message": sentence}}


async def _send(writer: asyncio.StreamWriter, answer: dict[str, Any]) -> None:
    writer.write(json.dumps(answer).encode() + b"\n")
    await writer.drain()


def main() -> int:
    """Run the gateway's process."""
    parser = argparse.ArgumentParser(prog="rtcp.gateway.server")
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--ready-fd", type=int, required=True)
    given = parser.parse_args()
    to_stderr = logging.StreamHandler(sys.stderr)
    to_stderr.setFormatter(log_format())
    logging.basicConfig(level=logging.INFO, handlers=[to_stderr])

    def ready() -> None:
        with contextlib.suppress(OSError):
            os.write(given.ready_fd, json.dumps({"event": "ready", "pid": os.getpid()}).encode() + b"\n")
            os.close(given.ready_fd)

    try:
        asyncio.run(_run(given.directory, ready))
    except (BlackboardError, SessionError, OSError, TypeError) as error:
        sys.stderr.write(f"gateway: {error}\n")
        return 1
    return 0


async def _run(directory: Path, ready: Callable[[], None]) -> None:
    await Gateway(directory).serve(ready)
    # asyncio closes the pipe that it learns of signals by before it takes its handlers back: one in between would be a
    # traceback in the log.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main())
