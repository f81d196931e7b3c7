"""The joystick of the virtual IO box: forces its inputs through its objects, and releases them by itself.

An input must not stay forced when its client has died: every hold is short and must be repeated, a closed connection
releases, and a starting gateway releases the inputs of an earlier one.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated

from annotated_types import Gt, Le

from rtcp.config.model import VIRTUAL, ArmConfig, InputConfig
from rtcp.gateway.command_channel import Caller, Json
from rtcp.gateway.machine_actions import MachineActions
from rtcp.gateway.method import left, method
from rtcp.ipc.errors import RtcpError

OBJECT, MASK, LEVELS, HOLD = 0x2000, 1, 2, 3
"""Object of the virtual IO box; its subindices: forced inputs, levels, hold time (`rtcp.virtual.models.diewu`)."""
_BOX_HOLD_MS, _REPEAT_S = 1500, 0.4
"""Hold time, after which the box releases by itself if this process is killed, ms; interval of repetition, s."""
DIRECTIONS = ("forward", "backward", "left", "right", "mode_up", "mode_down")
CHAIR, EMERGENCY_STOP, ENABLING_SWITCH = "chair", "emergency_stop", "enabling_switch"
LONGEST_HOLD_S = 1.0
_POLL_S = 0.02
_BYTE = 0xFF


class JoystickOverride:
    """Forces the inputs of joystick, toggle, emergency stop and enabling switch.

    Args:
        actions: writes the objects.
        config: has the numbers of the inputs.
        bus: must be the virtual one, which alone has this object.
    """

    def __init__(self, actions: MachineActions, config: ArmConfig, bus: str) -> None:
        self._actions = actions
        self._config = config
        self._bus = bus
        self._boxes = {slave.name: at for at, slave in enumerate(config.slaves, 1) if slave.device.is_box}
        self._owner: Caller | None = None
        self._until = 0.0
        self._written: dict[tuple[str, int], int] = {}
        self._writing = asyncio.Lock()
        self._repeated = 0.0

    @property
    def possible(self) -> bool:
        """Whether there is a virtual IO box."""
        return self._bus == VIRTUAL and bool(self._boxes)

    @method(streams=True)
    async def joystick(
        self,
        caller: Caller,
        pressed: tuple[str, ...] | None = None,
        byte: int | None = None,
        hold_s: Annotated[float, Gt(0), Le(LONGEST_HOLD_S)] = LONGEST_HOLD_S,
        sent_s: float | None = None,
    ) -> Json:
        """Hold the joystick of the virtual IO box as `pressed` names it, or at `byte`; neither: release it.

        `pressed`: of forward, backward, left, right, mode_up, mode_down, chair, emergency_stop, enabling_switch.
        """
        left(hold_s, sent_s)
        if self._bus == VIRTUAL and not self._boxes:
            raise RtcpError("refused", "inputs are forced at an IO box: none is configured (slaves in the file)")
        if not self.possible:
            raise RtcpError("refused", f"inputs are forced on the virtual bus only, not on {self._bus}")
        if self._owner is not None and self._owner.connection != caller.connection:
            # Its hold expires within a second.
            raise RtcpError("refused", f"the joystick is held by {self._owner.name}: wait until it is released")
        inputs = {} if pressed is None and byte is None else forced(self._config, pressed or (), byte)
        if not any(mask for mask, _ in inputs.values()):
            await self.release()
            return {}
        self._owner, self._until = caller, time.monotonic() + hold_s
        await self._write(inputs)
        return {box: {"mask": mask, "levels": levels} for box, (mask, levels) in inputs.items()}

    async def release(self) -> None:
        """Release all inputs; `watch` repeats failed writes."""
        self._owner = None
        self._repeated = 0.0
        if self.possible:
            with contextlib.suppress(RtcpError):
                await self._write({})

    async def end(self, connection: int) -> None:
        """Release the inputs of a connection that has closed."""
        if self._owner is not None and self._owner.connection == connection:
            await self.release()

    async def watch(self) -> None:
        """Release inputs whose hold is not repeated; runs as long as the gateway."""
        while True:
            await asyncio.sleep(_POLL_S)
            expired = self._owner is not None and time.monotonic() > self._until
            if expired or (self._owner is None and any(self._written.get((box, MASK)) != 0 for box in self._boxes)):
                await self.release()

    async def _write(self, inputs: Mapping[str, tuple[int, int]]) -> None:
        async with self._writing:
            repeats = time.monotonic() - self._repeated > _REPEAT_S
            refused: RtcpError | None = None
            # Releases first: a box that does not answer must not delay them.
            for box in sorted(self._boxes, key=lambda box: inputs.get(box, (0, 0))[0] != 0):
                mask, levels = inputs.get(box, (0, 0))
                try:
                    if mask and (repeats or not self._written.get((box, MASK))):
                        await self._write_object(box, HOLD, _BOX_HOLD_MS)
                        self._repeated = time.monotonic()
                    # Levels before the mask: no input gets an old level. A full release needs the mask alone.
                    for subindex, value in ((LEVELS, levels), (MASK, mask)) if mask else ((MASK, mask),):
                        if self._written.get((box, subindex)) != value:
                            self._written.pop((box, subindex), None)
                            await self._write_object(box, subindex, value)
                            self._written[box, subindex] = value
                except RtcpError as error:
                    refused = error
            if refused is not None:
                raise refused

    async def _write_object(self, box: str, subindex: int, value: int) -> None:
        request = {"slave": self._boxes[box], "index": OBJECT, "subindex": subindex}
        await self._actions.service({"do": "sdo_write", **request, "hex": value.to_bytes(2, "little").hex()})


def forced(config: ArmConfig, pressed: Sequence[str], byte: int | None) -> dict[str, tuple[int, int]]:
    """Return the mask of the inputs that are forced and their levels, by box.

    Args:
        config: has the inputs of joystick, toggle, emergency stop and enabling switch.
        pressed: of `DIRECTIONS`, and `chair` (the toggle gives the joystick to the wheelchair), `emergency_stop`,
            `enabling_switch`.
        byte: the joystick's byte; None: by `pressed`.

    Raises:
        RtcpError: a name is unknown, or an input is not configured.
    """
    inputs = config.inputs
    switches: dict[str, tuple[InputConfig | None, bool]] = {
        CHAIR: (inputs.arm_toggle, False),
        EMERGENCY_STOP: (inputs.emergency_stop, True),
        ENABLING_SWITCH: (inputs.enabling_switch, True),
    }
    masks, levels = Counter[str](), Counter[str]()
    for name in pressed:
        if name not in DIRECTIONS and name not in switches:
            allowed = ", ".join((*DIRECTIONS, *switches))
            raise RtcpError("invalid", f'pressed: found the text "{name}", allowed are {allowed}')
        if name in switches:
            switch, active = switches[name]
            if switch is None:
                key = "arm_toggle" if name == CHAIR else name
                raise RtcpError("refused", f"the input inputs.{key} is missing in {config.source}")
            box = config.box_of(switch)
            masks[box] |= 1 << switch.number - 1
            levels[box] |= ((switch.active == "high") is active) << switch.number - 1
    joystick = inputs.joystick
    if joystick is None:
        if byte is not None or any(name in DIRECTIONS for name in pressed):
            raise RtcpError("refused", f"there is no joystick: inputs.joystick is missing in {config.source}")
        return {box: (mask, levels[box]) for box, mask in masks.items()}
    bits = {name: 1 << getattr(joystick, name) - 1 for name in DIRECTIONS}
    place = (min(bits.values()).bit_length() - 1) // 8 * 8
    box = config.box_of(joystick)
    here = (switch for switch, _ in switches.values() if switch is not None and config.box_of(switch) == box)
    others = sum(1 << switch.number - 1 for switch in here)
    lines = sum(bits.values())
    if byte is None:
        active_lines = sum(bits[name] for name in DIRECTIONS if name in pressed)
        level = lines & ~active_lines if joystick.active == "low" else active_lines
    elif not 0 <= byte <= _BYTE:
        raise RtcpError("invalid", f"byte: found {byte}, allowed is 0 to 255")
    else:
        lines = _BYTE << place & ~others
        level = byte << place & lines
    masks[box] |= lines
    levels[box] |= level
    return {box: (mask, levels[box]) for box, mask in masks.items()}
