"""Motions that last as long as they are asked for, again and again: jogs, joint speeds, torques, streams.

A client that falls silent has three ends: the time for which its command counts, its lease, its connection.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from typing import Any

from rtcp.gateway.carrier import MOVING, POLL_S, Carrier, CommandFailed
from rtcp.ipc.codes import JogFrame, MotionMode
from rtcp.ipc.layout import COMMAND_NUMBERS
from rtcp.ipc.machine import Command, State

FRAMES = {frame.name.lower(): frame for frame in JogFrame}
_REST_S = 10.0


class Caller(str):
    """Who asks: a name for people, and the connection that it came on."""

    connection: int

    def __new__(cls, name: str, connection: int) -> Caller:
        """Make it of both."""
        made = super().__new__(cls, name)
        made.connection = connection
        return made


class Held:
    """Carries commands that have to be renewed; each connection keeps one lease from the first to the last of them.

    Args:
        carrier: the way to the loop.
    """

    def __init__(self, carrier: Carrier) -> None:
        self._carrier = carrier
        self._joints = len(carrier.config.joints)
        self._leases: dict[int, int] = {}
        self._events: dict[int, int] = {}

    async def jog(self, client: Caller, speeds: Sequence[float], frame: str, hold_s: float) -> dict[str, Any]:
        """Move the tool with six speeds (m/s, rad/s) of its or the base's frame, or the joints (rad/s)."""
        if frame not in FRAMES:
            raise CommandFailed("invalid", f"frame: found {frame!r}, allowed is one of {', '.join(FRAMES)}")
        joints = FRAMES[frame] is JogFrame.JOINTS
        self._require("v", speeds, self._joints if joints else 6)
        if joints and self._motion() == MotionMode.VELOCITY:
            return await self._give(client, Command.VELOCITY, _numbers(speeds, hold_s))
        return await self._give(client, Command.JOG, _numbers(speeds, FRAMES[frame], hold_s))

    async def velocity(self, client: Caller, speeds: Sequence[float], hold_s: float) -> dict[str, Any]:
        """Move the joints with these speeds (rad/s)."""
        self._require("numbers", speeds, self._joints)
        return await self._give(client, Command.VELOCITY, _numbers(speeds, hold_s))

    async def torque(
        self, client: Caller, torques: Sequence[float], stiffness: float, damping: float, hold_s: float
    ) -> dict[str, Any]:
        """Add torques (Nm) to what holds the arm's weight, with parts (0 to 1) of the joints' stiffness and damping."""
        self._require("numbers", torques, self._joints)
        return await self._give(client, Command.TORQUE, _numbers(torques, stiffness, damping, hold_s))

    async def stream(self, client: Caller, q: Sequence[float], stamp_s: float) -> dict[str, Any]:
        """Give the next target (rad) of a stream, with the sender's time stamp."""
        self._require("q", q, self._joints)
        return await self._give(client, Command.STREAM, _numbers(q, stamp_s))

    async def rest(self, client: Caller) -> None:
        """End what this connection was moving and wait until the arm has come to rest: another command follows."""
        if client.connection not in self._leases:
            return
        self.gone(client.connection)
        until = time.monotonic() + _REST_S
        while self._carrier.picture.state() in MOVING and time.monotonic() < until:
            self._carrier.check_loop()
            await asyncio.sleep(POLL_S)

    def gone(self, connection: int) -> None:
        """End what a connection that has closed was moving: its lease goes, and the loop stops the arm."""
        self._events.pop(connection, None)
        lease = self._leases.pop(connection, 0)
        if lease:
            self._carrier.observer.release(lease)

    async def _give(self, client: Caller, command: Command, numbers: Sequence[float]) -> dict[str, Any]:
        lease = self._lease(client)
        try:
            await self._carrier.give(lease, command, numbers)
        except CommandFailed as failed:
            ended = self._carrier.ended_since(self._events[client.connection])
            if ended is not None and self._carrier.picture.state() is not State.HOLDING:
                raise CommandFailed("fault", f"the motion has ended: {self._carrier.sentence(ended)}") from None
            raise failed
        state = self._carrier.picture.state()
        return {"state": "unknown" if state is None else state.name.lower(), "q": self._carrier.joints("position")}

    def _lease(self, client: Caller) -> int:
        lease = self._leases.get(client.connection, 0)
        if not lease or not self._carrier.observer.renew(lease):
            self._leases[client.connection] = lease = self._carrier.acquire(client)
            self._events[client.connection] = self._carrier.last_event()
        return lease

    def _motion(self) -> int:
        latest = self._carrier.observer.latest()
        return 0 if latest is None else int(latest[0]["motion"])

    def _require(self, key: str, numbers: Sequence[float], count: int) -> None:
        if len(numbers) != count:
            raise CommandFailed("invalid", f"{key}: found {len(numbers)} numbers, allowed are {count}")


def _numbers(first: Sequence[float], *last: float) -> list[float]:
    return [*first, *([0.0] * (COMMAND_NUMBERS - len(first) - len(last))), *last]
