"""Commands to the loop: lease, ring, answer, outcome. One task reads the blackboard for all waiting requests."""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from rtcp.config.model import ArmConfig
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc.commands import Command, ExtendTrajectory, MotionCommand, OpenStream
from rtcp.ipc.errors import ErrorKind, RtcpError
from rtcp.ipc.events import Event, LeaseExpired, MotionEnded, PermissionWithdrawn
from rtcp.ipc.observer import Answer, BlackboardError, EventRecord, LeaseRefused, Observer
from rtcp.ipc.refusals import Refusal
from rtcp.ipc.schema import FLAG_SWITCHING
from rtcp.ipc.states import ControlMode, State
from rtcp.ipc.stops import STOPS

T = TypeVar("T")
Json = dict[str, Any]

IN_MOTION = frozenset({State.MOVING, State.STOPPING})
"""States that a motion passes through."""
_POLL_S = 0.002
"""Longest interval of reading the blackboard while a request waits, s."""
_ANSWER_S = 2.0
"""Time for the loop to accept or refuse a command, s."""
_PROGRESS_S = 0.1
"""Longest interval between two progress reports, and between two renewals of the lease, s."""
_REST_S = 10.0
"""Time for the arm to come to rest after its commander has released the lease, s."""
BROKEN = frozenset({State.FAULT, State.EMERGENCY_STOP})


@dataclass(frozen=True)
class Caller:
    """The client of a request: its name, its connection, and the function that reports progress to it."""

    name: str
    connection: int
    report: Callable[[Json], None] = lambda progress: None
    is_stalled: Callable[[float], bool] = lambda seconds: False
    """Return whether the client has read no message for this time, s."""
    received_ns: int = field(default_factory=lambda: time.monotonic_ns())  # noqa: PLW0108 a clock that tests replace
    """When the request was received, CLOCK_MONOTONIC, ns; of a stop: the instant of the stop."""

    @property
    def without_lease(self) -> Lease:
        """A lease of nobody, for commands that need none."""
        return Lease.of(0, self)


class _Waiter(Generic[T]):
    def __init__(
        self,
        poll: Callable[[], T | None],
        timeout_s: float,
        timed_out: Callable[[], RtcpError],
        interval_s: float,
        pace: Callable[[], float],
    ) -> None:
        self.interval_s = interval_s
        self._poll = poll
        self._left_s, self._before = timeout_s, time.monotonic()
        self._timed_out = timed_out
        self._pace = pace
        self.outcome: asyncio.Future[T] = asyncio.get_running_loop().create_future()

    def update(self) -> None:
        """Poll once; a result or an error ends the wait."""
        if self.outcome.done():
            return
        try:
            result = self._poll()
            now = time.monotonic()
            self._left_s -= self._pace() * (now - self._before)
            self._before = now
            if result is None and self._left_s < 0.0:
                raise self._timed_out()
        except Exception as error:
            self.outcome.set_exception(error)
        else:
            if result is not None:
                self.outcome.set_result(result)


class Lease(int):
    """The id of a lease, as held by one request."""

    request: int | None
    """Number of the request; one that is older than another motion cannot begin a motion. None: it is not planned."""
    received_ns: int
    """When the request was received: a stop that was requested later supersedes its commands."""

    @classmethod
    def of(cls, lease: int, caller: Caller, request: int | None = None) -> Lease:
        """Return a lease as held by a request of `caller`."""
        made = cls(lease)
        made.request, made.received_ns = request, caller.received_ns
        return made


