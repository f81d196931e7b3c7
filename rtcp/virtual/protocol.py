"""Constants of the data link layer: frames, datagram commands, registers (ETG.1000.4; names as in the standard)."""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import Final

REGISTER_SPACE = 0x1000
"""End of the registers and start of the process data RAM."""
RAM_SIZE = 0x2000
"""Process data RAM, bytes: 8 KiB; register 0x0006 has it in KiB."""
FMMU_COUNT = 8
SM_COUNT = 8
FMMU_SIZE = 16
SM_SIZE = 8


class Register(IntEnum):
    """Start addresses of this controller's registers."""

    TYPE = 0x0000
    FMMUS = 0x0004
    SYNC_MANAGERS = 0x0005
    RAM = 0x0006
    PORT_DESCRIPTOR = 0x0007
    FEATURES = 0x0008
    STATION_ADDRESS = 0x0010
    ALIAS = 0x0012
    ESC_RESET = 0x0040
    DL_CONTROL = 0x0100
    DL_STATUS = 0x0110
    AL_CONTROL = 0x0120
    AL_STATUS = 0x0130
    AL_STATUS_CODE = 0x0134
    PDI_CONTROL = 0x0140
    EVENT_MASK = 0x0200
    EVENT_REQUEST = 0x0210
    AL_EVENT_REQUEST = 0x0220
    RX_ERRORS = 0x0300
    FORWARDED_RX_ERRORS = 0x0308
    LOST_LINKS = 0x0310
    WATCHDOG_DIVIDER = 0x0400
    WATCHDOG_PDI = 0x0410
    WATCHDOG_PROCESS_DATA = 0x0420
    WATCHDOG_STATUS = 0x0440
    WATCHDOG_COUNTERS = 0x0442
    EEPROM_CONFIG = 0x0500
    EEPROM_PDI_ACCESS = 0x0501
    EEPROM_CONTROL = 0x0502
    EEPROM_ADDRESS = 0x0504
    EEPROM_DATA = 0x0508
    FMMU = 0x0600
    SYNC_MANAGER = 0x0800
    DC_RECEIVE_TIME = 0x0900
    DC_SYSTEM_TIME = 0x0910
    DC_RECEIVE_TIME_UNIT = 0x0918
    DC_OFFSET = 0x0920
    DC_DELAY = 0x0928
    DC_DIFFERENCE = 0x092C
    DC_SPEED_START = 0x0930
    DC_FILTER = 0x0934
    DC_CYCLIC_UNIT = 0x0980
    DC_ACTIVATION = 0x0981
    DC_ACTIVATION_STATUS = 0x0984
    DC_SYNC0_STATUS = 0x098E
    DC_SYNC1_STATUS = 0x098F
    DC_START_TIME = 0x0990
    DC_NEXT_SYNC1 = 0x0998
    DC_SYNC0_CYCLE = 0x09A0
    DC_SYNC1_CYCLE = 0x09A4
    DC_LATCH_CONTROL = 0x09A8
    USER_RAM = 0x0F80


class AlState(IntEnum):
    """AL states in AL control and AL status (ETG.1000.6, table 9)."""

    INIT = 1
    PRE_OP = 2
    BOOTSTRAP = 3
    SAFE_OP = 4
    OP = 8


STATE_MASK: Final = 0x0F
ERROR_FLAG: Final = 0x10
"""In AL status: a request was refused or the state was left on an error; in AL control: acknowledgement."""


class EcatEvent(IntFlag):
    """Bits of the ECAT event request register 0x0210 (ETG.1000.4, table 38)."""

    DC_LATCH = 0x0001
    DL_STATUS = 0x0004
    AL_STATUS = 0x0008
    SYNC_MANAGER_0 = 0x0010
    """Event of SM 0; SM n has bit 4 + n."""


