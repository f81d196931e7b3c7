"""The gateway's process: JSON-RPC on the control socket, status and black box.

A thread reads and writes the sockets, the main thread carries the requests out: a stop reaches the loop before the
requests that wait.

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
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rtcp.config.find import load_messages
from rtcp.gateway.black_box import BlackBox
from rtcp.gateway.command_channel import Caller, Json
from rtcp.gateway.methods import Methods
from rtcp.gateway.ros_server import RosServer
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc import jsonrpc
from rtcp.ipc.commands import Shutdown
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
from rtcp.realtime.scheduling import share_interpreter_quickly

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
_NO_STOPS: Mapping[int, int] = {}
_MOST_BACKLOG = 1 << 24
"""Most bytes of lines of one client that wait to be read; beyond, its socket is not read, not even for its stops."""
log = logging.getLogger("rtcp.gateway")


class _Socket(asyncio.Protocol):
    """A client's end of the control socket, in the thread of the sockets: its lines in, its answers out.

    A stop is requested as soon as its line is whole, however many requests wait in the gateway.
    """

    def __init__(self, gateway: Gateway, connection: _Connection) -> None:
        self._gateway = gateway
        self._connection = connection
        self._rest = bytearray()
        self._is_too_long = False
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin to serve the client."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = self._connection.transport = transport
        transport.set_write_buffer_limits(0)
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        self._gateway.connected(self._transport)

    def data_received(self, data: bytes) -> None:
        """Request the stops among the lines that are whole now; pass all lines on."""
        if self._is_too_long:
            return
        received_ns, end = time.monotonic_ns(), data.rfind(b"\n") + 1
        whole = bytes(self._rest) + data[:end] if end else b""
        self._rest = bytearray(data[end:]) if end else self._rest + data
        self._is_too_long = len(self._rest) > jsonrpc.LINE_LIMIT
        connection = self._connection
        connection.backlog += len(whole)
        if connection.backlog > _MOST_BACKLOG:
            self._transport.pause_reading()
        self._gateway.in_main(
            connection.receive, whole, received_ns, self._gateway.request_stops(whole), self._is_too_long
        )

    def pause_writing(self) -> None:
        """Note that the client does not read."""
        self._connection.unread_since = time.monotonic()

    def resume_writing(self) -> None:
        """Note that the client has read all."""
        self._connection.unread_since = None

    def connection_lost(self, error: Exception | None) -> None:
        """End all that the client requested."""
        self._gateway.disconnected(self._transport)
        self._gateway.in_main(self._connection.end)


class _Connection:
    """One client: its requests are carried out in order, except for methods marked `at_once`."""

    def __init__(self, number: int, gateway: Gateway, methods: Methods) -> None:
        self._number = number
        self._gateway = gateway
        self._methods = methods
        self._name = "an unnamed client"
        self._disables_when_lost = False
        self._in_order = asyncio.Lock()
        self._requests: dict[asyncio.Task[None], jsonrpc.RequestId] = {}
        self._lines: deque[tuple[bytes, int]] = deque()
        self._is_too_long = False
        self._reading: asyncio.Task[None] | None = None
        self.transport: asyncio.Transport
        """Of the thread of the sockets."""
        self.backlog = 0
        """Bytes of the lines that wait. Only the thread of the sockets counts them."""
        self.unread_since: float | None = None
        """Since when the client has not read all of its answers, s."""

    def receive(self, whole: bytes, received_ns: int, stops: Mapping[int, int], is_too_long: bool) -> None:
        """Take whole lines.

        Args:
            whole: the lines, each with its end.
            received_ns: when they were received.
            stops: instant of the stop by the index of its line.
            is_too_long: whether the line after them is longer than any request.
        """
        lines = whole.split(b"\n")[:-1]
        self._lines += [(line, stops.get(index, received_ns)) for index, line in enumerate(lines)]
        self._is_too_long = is_too_long
        if self._reading is None or self._reading.done():
            self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        read = 0
        while self._lines:
            line, received_ns = self._lines.popleft()
            read += len(line) + 1
            if len(line) > jsonrpc.LINE_LIMIT:
                self._is_too_long = True
                self._lines.clear()
                break
            self._receive(line, received_ns)
            # The requests of other connections have their turn.
            await asyncio.sleep(0)
        self._gateway.in_sockets(self._read_on, read)
        if self._is_too_long:
            if self._requests:
                await asyncio.wait(self._requests)
            message = f"the request is a line longer than {jsonrpc.LINE_LIMIT} bytes: the connection is closed"
            self._send(jsonrpc.failure(None, RtcpError("invalid", message), jsonrpc.INVALID_REQUEST))
            # The client reads its answer only after it has sent all.
            await asyncio.sleep(_LINGER_S)
            self._gateway.in_sockets(self.transport.close)

    def _read_on(self, read: int) -> None:
        self.backlog -= read
        self.transport.resume_reading()

    def end(self) -> None:
        """End all that the client requested: it has disconnected."""
        self._gateway.keep(asyncio.create_task(self._end()))

    async def _end(self) -> None:
        self._lines.clear()
        for task in (*self._requests, *([self._reading] if self._reading else [])):
            task.cancel()
        await asyncio.gather(*self._requests, return_exceptions=True)
        await self._methods.end_connection(self._number)
        if self._disables_when_lost and self._methods.channel.observer.holder() in ("", self._name):
            with contextlib.suppress(RtcpError):
                await self._methods.machine.disable(Caller(self._name, self._number))

    def _receive(self, line: bytes, received_ns: int) -> None:
        try:
            request = jsonrpc.read_request(line)
            number, method, params = request.id, request.method, request.params
            if request.is_notification:
                return self._notified(method, params)
            if method not in self._methods.table:
                allowed = ", ".join(self._methods.table)
                message = f'method: found the text "{method}", allowed is one of {allowed}'
                raise jsonrpc.InvalidMessage(jsonrpc.METHOD_NOT_FOUND, message, number)
        except jsonrpc.InvalidMessage as error:
            return self._send(jsonrpc.failure(error.request, RtcpError("invalid", str(error)), error.code))
        is_stop = self._methods.table[method].stops is not None
        if request.requested_ns and not is_stop:
            # A long line arrives after a stop that its client has requested later.
            received_ns = min(received_ns, request.requested_ns)
        if len(self._requests) >= _MOST_PENDING:
            many = f"{_MOST_PENDING} requests of this connection wait already"
            if is_stop:
                many += "; the stop was sent to the loop, and its end is not waited for"
            return self._send(jsonrpc.failure(number, RtcpError("refused", many)))
        task = asyncio.create_task(self._answer(number, method, params, received_ns))
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

    async def _answer(self, number: jsonrpc.RequestId, method: str, params: Json, received_ns: int) -> None:
        caller = Caller(
            self._name, self._number, lambda progress: self._report(number, progress), self._is_stalled, received_ns
        )
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
        self._gateway.answered()

    def _send(self, message: Json) -> None:
        self._gateway.in_sockets(self._write, jsonrpc.answer(message))

    def _write(self, data: bytes) -> None:
        if not self.transport.is_closing():
            self.transport.write(data)

    def _report(self, number: jsonrpc.RequestId, progress: Json) -> None:
        data = jsonrpc.answer({"method": "progress", "params": {"request": number, **progress}})
        self._gateway.in_sockets(self._write_report, data)

    def _write_report(self, data: bytes) -> None:
        if self.transport.get_write_buffer_size() < _MOST_UNREAD:
            self._write(data)

    def _is_stalled(self, seconds: float) -> bool:
        since = self.unread_since
        return since is not None and time.monotonic() - since > seconds


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
        self._transports: set[asyncio.Transport] = set()
        self._sockets = asyncio.new_event_loop()
        """Event loop of the thread of the sockets."""
        self._main: asyncio.AbstractEventLoop
        self._stops = {
            json.dumps(method.name).encode(): method.stops for method in self._methods.table.values() if method.stops
        }
        self._endings: set[asyncio.Task[None]] = set()
        """Ends of connections that are under way."""
        self._ended = asyncio.Event()
        self._stopping = False
        self._following: asyncio.Task[None] | None = None

    async def serve(self, ready: Callable[[], None]) -> None:
        """Serve until the platform is stopped or SIGTERM comes; call `ready` when the socket listens."""
        path = control_socket(self._directory)
        path.unlink(missing_ok=True)
        loop = self._main = asyncio.get_running_loop()
        # A thread that waits for the interpreter gets it within 50 us: a stop does not wait for the requests.
        share_interpreter_quickly()
        thread = threading.Thread(target=self._sockets.run_forever, name="sockets", daemon=True)
        thread.start()
        before = os.umask(0o177)
        try:
            listening = self._sockets.create_unix_server(self._connect, path)
            server = await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(listening, self._sockets))
        finally:
            os.umask(before)
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
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(self._close_sockets(server), self._sockets))
        self._sockets.call_soon_threadsafe(self._sockets.stop)
        await asyncio.to_thread(thread.join)
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

    # -- the thread of the sockets ------------------------------------------------------------------------------------

    def _connect(self) -> _Socket:
        self._connections += 1
        return _Socket(self, _Connection(self._connections, self, self._methods))

    async def _close_sockets(self, server: asyncio.Server) -> None:
        server.close()
        for transport in self._transports:
            transport.close()
        await asyncio.sleep(0)

    def connected(self, transport: asyncio.Transport) -> None:
        """Note a connection."""
        self._transports.add(transport)

    def disconnected(self, transport: asyncio.Transport) -> None:
        """Forget a connection."""
        self._transports.discard(transport)

    def request_stops(self, whole: bytes) -> Mapping[int, int]:
        """Request the stops among whole lines; return the instant of each, ns, by the index of its line."""
        if not any(name in whole for name in self._stops):
            return _NO_STOPS
        lines = enumerate(whole.split(b"\n"))
        return {index: instant for index, line in lines if (instant := self._request_stop(line))}

    def _request_stop(self, line: bytes) -> int:
        with contextlib.suppress(jsonrpc.InvalidMessage):
            request = jsonrpc.read_request(line)
            kind = self._stops.get(json.dumps(request.method).encode())
            if kind is Shutdown:
                with contextlib.suppress(OSError):  # the method reports it; the stop comes first
                    self._expect_end()
            if kind is not None:
                requested_ns = request.params.get("requested_ns")
                return self._observer.stop(kind, requested_ns if type(requested_ns) is int else 0)
        return 0

    def in_main(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function in the main thread."""
        with contextlib.suppress(RuntimeError):  # its event loop has ended
            self._main.call_soon_threadsafe(function, *arguments)

    def in_sockets(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function in the thread of the sockets."""
        with contextlib.suppress(RuntimeError):
            self._sockets.call_soon_threadsafe(function, *arguments)

    # -- the main thread ----------------------------------------------------------------------------------------------

    def keep(self, ending: asyncio.Task[None]) -> None:
        """Keep the task that ends a connection until it is done."""
        self._endings.add(ending)
        ending.add_done_callback(self._endings.discard)

    def answered(self) -> None:
        """End after the answer to the request that has ended the platform."""
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

    def _expect_end(self) -> None:
        """Note that the end of the loop is wanted, before the loop ends."""
        self._box.end_is_wanted()
        stop_marker(self._directory).touch(mode=0o600)

    async def _end_platform(self) -> list[str]:
        """End all processes but this one, which ends after its answer; return the problems with that."""
        processes = read_processes(self._directory)
        was_running = is_running(processes.loop)
        if processes.loop and not was_running:
            # It died before the request, which arrived before the notification of its end.
            self._loop_has_ended()
        self._expect_end()
        if self._snapshot.loop_lives:
            self._methods.machine.end_loop()
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