class CommandChannel:
    """Sends commands to the loop and waits for their outcomes, on behalf of all methods.

    `follow` must run as a task. All methods raise RtcpError.

    Args:
        observer: the blackboard.
        snapshot: whether the loop lives, and why it is in fault.
        config: the arm.
    """

    def __init__(self, observer: Observer, snapshot: StatusSnapshot, config: ArmConfig) -> None:
        self.observer = observer
        self.snapshot = snapshot
        self.config = config
        self.names = snapshot.names
        self._ring = asyncio.Lock()
        self._answer_poll_s = min(0.2e-6 * config.cycle.period_us, _POLL_S)
        self._requests = self._barrier = 0
        """Number of the last request, and of the last that a newer motion has superseded."""
        self._shared: dict[int, tuple[int, int]] = {}
        """Lease, and number of calls that hold it, by connection."""
        self._waiters: list[_Waiter[Any]] = []
        self._has_waiters = asyncio.Event()
        self._sleeper = ThreadPoolExecutor(1, "follow")

    # -- the latest record --------------------------------------------------------------------------------------------

    def record(self) -> Any:
        """Return the latest cycle record, a numpy record."""
        latest = self.observer.latest()
        if latest is None:
            raise RtcpError("fault", "the loop has published no cycle")
        return latest[0]

    @property
    def state(self) -> State:
        """State of the machine in the latest record."""
        return State(int(self.record()["state"]))

    @property
    def control_mode(self) -> ControlMode | None:
        """Control mode in the latest record."""
        number = int(self.record()["control_mode"])
        return ControlMode(number) if number in tuple(ControlMode) else None

    def speed_override(self) -> float:
        """Return the speed override in the latest record."""
        return float(self.record()["speed_override"])

    def tool(self) -> int:
        """Return the number of the tool in the latest record."""
        return int(self.record()["tool"])

    def joints(self, name: str) -> list[float]:
        """Return a field of the latest record, one number a joint."""
        return [float(value) for value in self.record()[name][: len(self.config.joints)]]

    def progress(self) -> Json:
        """Return the parameters of a progress report."""
        record = self.record()
        moving = int(record["state"]) in IN_MOTION
        elapsed, duration = float(record["elapsed_s"]), float(record["duration_s"])
        return {
            "state": State(int(record["state"])).name.lower(),
            "fraction": min(elapsed / duration, 1.0) if moving and duration > 0 else 0.0,
            "remaining_s": max(duration - elapsed, 0.0) if moving else 0.0,
            "positions": self.joints("actual_position"),
        }

    def remaining_s(self) -> float:
        """Return the remaining time of the motion under way, s."""
        record = self.record()
        return float(record["duration_s"]) - float(record["elapsed_s"])

    def check_loop(self) -> None:
        """Raise RtcpError if the loop has ended."""
        if not self.snapshot.loop_lives:
            raise RtcpError("fault", f"the loop (process {self.observer.loop_pid}) has ended")

    # -- the lease ----------------------------------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def lease(self, caller: Caller) -> AsyncIterator[Lease]:
        """Hold the lease, renewed, until the block ends; report progress meanwhile.

        A motion that replaces another of its connection shares its lease. The lease of a caller that does not read its
        reports is not renewed: such a client is stopped (SIGSTOP) or hangs.
        """
        lease, users = self._shared.get(caller.connection, (0, 0))
        if not users:
            lease = self.acquire(caller)
        self._shared[caller.connection] = lease, users + 1
        renewing = asyncio.create_task(self._renew(lease, caller))
        self._requests += 1
        try:
            yield Lease.of(lease, caller, self._requests)
        finally:
            renewing.cancel()
            _, users = self._shared.pop(caller.connection)
            if users > 1:
                self._shared[caller.connection] = lease, users - 1
            else:
                self.observer.release(lease)

    def lease_of(self, connection: int) -> int:
        """Return the lease that requests of a connection hold; 0: none."""
        return self._shared.get(connection, (0, 0))[0]

    def lease_in_use(self) -> int:
        """Return the lease that a request holds; 0: none."""
        return next((lease for lease, _ in self._shared.values()), 0)

    def is_shared(self, lease: int) -> bool:
        """Whether several requests of a connection hold this lease, so that the end of one does not stop the arm."""
        return any(shared == lease and users > 1 for shared, users in self._shared.values())

    def acquire(self, caller: Caller) -> int:
        """Acquire the lease and return its id; the caller renews and releases it."""
        try:
            return self.observer.acquire(caller.name, self.config.lease_s)
        except LeaseRefused as refused:
            raise RtcpError("refused", str(refused), "lease_held", {"holder": refused.holder}) from None

    async def _renew(self, lease: int, caller: Caller) -> None:
        while not caller.is_stalled(self.config.lease_s) and self.observer.renew(lease):
            caller.report(self.progress())
            await asyncio.sleep(min(_PROGRESS_S, self.config.lease_s / 5))

    # -- commands and their outcome -----------------------------------------------------------------------------------

    async def send(self, lease: int, command: Command) -> None:
        """Send a command; return when it was accepted and a later cycle was published."""
        await self.run(lease, command, lambda: True, _ANSWER_S, command.name)

    async def run(
        self,
        lease: int,
        command: Command,
        outcome: Callable[[], T | None],
        timeout_s: float,
        name: str,
        pace: Callable[[], float] = lambda: 1.0,
    ) -> T:
        """Send a command and wait until `outcome` returns a value.

        Args:
            lease: of the request.
            command: the command.
            outcome: returns the result, or None while there is none; may raise. Its first call is after the cycle that
                accepted the command.
            timeout_s: longest wait, s.
            name: of the command in messages.
            pace: returns the factor on elapsed time that counts against `timeout_s`, as the speed override of a motion.
        """
        head = await self.accept(lease, command)

        def poll() -> T | None:
            self.check_loop()
            return outcome() if self.observer.head > head else None

        def timed_out() -> RtcpError:
            return RtcpError("timeout", f"{name} took longer than {timeout_s:.1f} s: the machine is {self.state.words}")

        return await self.wait(poll, timeout_s, timed_out, pace=pace)

    async def accept(self, lease: int, command: Command) -> int:
        """Send a command; return, when the loop has accepted it, the number of the last record before its effect.

        A stop passes the ring. A motion that was planned while a newer motion was sent is refused, as the loop refuses
        one that was requested before a stop; reason `superseded`.
        """
        received_ns = lease.received_ns if isinstance(lease, Lease) else 0
        if type(command) in STOPS:
            instant_ns = self.observer.stop(type(command), received_ns)
            return await self._answered(lambda: self.observer.stop_answer(type(command), instant_ns), command)
        async with self._ring:
            if isinstance(command, OpenStream):
                self._barrier = self._requests = self._requests + 1
            elif isinstance(lease, Lease) and lease.request is not None and isinstance(command, MotionCommand):
                if lease.request < self._barrier and not isinstance(command, ExtendTrajectory):
                    message = f"{command.name}: another motion came while it was planned: nothing moves"
                    raise RtcpError("refused", message, "superseded")
                self._barrier = max(self._barrier, lease.request)
            try:
                number = self.observer.command(lease, command, received_ns)
            except BlackboardError as error:
                raise RtcpError("fault", str(error)) from None
            except (ValueError, OverflowError, struct.error) as error:
                raise RtcpError("invalid", f"{command.name}: a field cannot be sent: {error}") from None
            return await self._answered(lambda: self.observer.answer(number), command)

    async def _answered(self, answer: Callable[[], Answer | None], command: Command) -> int:
        """Return the number of the last record before the effect of a command, once the loop has accepted it."""
        late = RtcpError("timeout", f"the loop did not answer {command.name} within {_ANSWER_S:g} s")
        return await self.wait(lambda: self._accepted(answer()), _ANSWER_S, lambda: late, self._answer_poll_s)

    def _accepted(self, answer: Answer | None) -> int | None:
        # The answer is written before the record of its cycle.
        self.check_loop()
        if answer is None:
            return None
        if answer.refusal is None:
            return self.observer.head
        fault = self.snapshot.fault if self.state in BROKEN else ""
        raise self.error("refused", answer.refusal, after=f"; the fault: {fault}" if fault else "")

    async def wait(
        self,
        poll: Callable[[], T | None],
        timeout_s: float,
        timed_out: Callable[[], RtcpError],
        interval_s: float = _POLL_S,
        pace: Callable[[], float] = lambda: 1.0,
    ) -> T:
        """Return the value of `poll`, once that is not None; it is called at least every `interval_s` and may raise."""
        waiter = _Waiter(poll, timeout_s, timed_out, interval_s, pace)
        self._waiters.append(waiter)
        self._has_waiters.set()
        try:
            return await waiter.outcome
        finally:
            self._waiters.remove(waiter)

    async def follow(self) -> None:
        """Read the blackboard for all waiting requests; sleep while there are none."""
        while True:
            await self._has_waiters.wait()
            for waiter in list(self._waiters):
                waiter.update()
            interval_s = min((waiter.interval_s for waiter in self._waiters), default=_POLL_S)
            # Not `asyncio.sleep`: epoll's resolution of 1 ms would delay each answer by two cycles.
            await asyncio.get_running_loop().run_in_executor(self._sleeper, time.sleep, interval_s)
            if not self._waiters:
                self._has_waiters.clear()

    def reaching(
        self, wanted: State | frozenset[State], through: frozenset[State], name: str, since: int
    ) -> Callable[[], State | None]:
        """Return an outcome: a state of `wanted`, reached through the states `through` only.

        Args:
            wanted: the state or states; while the drives change their mode they do not count.
            through: states on the way; any other fails.
            name: of the command in messages.
            since: number of the last event before the command.
        """
        ends = frozenset({wanted}) if isinstance(wanted, State) else wanted

        def poll() -> State | None:
            self.check_loop()
            record = self.record()
            state = State(int(record["state"]))
            if state in ends:
                return None if int(record["flags"]) & FLAG_SWITCHING else state
            if state in BROKEN:
                raise self.fault_since(since)
            if state in through:
                return None
            if state is State.STOPPED_BY_LIMIT:
                raise self.ended(self.early_end(since), f"{name} was stopped by a limit")
            raise RtcpError("refused", f"{name} was ended by another command: the machine is {state.words}")

        return poll

    # -- events -------------------------------------------------------------------------------------------------------

    def events(self, since: int) -> list[EventRecord]:
        """Return the events after the number `since`."""
        return self.observer.events_since(since)

    def early_end(self, since: int) -> Event | None:
        """Return the last event after `since` that ends a motion before its goal."""
        events = [record.event for record in self.events(since) if self._ends_early(record.event)]
        return events[-1] if events else None

    def _ends_early(self, event: Event) -> bool:
        ends = isinstance(event, MotionEnded | LeaseExpired | PermissionWithdrawn)
        return ends or type(event) in self.names.faults

    def fault_since(self, since: int) -> RtcpError:
        """Return the error for the last fault after `since`."""
        faults = [record.event for record in self.events(since) if type(record.event) in self.names.faults]
        if faults:
            return self.error("fault", faults[-1])
        return RtcpError("fault", self.snapshot.last_fault or "the machine went into fault: see `rtcp status`")

    def ended(self, event: Event | None, name: str) -> RtcpError:
        """Return the error for a motion that `event` ended."""
        if event is None:
            return RtcpError("fault", f"{name}: see `rtcp status`")
        return self.error("fault", event, before=f"{name}: ")

    def error(self, kind: ErrorKind, about: Refusal | Event, before: str = "", after: str = "") -> RtcpError:
        """Return the error for a refusal or an event."""
        return RtcpError(kind, before + self.names.message(about) + after, about.name, about.as_json())


