"""The gateway's process: JSON-RPC on the control socket, status and black box.

It may die and be started again while the loop holds the arm: a motion on its behalf ends with its lease.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rtcp.config.find import load_messages
from rtcp.gateway.black_box import BlackBox
from rtcp.gateway.command_channel import Caller, Json
from rtcp.gateway.methods import Methods
from rtcp.gateway.ros_server import RosServer
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc import jsonrpc
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.recording import faults_directory
from rtcp.ipc.runtime_directory import blackboard_file, control_socket, log_format, stop_marker
from rtcp.ipc.session import (
    SessionError,
    exit_problems,
    is_running,
    launch_arguments,
    processes_file,
    read_json,
    read_processes,
    read_session,
    terminate,
    wait_for_exit,
)

_FOLLOW_S = 0.02
_REPEAT_LOG_S = 10.0
"""Interval between two lines of the log on the same defect, s."""
_MOST_PENDING = 256
"""Most requests of one connection that wait for their answers."""
_MOST_UNREAD = 1 << 16
"""Most bytes of answers that wait for a client; beyond, it gets no progress reports."""
_SEND_BUFFER = 4096
"""Send buffer, bytes, which the kernel doubles: a client that does not read is noticed after about ten reports."""
_LINGER_S = 1.0
log = logging.getLogger("rtcp.gateway")


class _Connection:
    """One client: its requests are carried out in order, except for methods marked `at_once`."""

    def __init__(
        self, number: int, writer: asyncio.StreamWriter, methods: Methods, answered: Callable[[], None]
    ) -> None:
        self._number = number
        self._writer = writer
        self._methods = methods
        self._answered = answered
        self._name = "an unnamed client"
        self._disables_when_lost = False
        self._in_order = asyncio.Lock()
        self._requests: dict[asyncio.Task[None], jsonrpc.RequestId] = {}
        self._unread_since: float | None = None
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)

    async def serve(self, reader: asyncio.StreamReader) -> None:
        """Answer requests until the client disconnects, which ends all that it requested."""
        try:
            while line := await _read_line(reader):
                self._receive(line)
            if line is None:
                if self._requests:
                    await asyncio.wait(self._requests)
                message = f"the request is a line longer than {jsonrpc.LINE_LIMIT} bytes: the connection is closed"
                self._send(jsonrpc.failure(None, RtcpError("invalid", message), jsonrpc.INVALID_REQUEST))
                await _discard(reader)
        finally:
            for task in self._requests:
                task.cancel()
            await asyncio.gather(*self._requests, return_exceptions=True)
            await self._methods.end_connection(self._number)
            if self._disables_when_lost and self._methods.channel.observer.holder() in ("", self._name):
                with contextlib.suppress(RtcpError):
                    await self._methods.machine.disable(Caller(self._name, self._number))

    def _receive(self, line: bytes) -> None:
        try:
            number, method, params, is_notification = jsonrpc.read_request(line)
            if is_notification:
                return self._notified(method, params)
            if method not in self._methods.table:
                allowed = ", ".join(self._methods.table)
                message = f'method: found the text "{method}", allowed is one of {allowed}'
                raise jsonrpc.InvalidMessage(jsonrpc.METHOD_NOT_FOUND, message, number)
        except jsonrpc.InvalidMessage as error:
            return self._send(jsonrpc.failure(error.request, RtcpError("invalid", str(error)), error.code))
        if len(self._requests) >= _MOST_PENDING:
            many = RtcpError("refused", f"{_MOST_PENDING} requests of this connection wait already")
            return self._send(jsonrpc.failure(number, many))
        task = asyncio.create_task(self._answer(number, method, params))
        self._requests[task] = number
        task.add_done_callback(self._requests.pop)
        return None

    def _notified(self, method: str, params: Json) -> None:
        if method == "identify":
            self._name = str(params.get("name") or self._name).encode(errors="replace").decode()
            self._disables_when_lost = params.get("disable_when_lost") is True
        elif method == "cancel":
            for task, number in self._requests.items():
                if number is not None and number == params.get("request"):
                    task.cancel()
        else:
            message = "id: it is missing; only identify and cancel are notifications"
            raise jsonrpc.InvalidMessage(jsonrpc.INVALID_REQUEST, message)

    async def _answer(self, number: jsonrpc.RequestId, method: str, params: Json) -> None:
        caller = Caller(self._name, self._number, lambda progress: self._report(number, progress), self._is_stalled)
        at_once = self._methods.table[method].at_once or params.get("replace") is True
        try:
            async with contextlib.AsyncExitStack() as stack:
                if not at_once:
                    await stack.enter_async_context(self._in_order)
                answer = {"id": number, "result": await self._methods.call(method, caller, params)}
        except RtcpError as error:
            answer = jsonrpc.failure(number, error)
        except asyncio.CancelledError:
            answer = jsonrpc.failure(number, RtcpError("refused", f"{method} was cancelled"))
        except BlackboardError as error:
            answer = jsonrpc.failure(number, RtcpError("fault", str(error)))
        except Exception as error:
            # A defect met by one request is answered and logged; the others are still served.
            log.exception("request %.200r", {"method": method, "params": params})
            message = f"the gateway met a defect: {type(error).__name__} {error}"
            answer = jsonrpc.failure(number, RtcpError("internal", message))
        self._send(answer)
        with contextlib.suppress(ConnectionError):
            await self._writer.drain()
        self._answered()

    def _send(self, message: Json) -> None:
        self._writer.write(jsonrpc.answer(message))

    def _report(self, number: jsonrpc.RequestId, progress: Json) -> None:
        if self._unread() == 0:
            self._unread_since = None
        elif self._unread_since is None:
            self._unread_since = time.monotonic()
        if self._unread() < _MOST_UNREAD:
            self._send({"method": "progress", "params": {"request": number, **progress}})

    def _unread(self) -> int:
        """Return the number of bytes that the client has not read."""
        return self._writer.transport.get_write_buffer_size()

    def _is_stalled(self, seconds: float) -> bool:
        since = self._unread_since
        return since is not None and self._unread() > 0 and time.monotonic() - since > seconds


async def _read_line(reader: asyncio.StreamReader) -> bytes | None:
    """Return the next line; empty: the client has disconnected; None: the line is beyond the limit."""
    try:
        return await reader.readline()
    except ConnectionError:
        return b""
    except ValueError:
        return None


async def _discard(reader: asyncio.StreamReader) -> None:
    """Read the rest of a client's request, for a limited time: it reads its answer only after sending all."""

    async def rest() -> None:
        while await reader.read(jsonrpc.LINE_LIMIT):
            pass

    with contextlib.suppress(asyncio.TimeoutError, ConnectionError):
        await asyncio.wait_for(rest(), _LINGER_S)


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
        load_messages()  # before the kinds of fault are collected
        self._snapshot = StatusSnapshot(self._observer, session, started)
        self._snapshot.follow()  # messages that an earlier gateway logged are not logged again
        self._box = BlackBox(self._observer, session, faults_directory(), self._snapshot.note)
        self._methods = Methods(self._observer, self._snapshot, session, directory, self._end_platform)
        self._recording = session.config.recording
        self._ros, self._ros_server = session.config.ros, RosServer(directory)
        self._logged: dict[str, float] = {}
        """Time of the last log line, s, by name of the failed step."""
        self._connections = 0
        self._ended = asyncio.Event()
        self._stopping = False
        self._following: asyncio.Task[None] | None = None

    async def serve(self, ready: Callable[[], None]) -> None:
        """Serve until the platform is stopped or SIGTERM comes; call `ready` when the socket listens."""
        path = control_socket(self._directory)
        path.unlink(missing_ok=True)
        before = os.umask(0o177)
        try:
            server = await asyncio.start_unix_server(self._serve_client, path, limit=jsonrpc.LINE_LIMIT)
        finally:
            os.umask(before)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._ended.set)
        self._watch_loop(loop)
        channel = asyncio.create_task(self._methods.channel.follow())
        self._following = asyncio.create_task(self._follow())
        joystick = self._methods.joystick_override
        # An earlier gateway may have died with inputs forced.
        await joystick.release()
        watching = asyncio.create_task(joystick.watch())
        recording = asyncio.create_task(self._record())
        ready()
        if self._ros is not None:
            await self._ros_server.start_once(self._ros.simple_message, self._observer.loop_pid)
        await self._ended.wait()
        # Does not wait for connected clients (`status --watch`): their connections close.
        server.close()
        watching.cancel()
        if self._snapshot.loop_lives and not self._stopping:
            await joystick.release()
        self._following.cancel()
        channel.cancel()
        recording.cancel()
        path.unlink(missing_ok=True)
        await asyncio.to_thread(self._box.finish)

    async def _record(self) -> None:
        """Start the recording of the arm's file; the platform runs on if it cannot start."""
        if self._recording is None:
            return
        try:
            await self._methods.recordings.start_once(self._recording)
        except RtcpError as error:
            message = f"the recording of the arm's file (recording) does not run: {error}"
            log.error("%s", message)
            self._snapshot.note(message)

    async def _serve_client(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections += 1
        connection = _Connection(self._connections, writer, self._methods, self._after_answer)
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            await connection.serve(reader)
        with contextlib.suppress(ConnectionError):
            writer.close()

    def _after_answer(self) -> None:
        if self._stopping:
            self._ended.set()

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
        self._snapshot.loop_lives = False
        self._box.loop_has_ended()

    async def _follow(self) -> None:
        while True:
            self._try("the status snapshot", self._log_messages)
            self._try("the black box", self._box.poll)
            await asyncio.sleep(_FOLLOW_S)

    def _log_messages(self) -> None:
        for message in self._snapshot.follow():
            log.info("%s", message)

    def _try(self, name: str, step: Callable[[], None]) -> None:
        """Run a step; log a defect in it at most every `_REPEAT_LOG_S`: other steps and later runs go on."""
        try:
            step()
        except Exception:
            now = time.monotonic()
            if now - self._logged.get(name, -_REPEAT_LOG_S) >= _REPEAT_LOG_S:
                self._logged[name] = now
                log.exception("%s cannot follow the loop; it is tried again", name)

    async def _end_platform(self) -> list[str]:
        """End all processes but this one, which ends after its answer; return the problems with that."""
        processes = read_processes(self._directory)
        was_running = is_running(processes.loop)
        if processes.loop and not was_running:
            # It died before the request, which arrived before the notification of its end.
            self._loop_has_ended()
        self._box.end_is_wanted()
        stop_marker(self._directory).touch(mode=0o600)
        if self._snapshot.loop_lives:
            with contextlib.suppress(BlackboardError):
                await self._methods.machine.end_loop()
            # Blocking waits run in threads, so that this process goes on answering `status`.
            if not await asyncio.to_thread(wait_for_exit, processes.loop, 6.0):
                await asyncio.to_thread(terminate, processes.loop, 4.0)
        await self._ros_server.finish()
        await self._methods.recordings.finish()
        await asyncio.to_thread(terminate, processes.segment, 3.0)
        if self._following is not None:
            self._following.cancel()
        await asyncio.to_thread(self._box.finish)
        blackboard_file(self._directory).unlink(missing_ok=True)
        processes_file(self._directory).unlink(missing_ok=True)
        self._stopping = True
        return list(exit_problems(self._directory, processes.loop, was_running))


def main() -> int:
    """Run the gateway's process."""
    directory, ready_fd = launch_arguments("rtcp.gateway.server")
    to_stderr = logging.StreamHandler(sys.stderr)
    to_stderr.setFormatter(log_format())
    logging.basicConfig(level=logging.INFO, handlers=[to_stderr])

    def ready() -> None:
        with contextlib.suppress(OSError):
            os.write(ready_fd, json.dumps({"event": "ready", "pid": os.getpid()}).encode() + b"\n")
            os.close(ready_fd)

    try:
        asyncio.run(_run(directory, ready))
    except (BlackboardError, SessionError, OSError, TypeError) as error:
        sys.stderr.write(f"gateway: {error}\n")
        return 1
    return 0


async def _run(directory: Path, ready: Callable[[], None]) -> None:
    await Gateway(directory).serve(ready)
    # asyncio closes its signal pipe before it removes its handlers: a signal in between would leave a traceback in the
    # log.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(main())
