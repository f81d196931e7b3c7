"""Where a joint's zero is: set where the joint stands, or found by its drive's homing."""

from __future__ import annotations

import contextlib
from typing import Any

from rtcp.config.model import ConfigError
from rtcp.config.zero import read_zeros, store_zero, zero_file
from rtcp.gateway.carrier import Carrier, CommandFailed
from rtcp.ipc.codes import Code
from rtcp.ipc.machine import Command, State

_HOMING = frozenset({State.HOMING})
_HOMING_S = 180.0


class Zeroing:
    """Sets zeros on behalf of the control socket's clients.

    Args:
        carrier: the way to the loop.
    """

    def __init__(self, carrier: Carrier) -> None:
        self._carrier = carrier
        self._config = carrier.config

    async def zero(self, client: str, joint: str, at: float) -> dict[str, Any]:
        """Let the joint stand at `at` (rad) now, in the loop and in the file of offsets, while no drive has torque."""
        axis = self._axis(joint)
        if axis == len(self._config.joints):
            # A cycle record has the arm's joints alone: where the gripper stands is not in it.
            raise CommandFailed(
                "refused",
                f"{joint}: the zero of the gripper's joint is not set by a command; its offset stands in "
                f"{zero_file(self._config.name)}",
            )
        async with self._carrier.lease(client) as lease:
            try:
                offsets = read_zeros(self._config) or (0.0,) * len(self._config.axes)
                before = offsets[axis]
                offset = before + self._carrier.joints("position")[axis] - at
                await self._carrier.give(lease, Command.ZERO, [axis, offset])
                try:
                    path = store_zero(self._config, axis, offset)
                except BaseException:
                    # In force and in the file is the same offset, or the next start would stand elsewhere.
                    with contextlib.suppress(CommandFailed):
                        await self._carrier.give(lease, Command.ZERO, [axis, before])
                    raise
            except ConfigError as error:
                raise CommandFailed("refused", str(error)) from None
        return {"joint": self._config.axes[axis].name, "offset": offset, "before": before, "file": str(path)}

    async def home(self, client: str, joint: str) -> dict[str, Any]:
        """Let the joint's drive home by itself (mode 6); returns when the arm holds again."""
        axis = self._axis(joint)
        event = self._carrier.last_event()
        async with self._carrier.lease(client) as lease:
            await self._carrier.give(lease, Command.HOME, [axis])
            await self._carrier.until(State.HOLDING, _HOMING, _HOMING_S, "homing", since=event)
        for found in self._carrier.observer.events_since(event):
            if found.code == Code.HOMED and found.axis == axis:
                return {"joint": self._config.axes[axis].name, "position": self._carrier.joints("position")[axis]}
            if found.code == Code.HOMING_FAILED:
                raise CommandFailed("fault", self._carrier.sentence(found))
        raise CommandFailed("fault", f"{self._config.axes[axis].name}: homing was interrupted; the arm holds")

    def _axis(self, joint: str) -> int:
        names = [axis.name for axis in self._config.axes]
        if joint not in names:
            raise CommandFailed("invalid", f"joint: found {joint!r}, allowed is one of {', '.join(names)}")
        return names.index(joint)
