"""Carrying one command to the loop: lease, command ring, answer, and the wait for what was asked."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Any

from rtcp.config.model import ArmConfig
from rtcp.gateway.picture import Picture
from rtcp.ipc.codes import Code
from rtcp.ipc.machine import Command, State
from rtcp.ipc.messages import Sentences
from rtcp.ipc.observer import BlackboardError, Event, LeaseRefused, Observer

Progress = Callable[[dict[str, Any]], Awaitable[None]]
POLL_S = 0.002
MOVING = frozenset({State.MOVING, State.STOPPING})
"""States that a motion goes through."""
_ANSWER_S = 2.0
_PROGRESS_S = 0.1
_BROKEN = (State.FAULT, State.EMERGENCY_STOP)


class CommandFailed(Exception):
    """A request that was not carried out: its kind (refused, fault, timeout, invalid) and a sentence."""

    def __init__(self, kind: str, sentence: str) -> None:
        super().__init__(sentence)
        self.kind = kind


class Carrier:
    """Gives commands to the loop and waits for states, on behalf of all verbs of the control socket.

    Args:
        observer: the blackboard.
        picture: the machine's state and sentences.
        config: the arm.
    """

    def __init__(self, observer: Observer, picture: Picture, config: ArmConfig) -> None:
        self.observer = observer
        self.picture = picture
        self.config = config
        self._sentences = Sentences(config)
        self._ring = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def lease(self, client: str) -> AsyncIterator[int]:
        """Hold the lease for `client`, renewed, until the block is done."""
        lease = self.acquire(client)
        renewing = asyncio.create_task(self._renew(lease))
        try:
            yield lease
        finally:
            renewing.cancel()
            self.observer.release(lease)

    def acquire(self, client: str) -> int:
        """Take the lease for `client` and return its id; it is the caller's to renew and to release."""
        try:
            return self.observer.acquire(client, self.config.lease_s)
        except LeaseRefused as refused:
            raise CommandFailed("refused", str(refused)) from None

    async def _renew(self, lease: int) -> None:
        while self.observer.renew(lease):
            await asyncio.sleep(self.config.lease_s / 5)

    async def give(self, lease: int, command: Command, numbers: Sequence[float] = ()) -> None:
        """Give a command; return when the loop has taken it and a record of a later cycle is there."""
        async with self._ring:
            try:
                number = self.observer.command(lease, command, numbers)
            except BlackboardError as error:
                raise CommandFailed("fault", str(error)) from None
            until = time.monotonic() + _ANSWER_S
            while (answer := self.observer.answer(number)) is None:
                self.check_loop()
                if time.monotonic() > until:
                    raise CommandFailed("timeout", f"the loop did not answer {command.name.lower()} within 2 s")
                await asyncio.sleep(POLL_S)
        await self._see_next_record()
        if answer.refusal:
            sentence = self.picture.refusal(answer.refusal, answer.axis, answer.value, answer.limit)
            if self.picture.fault and self.picture.state() in _BROKEN:
                sentence += f"; the fault: {self.picture.fault}"
            raise CommandFailed("refused", sentence)

    async def tell_to_end(self) -> None:
        """Tell the loop to stop, disable and end; its process's end is the answer."""
        async with self._ring:
            self.observer.command(0, Command.SHUTDOWN)

    async def _see_next_record(self) -> None:
        # The answer is a little older than the record of its cycle: the state that is read next must know of it.
        seen = self.observer.head
        while self.observer.head == seen:
            self.check_loop()
            await asyncio.sleep(POLL_S)

    def check_loop(self) -> None:
        """Raise CommandFailed where the loop has ended."""
        if not self.picture.loop_lives:
            raise CommandFailed("fault", f"the loop (process {self.observer.loop_pid}) has ended")

    async def until(
        self,
        wanted: State,
        through: frozenset[State],
        patience_s: float,
        what: str,
        progress: Progress | None = None,
        since: int | None = None,
    ) -> None:
        """Wait for the state `wanted`, which is reached through the states `through` only; any other ends the wait.

        Args:
            wanted: the state.
            through: the others that are passed.
            patience_s: how long it may take, s.
            what: is named in sentences.
            progress: is told how far it is.
            since: the last event before it began; None: now.
        """
        until = time.monotonic() + patience_s
        told = 0.0
        faults, event = self.picture.faults, self.last_event() if since is None else since
        while (state := self.picture.state()) is not wanted or self.picture.switching():
            self.check_loop()
            if state in _BROKEN and wanted is not state:
                raise CommandFailed("fault", await self._why(faults))
            name = "unknown" if state is None else state.name.lower().replace("_", " ")
            if state is State.STOPPED_BY_LIMIT and state not in through:
                raise CommandFailed("fault", f"{what} was {await self._why_ended(event)}")
            if state is not wanted and state not in through:
                raise CommandFailed("refused", f"{what} was ended by another command: the machine is {name}")
            if time.monotonic() > until:
                raise CommandFailed("timeout", f"{what} took longer than {patience_s:.1f} s: the machine is {name}")
            if progress is not None and time.monotonic() - told > _PROGRESS_S:
                told = time.monotonic()
                await progress(self._progress())
            await asyncio.sleep(POLL_S)

    async def _why(self, faults: int) -> str:
        """Return the sentence of a fault after the first `faults`: it may be some polls behind the state."""
        until = time.monotonic() + _ANSWER_S
        while self.picture.faults == faults and time.monotonic() < until:
            await asyncio.sleep(POLL_S)
        return self.picture.last_fault or "the machine went into fault: see `rtcp status`"

    def last_event(self) -> int:
        """Return the number of the last event."""
        events = self.observer.events_since(0)
        return events[-1].number if events else 0

    def ended_since(self, number: int) -> Event | None:
        """Return the event after `number` by which a motion ended early, or None."""
        found = None
        for event in self.observer.events_since(number):
            if event.code >= Code.ENDED or event.code in self._sentences.faults or event.code in _ENDINGS:
                found = event
        return found

    async def happened(self, code: Code, since: int, patience_s: float) -> Event:
        """Wait for an event after the one of the number `since`; return it.

        Raises:
            CommandFailed: a fault came first, or the torque went, or it took too long.
        """
        until = time.monotonic() + patience_s
        while True:
            self.check_loop()
            for event in self.observer.events_since(since):
                if event.code == code:
                    return event
                if event.code in self._sentences.faults:
                    raise CommandFailed("fault", self.sentence(event))
                if event.code == Code.DISABLED:
                    raise CommandFailed("refused", "it was ended by another command: the drives are disabled")
            if time.monotonic() > until:
                raise CommandFailed("timeout", f"it took longer than {patience_s:.1f} s")
            await asyncio.sleep(POLL_S)

    def sentence(self, event: Event) -> str:
        """Return what an event says."""
        return self._sentences.event(event.code, event.axis, event.value, event.limit)

    def last_sentence(self) -> str:
        """Return what the last event says: the picture's message may be some polls behind the state."""
        events = self.observer.events_since(0)
        return self.sentence(events[-1]) if events else self.picture.message

    async def _why_ended(self, number: int) -> str:
        event = self.ended_since(number)
        return f"stopped by a limit: {self.sentence(event)}" if event else "stopped by a limit: see `rtcp status`"

    def _progress(self) -> dict[str, Any]:
        latest = self.observer.latest()
        if latest is None:
            return {}
        elapsed, duration = float(latest[0]["elapsed_s"]), float(latest[0]["duration_s"])
        return {
            "fraction": min(elapsed / duration, 1.0) if duration > 0 else 0.0,
            "q": [float(value) for value in latest[0]["position"]],
            "remaining_s": max(duration - elapsed, 0.0),
        }

    def joints(self, name: str) -> list[float]:
        """Return a field of the latest record, one number a joint: `position`, `target`, ..."""
        latest = self.observer.latest()
        if latest is None:
            raise CommandFailed("fault", "the loop has published no cycle")
        return [float(value) for value in latest[0][name]]


_ENDINGS = frozenset({Code.LEASE_ENDED, Code.NOT_PERMITTED})
"""Events by which a motion ends early although nothing is wrong with the arm."""
