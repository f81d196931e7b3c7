"""Carrying one command through: lease, command ring, answer, and the wait for what was asked."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from typing import Any

from rtcp.config.model import ArmConfig
from rtcp.motion.modes import DriveMode
from rtcp.runtime.layout import COMMAND_NUMBERS
from rtcp.runtime.machine import Command, State
from rtcp.runtime.observer import BlackboardError, LeaseRefused, Observer
from rtcp.runtime.picture import Picture

Progress = Callable[[dict[str, Any]], Awaitable[None]]
_POLL_S = 0.002
_SAME_RAD = 1e-9
_SETTLED_RAD, _SETTLE_S = 5e-4, 3.0
_ENABLING = frozenset({State.ENABLING})
_DISABLING = frozenset({State.HOLDING, State.MOVING, State.STOPPING, State.ENABLING, State.DISABLING})
_RESETTING = frozenset({State.RESETTING})
_MOVING = frozenset({State.MOVING, State.STOPPING})
_ANSWER_S = 2.0
_SERVICE_S = 5.0


class CommandFailed(Exception):
    """A request that was not carried out: its kind (refused, fault, timeout, invalid) and a sentence."""

    def __init__(self, kind: str, sentence: str) -> None:
        super().__init__(sentence)
        self.kind = kind


class Commander:
    """Gives commands to the loop on behalf of the control socket's clients."""

    def __init__(self, observer: Observer, picture: Picture, config: ArmConfig) -> None:
        self._observer = observer
        self._picture = picture
        self._config = config
        self._service = asyncio.Lock()
        self._ring = asyncio.Lock()

    @contextlib.asynccontextmanager
    async def _lease(self, client: str) -> AsyncIterator[int]:
        try:
            lease = self._observer.acquire(client, self._config.lease_s)
        except LeaseRefused as refused:
            raise CommandFailed("refused", str(refused)) from None
        renewing = asyncio.create_task(self._renew(lease))
        try:
            yield lease
        finally:
            renewing.cancel()
            self._observer.release(lease)

    async def _renew(self, lease: int) -> None:
        while self._observer.renew(lease):
            await asyncio.sleep(self._config.lease_s / 5)

    async def _give(self, lease: int, command: Command, numbers: Sequence[float] = ()) -> None:
        async with self._ring:
            try:
                number = self._observer.command(lease, command, numbers)
            except BlackboardError as error:
                raise CommandFailed("fault", str(error)) from None
            until = time.monotonic() + _ANSWER_S
            while (answer := self._observer.answer(number)) is None:
                self._check_loop()
                if time.monotonic() > until:
                    raise CommandFailed("timeout", f"the loop did not answer {command.name.lower()} within 2 s")
                await asyncio.sleep(_POLL_S)
        await self._see_next_record()
        if answer.refusal:
            sentence = self._picture.refusal(answer.refusal, answer.axis, answer.value, answer.limit)
            if self._picture.fault and self._picture.state() is State.FAULT:
                sentence += f"; the fault: {self._picture.fault}"
            raise CommandFailed("refused", sentence)

    async def _see_next_record(self) -> None:
        # The answer is a little older than the record of its cycle: the state that is read next must know of it.
        seen = self._observer.head
        while self._observer.head == seen:
            self._check_loop()
            await asyncio.sleep(_POLL_S)

    def _check_loop(self) -> None:
        if not self._picture.loop_lives:
            raise CommandFailed("fault", f"the loop (process {self._observer.loop_pid}) has ended")

    async def _until(
        self, wanted: State, through: frozenset[State], patience_s: float, what: str, progress: Progress | None = None
    ) -> None:
        """Wait for the state `wanted`, which is reached through the states `through` only; any other ends the wait."""
        until = time.monotonic() + patience_s
        told = 0.0
        faults = self._picture.faults
        while (state := self._picture.state()) is not wanted or self._picture.switching():
            self._check_loop()
            if state is State.FAULT and wanted is not State.FAULT:
                raise CommandFailed("fault", await self._why(faults))
            name = "unknown" if state is None else state.name.lower()
            if state is not wanted and state not in through:
                raise CommandFailed("refused", f"{what} was ended by another command: the machine is {name}")
            if time.monotonic() > until:
                raise CommandFailed("timeout", f"{what} took longer than {patience_s:.1f} s: the machine is {name}")
            if progress is not None and time.monotonic() - told > 0.1:
                told = time.monotonic()
                await progress(self._progress())
            await asyncio.sleep(_POLL_S)

    async def _why(self, faults: int) -> str:
        """Return the sentence of a fault after the first `faults`: it may be some polls behind the state."""
        until = time.monotonic() + _ANSWER_S
        while self._picture.faults == faults and time.monotonic() < until:
            await asyncio.sleep(_POLL_S)
        return self._picture.last_fault or "the machine went into fault: see `rtcp status`"

    def _progress(self) -> dict[str, Any]:
        latest = self._observer.latest()
        if latest is None:
            return {}
        elapsed, duration = float(latest[0]["elapsed_s"]), float(latest[0]["duration_s"])
        return {
            "fraction": min(elapsed / duration, 1.0) if duration > 0 else 0.0,
            "q": [float(value) for value in latest[0]["position"]],
            "remaining_s": max(duration - elapsed, 0.0),
        }

    # -- what clients ask ---------------------------------------------------------------------------------------

    async def enable(self, client: str) -> dict[str, Any]:
        """Enable all drives; returns when the arm holds."""
        self._check_loop()
        if self._picture.state() is State.HOLDING:
            return {}
        async with self._lease(client) as lease:
            await self._give(lease, Command.ENABLE)
            await self._until(State.HOLDING, _ENABLING, self._config.enable_timeout_s + 3.0, "enabling")
        return {}

    async def disable(self, client: str) -> dict[str, Any]:
        """Stop in a controlled way and take the torque off; needs no lease."""
        faulty = self._picture.state() in (State.FAULT, State.RESETTING)
        await self._give(0, Command.DISABLE)
        if not faulty:
            await self._until(State.READY, _DISABLING, self._config.enable_timeout_s + 30.0, "disabling")
        return {}

    async def reset(self, client: str) -> dict[str, Any]:
        """Leave the state FAULT: slaves back in OP, drive faults reset, drives disabled."""
        self._check_loop()
        if self._picture.state() in (State.READY, State.HOLDING):
            return {}
        async with self._lease(client) as lease:
            await self._give(lease, Command.RESET)
            await self._until(State.READY, _RESETTING, 6.0, "reset")
        return {}

    async def mode(self, client: str, name: str) -> dict[str, Any]:
        """Change the cyclic synchronous mode, at standstill."""
        modes = {mode.name.lower(): mode for mode in (DriveMode.CSP, DriveMode.CSV, DriveMode.CST)}
        if name not in modes:
            raise CommandFailed("invalid", f"mode {name!r} is unknown: one of {', '.join(modes)}")
        async with self._lease(client) as lease:
            await self._give(lease, Command.MODE, [modes[name]])
            if self._picture.state() is State.HOLDING:
                await self._until(State.HOLDING, frozenset(), 3.0, "the mode change")
        return {"mode": name}

    async def move(self, client: str, q: Sequence[float], speed: float | None, progress: Progress) -> dict[str, Any]:
        """Move to joint positions `q` (rad); returns when there."""
        joints = self._config.joints
        if len(q) != len(joints):
            raise CommandFailed("invalid", f"{len(q)} joint positions were given, the arm has {len(joints)} joints")
        fastest = max(joint.velocity for joint in joints)
        numbers = [*q, *([0.0] * (COMMAND_NUMBERS - 1 - len(q))), fastest if speed is None else speed]
        async with self._lease(client) as lease:
            await self._give(lease, Command.MOVE, numbers)
            if speed is not None and math.isfinite(speed):
                fastest = min(fastest, speed)
            # Twice round at that speed and some more: only a machine that hangs takes longer.
            await self._until(State.HOLDING, _MOVING, 20.0 + 4 * math.tau / fastest, "the move", progress)
        # What was asked for and what the arm does differ by the following error, which dies away.
        until = time.monotonic() + _SETTLE_S
        while (arrival := self._arrival(q))["error"] > _SETTLED_RAD and time.monotonic() < until:
            await asyncio.sleep(0.02)
        return arrival

    def _arrival(self, q: Sequence[float]) -> dict[str, Any]:
        latest = self._observer.latest()
        if latest is None:
            raise CommandFailed("fault", "the loop has published no cycle")
        target, position = ([float(value) for value in latest[0][name]] for name in ("target", "position"))
        if max(abs(a - b) for a, b in zip(target, q, strict=True)) > _SAME_RAD:
            raise CommandFailed("fault", f"the move ended before it arrived: {self._picture.message}")
        return {"q": position, "error": max(abs(a - b) for a, b in zip(position, q, strict=True))}

    async def halt(self, client: str) -> dict[str, Any]:
        """Stop a motion in a controlled way; needs no lease."""
        await self._give(0, Command.STOP)
        await self._until(State.HOLDING, _MOVING, 30.0, "stopping")
        return {}

    async def output(self, client: str, number: int, value: bool) -> dict[str, Any]:
        """Set a digital output."""
        async with self._lease(client) as lease:
            await self._give(lease, Command.OUTPUT, [number, value])
        return {}

    async def shut_down(self) -> None:
        """Tell the loop to stop, disable and end; its process's end is the answer."""
        async with self._ring:
            self._observer.command(0, Command.SHUTDOWN)

    async def sdo_write(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        """Write an object, under the lease and only while no drive has torque.

        What a drive does in a fault or beyond a limit stands in its objects: they do not change under a moving arm.
        """
        state = self._picture.state()
        if state is not State.READY:
            name = "unknown" if state is None else state.name.lower()
            raise CommandFailed("refused", f"an object is written while ready only, not while {name}: `rtcp disable`")
        async with self._lease(client):
            return await self.service(request)

    async def service(self, request: dict[str, Any]) -> dict[str, Any]:
        """Let the loop's service thread carry out an SDO access or a scan."""
        async with self._service:
            self._observer.ask_service(request)
            until = time.monotonic() + _SERVICE_S
            while (answer := self._observer.service_answer()) is None:
                self._check_loop()
                if time.monotonic() > until:
                    raise CommandFailed("timeout", "the loop's service thread did not answer within 5 s")
                await asyncio.sleep(_POLL_S)
        if "error" in answer:
            raise CommandFailed("refused", str(answer["error"]))
        return answer
