"""A robot, commanded from asyncio: the methods of `Robot`, each awaited; several may be under way at once."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Future
from pathlib import Path
from typing import Any, TypeVar

from rtcp.api.results import Pose, Positions, Progress, result
from rtcp.api.robot import Call, Methods, Robot
from rtcp.ipc import jsonrpc
from rtcp.ipc.client import ANSWER_TIMEOUT_S, client_name, connection_error
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.runtime_directory import control_socket, runtime_directory
from rtcp.ipc.states import State
from rtcp.ipc.stops import StopWriter

T = TypeVar("T")
_REPLY_LIMIT = 1 << 24
"""Largest reply, bytes."""


class AsyncRobot(Methods):
    """A connection to the running platform: `async with rtcp.connect_async() as robot: await robot.enable()`.

    A call that is cancelled ends its motion. Motions of one connection wait for each other; `halt`, `disable`, `status`
    and `events` do not wait. Leaving the block stops its motions.

    Args:
        name: of this commander, shown to others that are refused; empty: this process.
        path: the control socket; None: that of the runtime directory.
        disable_when_lost: disable the drives after the stop where the connection ends without `close`, as at the
            end of this process, unless another client commands the arm.
    """

    def __init__(self, name: str = "", path: Path | None = None, disable_when_lost: bool = False) -> None:
        self._identity = {"name": client_name(name), "disable_when_lost": disable_when_lost}
        self._path = control_socket(runtime_directory()) if path is None else path
        self._numbers = itertools.count(1)
        self._pending: dict[int, _Pending] = {}
        self._writer: asyncio.StreamWriter | None = None
        self._failure: OSError | None = None
        """Why there is no connection."""
        self._receiving: asyncio.Task[None] | None = None
        self._stops: StopWriter | None = None

    async def __aenter__(self) -> AsyncRobot:
        """Connect. Where only the gateway is missing, every call raises NotRunning, but a stop reaches the loop first.

        Raises:
            NotRunning: nobody listens, and no loop could take a stop.
            Refused: the socket is another user's.
        """
        self._stops = StopWriter(self._path.parent)
        try:
            reader, self._writer = await asyncio.open_unix_connection(self._path, limit=_REPLY_LIMIT)
        except OSError as error:
            if not self._stops.is_open:
                raise connection_error(self._path, error) from error
            self._failure = error
            return self
        self._writer.write(jsonrpc.line({"method": "identify", "params": self._identity}))
        self._receiving = asyncio.create_task(self._receive(reader))
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection; a second time is harmless."""
        if self._receiving is not None:
            self._receiving.cancel()
        if self._stops is not None:
            self._stops.close()
        if self._writer is not None:
            if not self._writer.is_closing():
                identity = {**self._identity, "disable_when_lost": False}
                self._writer.write(jsonrpc.line({"method": "identify", "params": identity}))
            self._writer.close()
            with contextlib.suppress(ConnectionError):
                await self._writer.wait_closed()

    @property
    def is_open(self) -> bool:
        """Whether the connection is open."""
        return self._writer is not None and not self._writer.is_closing()

    async def state(self) -> State:
        """Return the state of the machine now."""
        return (await self.status()).state

    async def positions(self) -> Positions:
        """Return the measured joint positions now, rad."""
        return (await self.status()).positions

    async def pose(self) -> Pose | None:
        """Return the measured pose of the tool now, x y z, m, rx ry rz, rad; None: the geometry is unknown."""
        return (await self.status()).pose

    async def speed_override(self) -> float:
        """Return the fraction of its speed at which the arm moves."""
        return (await self.status()).speed_override

    async def in_thread(self, function: Callable[[Robot], T]) -> T:
        """Call a function of a `Robot` in a thread, over this connection, and return what it returns.

        Cancelled, it ends the call that is under way, and with that its motion; the next one raises ConnectionLost.

        Args:
            function: as `lambda robot: rtcp.Program(file).run(robot)`.
        """
        robot = _InThread(self, asyncio.get_running_loop())
        try:
            return await asyncio.to_thread(function, robot)
        finally:
            robot.close()

    async def _carry_out(self, call: Call[T]) -> T:
        stops = self._stops or StopWriter(self._path.parent)
        with stops.requested(call.method, call.params) as params:
            return await self._answered(call, params)

    async def _answered(self, call: Call[T], params: Mapping[str, Any]) -> T:
        writer, number = self._writer, next(self._numbers)
        if self._failure is not None:
            raise connection_error(self._path, self._failure)
        if writer is None or writer.is_closing():
            raise RtcpError("lost", f"the connection is closed: {call.method!r} was not sent")
        pending = self._pending[number] = _Pending(call)
        try:
            writer.write(jsonrpc.request(number, call.method, params))
            return call.result(jsonrpc.result(await pending.reply(), call.method))
        except BaseException:
            if pending.is_open:
                # Cancelled, without an answer in time, or its callback failed: the arm does not move on unattended.
                writer.write(jsonrpc.line({"method": "cancel", "params": {"request": number}}))
            raise
        finally:
            del self._pending[number]

    async def _receive(self, reader: asyncio.StreamReader) -> None:
        try:
            with contextlib.suppress(ConnectionError):
                while line := await reader.readline():
                    reply = jsonrpc.read_reply(line, "a request")
                    progress = jsonrpc.progress(reply)
                    pending = self._pending.get(progress["request"] if progress else reply.get("id"))  # type: ignore[arg-type]
                    if pending is not None:
                        pending.receive(progress, reply)
        finally:
            # Any end of the reader closes the connection too, and with it ends its motions.
            for pending in self._pending.values():
                pending.lose()
            if self._writer is not None:
                self._writer.close()


