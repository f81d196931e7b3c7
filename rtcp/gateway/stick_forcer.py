"""A joystick without hardware: forces inputs of the virtual IO box through its objects, and lets go by itself.

An input that stays forced when whoever forced it has died is the known accident: every hold is short and has to be said
again, a connection that closes lets go, and a gateway that starts lets go of what an earlier one left.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Sequence
from typing import Any

from rtcp.config.model import VIRTUAL, ArmConfig, InputConfig
from rtcp.gateway.carrier import CommandFailed
from rtcp.gateway.commander import Commander
from rtcp.gateway.held import Caller

OBJECT, MASK, LEVELS, HOLD = 0x2000, 1, 2, 3
"""Of the virtual IO box: which inputs are forced, to what, and for how long (`rtcp.virtual.models.diewu`)."""
_BOX_HOLD_MS, _SAY_AGAIN_S = 1500, 0.4
"""The box lets go by itself where this process is killed."""
DIRECTIONS = ("forward", "backward", "left", "right", "mode_up", "mode_down")
CHAIR, EMERGENCY_STOP, ENABLING_SWITCH = "chair", "emergency_stop", "enabling_switch"
LONGEST_HOLD_S = 1.0
_TURN_S = 0.02
_BYTE = 0xFF


class StickForcer:
    """Forces the inputs that the stick, the toggle, the emergency stop and the enabling switch are at.

    Args:
        commander: writes the objects.
        config: which inputs they are.
        bus: there is such an object on the virtual bus only.
    """

    def __init__(self, commander: Commander, config: ArmConfig, bus: str) -> None:
        self._commander = commander
        self._config = config
        self._bus = bus
        places = (at for at, slave in enumerate(config.slaves, 1) if slave.device.kind == "io")
        self._slave = next(places, 0)
        self._owner: Caller | None = None
        self._until = 0.0
        self._written: dict[int, int] = {}
        self._writing = asyncio.Lock()
        self._said = 0.0

    @property
    def possible(self) -> bool:
        """Whether there is a virtual IO box."""
        return self._bus == VIRTUAL and self._slave > 0

    async def force(
        self, client: Caller, pressed: Sequence[str], byte: int | None, hold_s: float
    ) -> dict[str, Any]:  # fmt: skip
        """Hold the stick as `pressed` names it, or at `byte`, for `hold_s` at most: to be said again meanwhile."""
        self._require(client)
        if not 0.0 < hold_s <= LONGEST_HOLD_S:
            raise CommandFailed("invalid", f"hold_s: found {hold_s}, allowed is more than 0 and at most 1")
        mask, levels = forced(self._config, pressed, byte)
        if mask == 0:
            return await self.release(client)
        self._owner, self._until = client, time.monotonic() + hold_s
        await self._write(mask, levels)
        return {"mask": mask, "levels": levels}

    async def release(self, client: Caller) -> dict[str, Any]:
        """Let go of what this client holds; of what another holds it is refused."""
        self._require(client)
        await self.let_go()
        return {"mask": 0, "levels": 0}

    def _require(self, client: Caller) -> None:
        if not self.possible:
            raise CommandFailed("refused", f"inputs are forced on the virtual bus only, not on {self._bus}")
        if self._owner is not None and self._owner.connection != client.connection:
            # What it holds ends by itself within a second.
            raise CommandFailed("refused", f"the stick is held by {self._owner}: wait until it lets go")

    async def let_go(self) -> None:
        """Let go of everything; what fails is tried again by `watch`."""
        self._owner = None
        self._said = 0.0
        if self.possible:
            with contextlib.suppress(CommandFailed):
                await self._write(0, 0)

    async def gone(self, connection: int) -> None:
        """Let go of what a connection that has closed was holding."""
        if self._owner is not None and self._owner.connection == connection:
            await self.let_go()

    async def watch(self) -> None:
        """Let go where nobody says the hold again; runs as long as the gateway does."""
        while True:
            await asyncio.sleep(_TURN_S)
            silent = self._owner is not None and time.monotonic() > self._until
            if silent or (self._owner is None and self._written.get(MASK) != 0):
                await self.let_go()

    async def _write(self, mask: int, levels: int) -> None:
        async with self._writing:
            if mask and time.monotonic() - self._said > _SAY_AGAIN_S:
                await self._tell(HOLD, _BOX_HOLD_MS)
                self._said = time.monotonic()
            # The levels come first, so that no input takes one that nobody asked for; but none is let go of late.
            for sub_index, value in ((LEVELS, levels), (MASK, mask)) if mask else ((MASK, mask),):
                if self._written.get(sub_index) != value:
                    self._written.pop(sub_index, None)
                    await self._tell(sub_index, value)
                    self._written[sub_index] = value

    async def _tell(self, sub_index: int, value: int) -> None:
        request = {"slave": self._slave, "index": OBJECT, "subindex": sub_index}
        await self._commander.service({"do": "sdo_write", **request, "hex": value.to_bytes(2, "little").hex()})


def forced(config: ArmConfig, pressed: Sequence[str], byte: int | None) -> tuple[int, int]:
    """Return the mask of the inputs that are forced and their levels.

    Args:
        config: where stick, toggle, emergency stop and enabling switch are.
        pressed: of `DIRECTIONS`, and `chair` (the toggle gives the stick to the wheelchair), `emergency_stop`,
            `enabling_switch`.
        byte: the stick's byte as it is, or None: as `pressed` says.

    Raises:
        CommandFailed: naming what is none, or is not configured.
    """
    inputs = config.inputs
    switches: dict[str, tuple[InputConfig | None, bool]] = {
        CHAIR: (inputs.arm_toggle, False),
        EMERGENCY_STOP: (inputs.emergency_stop, True),
        ENABLING_SWITCH: (inputs.enabling_switch, True),
    }
    mask = levels = 0
    for name in pressed:
        if name not in DIRECTIONS and name not in switches:
            allowed = ", ".join((*DIRECTIONS, *switches))
            raise CommandFailed("invalid", f"pressed: found {name!r}, allowed are {allowed}")
        if name in switches:
            switch, active = switches[name]
            if switch is None:
                key = "arm_toggle" if name == CHAIR else name
                raise CommandFailed("refused", f"there is no such input: inputs.{key} is missing in {config.source}")
            mask |= 1 << switch.number - 1
            levels |= ((switch.active == "high") is active) << switch.number - 1
    stick = inputs.joystick
    if stick is None:
        if byte is not None or any(name in DIRECTIONS for name in pressed):
            raise CommandFailed("refused", f"there is no stick: inputs.joystick is missing in {config.source}")
        return mask, levels
    bits = {name: 1 << getattr(stick, name) - 1 for name in DIRECTIONS}
    place = (min(bits.values()).bit_length() - 1) // 8 * 8
    others = sum(1 << one.number - 1 for one, _ in switches.values() if one is not None)
    lines = sum(bits.values())
    if byte is None:
        shown = sum(bits[name] for name in DIRECTIONS if name in pressed)
        return mask | lines, levels | (lines & ~shown if stick.active == "low" else shown)
    if not 0 <= byte <= _BYTE:
        raise CommandFailed("invalid", f"byte: found {byte}, allowed is 0 to 255")
    whole = _BYTE << place & ~others
    return mask | whole, levels | byte << place & whole