# (first, last) addresses writable by the master; all others are read-only (ETG.1000.4, clause 6, access types).
# Sync managers and the EEPROM interface restrict it further, see esc.py and sii.py.
WRITABLE = (
    (0x0010, 0x0011),
    (0x0040, 0x0040),
    (0x0100, 0x0103),
    (0x0120, 0x0121),
    (0x0200, 0x0201),
    (0x0300, 0x0313),
    (0x0400, 0x0401),
    (0x0410, 0x0411),
    (0x0420, 0x0421),
    (0x0442, 0x0443),
    (0x0500, 0x0500),
    (0x0502, 0x050F),
    (Register.FMMU, Register.FMMU + FMMU_COUNT * FMMU_SIZE - 1),
    (Register.SYNC_MANAGER, Register.SYNC_MANAGER + SM_COUNT * SM_SIZE - 1),
    (0x0F80, 0x0FFF),
)
# The same for the optional distributed clock unit.
WRITABLE_DC = (
    (0x0900, 0x0903),
    (0x0910, 0x0917),
    (0x0920, 0x092B),
    (0x0930, 0x0931),
    (0x0934, 0x0935),
    (0x0980, 0x0981),
    (0x0990, 0x0997),
    (0x09A0, 0x09A9),
)
ONLY_IN_64_BITS = (0x0914, 0x0924, 0x0994)
"""Upper four bytes of the writable times: reserved, and read as 0, where clocks have 32 bits (ETG.1000.4, 6.8)."""
SYSTEM_TIME_SPACE = (0x0910, 0x0980)
"""Addresses that a slave which only measures delays has not, end excluded."""
ERROR_COUNTERS = ((0x0300, 0x030C), (0x030C, 0x030D), (0x030D, 0x030E), (0x0310, 0x0314))
"""Groups of error counters, ends excluded: a write to any one clears its group (ET1100, 0x0300 to 0x0313)."""
DC_SPACE = (0x0900, 0x0A00)
"""Addresses of the distributed clock unit, end excluded."""

# Values after power-on (ETG.1000.4, clause 6); the type and build are those of this software, not of a chip.
DEFAULTS: tuple[tuple[int, bytes], ...] = (
    (Register.TYPE, bytes((0x11, 0x01, 0x01, 0x00))),
    (Register.FMMUS, bytes((FMMU_COUNT,))),
    (Register.SYNC_MANAGERS, bytes((SM_COUNT,))),
    (Register.RAM, bytes((RAM_SIZE // 1024,))),
    (Register.PORT_DESCRIPTOR, bytes((0x0F,))),  # ports 0 and 1 are MII, 2 and 3 absent
    (Register.DL_CONTROL, bytes((0x01, 0x00, 0x07, 0x00))),
    (Register.AL_STATUS, bytes((AlState.INIT, 0x00))),
    (Register.PDI_CONTROL, bytes((0x08, 0x00))),  # 16-bit asynchronous microcontroller interface
    (Register.WATCHDOG_DIVIDER, (0x09C2).to_bytes(2, "little")),  # (2498 + 2) * 40 ns = 100 us a step
    (Register.WATCHDOG_PDI, (1000).to_bytes(2, "little")),
    (Register.WATCHDOG_PROCESS_DATA, (1000).to_bytes(2, "little")),  # 100 ms
    (Register.WATCHDOG_STATUS, bytes((0x01, 0x00))),
    (Register.DC_SPEED_START, (0x1000).to_bytes(2, "little")),
    (Register.DC_FILTER, bytes((0x00, 0x0C))),
)

FEATURE_DC = 0x0004
FEATURE_DC_64 = 0x0008
FEATURE_SEPARATE_FCS = 0x0080
FEATURE_DC_SYNC_ENHANCED = 0x0100


ETHERTYPE = 0x88A4
ETHERNET_HEADER: Final = 14
VLAN_TAG: Final = 4
"""Bytes of an IEEE 802.1Q tag before the EtherType."""
FRAME_HEADER: Final = 2
"""Bytes of the EtherCAT header: 11 bits length, 1 reserved, 4 bits type (1: datagrams)."""
FIRST_DATAGRAM: Final = ETHERNET_HEADER + FRAME_HEADER
DATAGRAM_HEADER: Final = 10
COUNTER: Final = 2
"""Bytes of the working counter after a datagram's data."""
LENGTH_MASK: Final = 0x07FF
MORE_FOLLOWS: Final = 0x8000
TYPE_DATAGRAMS: Final = 0x1
MAX_FRAME = 1514
LOCAL_BIT: Final = 0x02
"""Locally administered bit in the first byte of the source address; the first slave sets it."""

HEADER = struct.Struct("<BBHHHH")
"""Command, index, address (position or station), offset, length and flags, event request."""


class DatagramCommand(IntEnum):
    """Datagram commands (ETG.1000.4, 5.4)."""

    NOP = 0
    APRD = 1
    APWR = 2
    APRW = 3
    FPRD = 4
    FPWR = 5
    FPRW = 6
    BRD = 7
    BWR = 8
    BRW = 9
    LRD = 10
    LWR = 11
    LRW = 12
    ARMW = 13
    FRMW = 14


class MailboxType(IntEnum):
    """Protocols of a mailbox message (ETG.1000.4, table 29)."""

    ERROR = 0x0
    AOE = 0x1
    EOE = 0x2
    COE = 0x3
    FOE = 0x4
    SOE = 0x5
    VOE = 0xF