class StreamingCommands:
    """Sends commands that expire unless another follows; a connection holds one lease for all of a motion.

    The motion of a silent client ends with the hold time of its last command, with its lease or with its connection.

    Args:
        channel: to the loop.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._leases: dict[int, tuple[int, int]] = {}
        """Lease and last event before it, by connection."""
        self._head = 0
        """Number of the last record before the newest command's effect."""

    async def send(self, caller: Caller, command: Command) -> Json:
        """Send a command; return state and positions."""
        channel = self._channel
        lease, since = self._lease(caller)
        try:
            self._head = await channel.accept(Lease.of(lease, caller), command)
        except RtcpError as error:
            ended = channel.early_end(since)
            if ended is not None and channel.state is not State.HOLDING:
                raise channel.ended(ended, "the motion has ended") from error
            raise
        return {"state": channel.state.name.lower(), "positions": channel.joints("actual_position")}

    async def open(self, caller: Caller, motion: int = 0, partners: int = 0) -> Json:
        """Begin a stream of the client; return its number and lease, which the client renews, and the last event."""
        lease, since = self._lease(caller)
        stream = time.monotonic_ns()
        self._head = await self._channel.accept(Lease.of(lease, caller), OpenStream(stream, motion, partners))
        return {"stream": stream, "lease": lease, "since": since}

    async def rest(self, caller: Caller) -> None:
        """End the motion of this connection and wait until the arm rests; called before a command of another kind."""
        if caller.connection in self._leases:
            self.end(caller.connection)
            await self.wait_for_rest()

    async def wait_for_rest(self) -> None:
        """Wait until the arm rests, after its lease was released."""
        channel = self._channel

        def rested() -> bool | None:
            channel.check_loop()
            return (channel.observer.head > self._head and channel.state not in IN_MOTION) or None

        with contextlib.suppress(RtcpError):
            await channel.wait(rested, _REST_S, lambda: RtcpError("timeout", "the arm does not come to rest"))

    def end(self, connection: int) -> None:
        """End the motion of a connection: its lease is released, and the loop stops the arm."""
        lease, _ = self._leases.pop(connection, (0, 0))
        if lease:
            self._channel.observer.release(lease)

    def lease_of(self, connection: int) -> int:
        """Return the lease of a connection's motion; 0: it moves nothing."""
        return self._leases.get(connection, (0, 0))[0]

    def _lease(self, caller: Caller) -> tuple[int, int]:
        lease = self._leases.get(caller.connection)
        if lease is None or not self._channel.observer.renew(lease[0]):
            since = self._channel.observer.last_event
            self._leases[caller.connection] = lease = self._channel.acquire(caller), since
        return lease