class _InThread(Robot):
    """The connection of an `AsyncRobot`, for calls from another thread."""

    def __init__(self, robot: AsyncRobot, loop: asyncio.AbstractEventLoop) -> None:
        self._robot = robot
        self.directory = robot._path.parent
        self._loop = loop
        self._ended = False
        self._under_way: Future[Any] | None = None

    def close(self) -> None:
        self._ended = True
        if self._under_way is not None:
            self._under_way.cancel()

    def _carry_out(self, call: Call[T]) -> T:
        async def carry_out() -> T:
            if self._ended:  # by the same thread, which this runs in
                raise CancelledError
            return await self._robot._carry_out(call)

        self._under_way = pending = asyncio.run_coroutine_threadsafe(carry_out(), self._loop)
        try:
            return pending.result()
        except CancelledError:
            raise RtcpError("lost", f"{call.method!r} was cancelled") from None


class _Pending:
    """A request that is not answered yet."""

    def __init__(self, call: Call[Any]) -> None:
        self._call = call
        self._has_progress = False
        self.answer: asyncio.Future[Mapping[str, Any]] = asyncio.get_running_loop().create_future()
        # A cancelled call never retrieves the error: without this asyncio logs it.
        self.answer.add_done_callback(lambda answer: answer.cancelled() or answer.exception())
        self.is_open = True
        """The answer may still come."""

    async def reply(self) -> Mapping[str, Any]:
        """Return the answer; raises TimedOut after one to two `ANSWER_TIMEOUT_S` without answer or progress."""
        while not self.answer.done():
            self._has_progress = False
            # Not `wait_for`: it takes an answer that comes with a cancellation, and loses the cancellation.
            await asyncio.wait([self.answer], timeout=ANSWER_TIMEOUT_S)
            if not self.answer.done() and not self._has_progress:
                message = f"the platform has not answered {self._call.method!r} for {ANSWER_TIMEOUT_S:g} s"
                raise RtcpError("timeout", message)
        return self.answer.result()

    def receive(self, progress: Mapping[str, Any] | None, reply: Mapping[str, Any]) -> None:
        """Pass progress on, or keep the answer."""
        self._has_progress = True
        self.is_open = progress is not None
        if self.answer.done():
            return
        if progress is None:
            self.answer.set_result(reply)
        elif self._call.progress is not None:
            try:
                self._call.progress(result(Progress, progress))
            except Exception as error:  # a callback's own: it ends its request, not the connection
                self.answer.set_exception(error)

    def lose(self) -> None:
        """The connection has ended before the answer."""
        self.is_open = False
        if not self.answer.done():
            message = f"the platform closed the connection before it answered {self._call.method!r}"
            self.answer.set_exception(RtcpError("lost", message))


def connect_async(name: str = "", path: Path | None = None, disable_when_lost: bool = False) -> AsyncRobot:
    """Return a robot that connects when its `async with` block begins; arguments as of `AsyncRobot`."""
    return AsyncRobot(name, path, disable_when_lost)
