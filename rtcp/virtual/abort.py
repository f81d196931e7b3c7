"""The abort codes of SDO services, under the standard's names (ETG.1000.6, table 41)."""

from __future__ import annotations

from enum import IntEnum


class AbortCode(IntEnum):
    """Why an SDO service was refused (ETG.1000.6, table 41)."""

    TOGGLE_BIT = 0x05030000
    """Toggle bit not changed."""
    COMMAND_SPECIFIER = 0x05040001
    """Client or server command specifier not valid or unknown."""
    UNSUPPORTED_ACCESS = 0x06010000
    """Unsupported access to an object."""
    WRITE_ONLY = 0x06010001
    """Attempt to read a write-only object."""
    READ_ONLY = 0x06010002
    """Attempt to write a read-only object."""
    SUBINDEX_0_NOT_ZERO = 0x06010003
    """Subindex cannot be written, subindex 0 must be 0 for write access."""
    NO_OBJECT = 0x06020000
    """The object does not exist in the object dictionary."""
    NOT_MAPPABLE = 0x06040041
    """The object cannot be mapped into the PDO."""
    PDO_LENGTH = 0x06040042
    """The number and length of the objects to be mapped would exceed the PDO length."""
    LENGTH = 0x06070010
    """Data type does not match, length of service parameter does not match."""
    TOO_LONG = 0x06070012
    """Data type does not match, length of service parameter too high."""
    TOO_SHORT = 0x06070013
    """Data type does not match, length of service parameter too low."""
    NO_SUBINDEX = 0x06090011
    """Subindex does not exist."""
    VALUE_RANGE = 0x06090030
    """Value range of parameter exceeded (write access only)."""
    VALUE_TOO_HIGH = 0x06090031
    """Value of parameter written too high."""
    VALUE_TOO_LOW = 0x06090032
    """Value of parameter written too low."""
    DEVICE_STATE = 0x08000022
    """Data cannot be transferred or stored because of the present device state."""
