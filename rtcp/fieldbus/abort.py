"""SDO abort codes in words (ETG.1000.6, table 41)."""

from __future__ import annotations

ABSENT = frozenset((0x06020000, 0x06090011))
"""The codes that say that an object or a subindex does not exist."""

ABORT_CODES: dict[int, str] = {
    0x05030000: "toggle bit not changed",
    0x05040000: "SDO protocol timeout",
    0x05040001: "command specifier not valid or unknown",
    0x05040005: "out of memory",
    0x06010000: "unsupported access to an object",
    0x06010001: "attempt to read a write-only object",
    0x06010002: "attempt to write a read-only object",
    0x06010003: "subindex cannot be written, subindex 0 must be 0 first",
    0x06010004: "complete access not supported for objects of variable length",
    0x06010005: "object longer than the mailbox",
    0x06010006: "object is mapped to an RxPDO, download blocked",
    0x06020000: "the object does not exist",
    0x06040041: "the object cannot be mapped into the PDO",
    0x06040042: "number and length of the mapped objects exceed the PDO",
    0x06040043: "general parameter incompatibility",
    0x06040047: "general internal incompatibility of the device",
    0x06060000: "access failed because of a hardware error",
    0x06070010: "data type does not match: length differs",
    0x06070012: "data type does not match: too long",
    0x06070013: "data type does not match: too short",
    0x06090011: "the subindex does not exist",
    0x06090030: "value out of range",
    0x06090031: "value too high",
    0x06090032: "value too low",
    0x06090036: "maximum below minimum",
    0x08000000: "general error",
    0x08000020: "data cannot be transferred or stored",
    0x08000021: "data cannot be transferred or stored: local control",
    0x08000022: "data cannot be transferred or stored in the present state of the device",
    0x08000023: "no object dictionary is present",
}


def abort_meaning(code: int) -> str:
    """Return what an abort code means."""
    return ABORT_CODES.get(code, "not in the standard")
