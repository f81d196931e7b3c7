"""What a device model is to the virtual slave that carries it: objects, an identity, and time that passes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

from rtcp.virtual.objects import ObjectDictionary


@dataclass(frozen=True)
class Identity:
    """What the SII and object 0x1018 tell of a device."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int
    name: str
    """Name of the device, as in SII string 1 and object 0x1008."""
    group: str
    order_code: str


@dataclass(frozen=True)
class Emergency:
    """An emergency message (ETG.1000.6, 5.6.4): error code, error register, five bytes of the maker's."""

    error_code: int
    error_register: int
    data: bytes = bytes(5)


class Device(Protocol):
    """A device model: it knows objects by index and subindex and nothing of frames.

    The slave copies RxPDO-mapped entries in before `step` and TxPDO-mapped ones out after it.
    """

    identity: Identity
    objects: ObjectDictionary
    emergencies: deque[Emergency]
    """Emergency messages that wait to be sent; the slave's mailbox takes them from the left."""
    supports_dc: bool

    def power_off(self) -> None:
        """The supply goes: no torque, outputs off, nothing is driven; `step` lets only the mechanics go on."""

    def power_on(self) -> None:
        """The supply comes back: all is as at power-on, only what is mechanical and what is stored has stayed."""

    def step(self, dt: float) -> None:
        """Let `dt` seconds pass: read the RxPDO objects, move, write the TxPDO objects."""

    def set_outputs_valid(self, valid: bool) -> None:
        """Tell that process data outputs have become valid (OP) or must be ignored (the safe state).

        A drive that loses its outputs while enabled faults (a communication fault) and takes its torque off.
        """
