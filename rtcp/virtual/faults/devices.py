"""Faults of the device models alone: the same on a segment and on the bus `inprocess`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import TypeVar

from rtcp.config.faults import DriveFault, InputsFrozen, StickCode, TerminalFault
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.models import CubemarsDrive, DiewuIoBox
from rtcp.virtual.models.diewu import BrokenTerminals
from rtcp.virtual.models.protection import (
    ENCODER,
    FOLLOWING_ERROR,
    OVER_CURRENT,
    OVER_SPEED,
    OVER_TEMPERATURE,
    OVER_VOLTAGE,
    UNDER_VOLTAGE,
)

DeviceFault = DriveFault | TerminalFault | InputsFrozen | StickCode
STICK = 0x3F
"""The joystick's lines: the six first inputs."""
CODES = MappingProxyType({
    "over-current": OVER_CURRENT, "over-voltage": OVER_VOLTAGE, "under-voltage": UNDER_VOLTAGE,
    "over-temperature": OVER_TEMPERATURE, "encoder": ENCODER, "over-speed": OVER_SPEED,
    "following-error": FOLLOWING_ERROR,
})  # fmt: skip
"""Error codes (0x603F) by the names that faults give them."""

_D = TypeVar("_D", bound=DeviceModel)


class FaultRefused(Exception):
    """This segment cannot have this fault: a sentence."""


def begin(devices: Sequence[DeviceModel], fault: DeviceFault) -> Callable[[int], None]:
    """Let `fault` begin in one of `devices` (in the order of the cable); return what ends it, called with an instant.

    Raises:
        FaultRefused: there is no such device.
    """
    if isinstance(fault, DriveFault):
        drive, code = _at(devices, fault.slave, CubemarsDrive, "drive"), CODES[fault.error]
        drive.begin_fault(code)
        return lambda _: drive.end_fault(code)
    if isinstance(fault, InputsFrozen):
        frozen = _at(devices, fault.slave, DiewuIoBox, "IO box")
        frozen.freeze_inputs()
        return lambda _: frozen.thaw_inputs()
    box = next((device for device in devices if isinstance(device, DiewuIoBox)), None)
    if box is None:
        raise FaultRefused(f"there is no IO box on the segment: {fault.name} is a fault of its inputs")
    broken = _terminals(box, fault)
    box.break_terminals(broken)
    return lambda _: box.release_terminals(broken)


def _at(devices: Sequence[DeviceModel], number: int, kind: type[_D], words: str) -> _D:
    if number > len(devices):
        raise FaultRefused(f"there is no slave {number}: the segment has slaves 1 to {len(devices)}")
    device = devices[number - 1]
    if not isinstance(device, kind):
        raise FaultRefused(f"slave {number} ({device.identity.name}) is no {words}")
    return device


def _terminals(box: DiewuIoBox, fault: TerminalFault | StickCode) -> BrokenTerminals:
    if isinstance(fault, StickCode):
        return BrokenTerminals(STICK, fault.value)
    mask = 1 << fault.number - 1
    if fault.how == "bounce":
        # The first thing that is seen of it is the other level.
        return BrokenTerminals(mask, ~box.inputs, fault.ms * 1e-3)
    return BrokenTerminals(mask, mask if fault.how == "high" else 0)
