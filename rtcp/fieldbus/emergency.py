"""CoE emergency messages and their error codes in words (ETG.1000.6, 5.6.4; CiA 301, table 21; CiA 402-2, table 8)."""

from __future__ import annotations

import struct
from dataclasses import dataclass

EMERGENCY = 1
"""CoE service of an emergency (ETG.1000.6, table 29)."""
_MESSAGE = struct.Struct("<HHB5s")

# Exact codes first; a code that is not listed takes the meaning of its class (low byte, then low 12 bits cleared).
ERROR_CODES: dict[int, str] = {
    0x0000: "error reset, or no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2100: "current on the input side",
    0x2200: "current inside the device",
    0x2300: "current on the output side",
    0x2310: "continuous over-current",
    0x2320: "short circuit or earth leakage",
    0x2330: "earth leakage",
    0x2340: "short circuit",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3200: "DC link voltage",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x3300: "output voltage",
    0x4000: "temperature",
    0x4100: "ambient temperature",
    0x4200: "device temperature",
    0x4210: "excess temperature of the device",
    0x4300: "drive temperature",
    0x4310: "excess temperature of the drive",
    0x5000: "device hardware",
    0x5100: "supply",
    0x5110: "low-voltage supply",
    0x5200: "control circuit",
    0x5300: "operating unit",
    0x5400: "power section",
    0x5441: "contactor 1: safe torque off",
    0x5500: "data storage",
    0x6000: "device software",
    0x6100: "internal software",
    0x6200: "user software",
    0x6300: "data record",
    0x6320: "parameter error",
    0x7000: "additional modules",
    0x7100: "power",
    0x7110: "brake chopper",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7122: "motor error or commutation malfunction",
    0x7300: "sensor",
    0x7305: "incremental sensor 1",
    0x7306: "incremental sensor 2",
    0x7310: "speed",
    0x7320: "position",
    0x7500: "communication inside the device",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "overrun: objects lost",
    0x8120: "error passive",
    0x8130: "life guard or heartbeat error",
    0x8180: "communication lost",
    0x8200: "protocol error",
    0x8210: "PDO not processed: length error",
    0x8220: "PDO length exceeded",
    0x8300: "torque control",
    0x8311: "excess torque",
    0x8313: "standstill torque",
    0x8331: "torque fault",
    0x8400: "velocity control: over-speed",
    0x8500: "position control",
    0x8600: "positioning controller",
    0x8611: "following error",
    0x8612: "reference limit",
    0x8700: "synchronization",
    0x8800: "winding controller",
    0x8900: "process data monitoring",
    0x8A00: "control",
    0x9000: "external error",
    0xA000: "state change of the EtherCAT state machine",
    0xF000: "additional functions",
    0xFF00: "specific to the maker",
}

# What to do about it, before `rtcp reset`; found as the meanings are.
REMEDIES: dict[int, str] = {
    0x2000: "check the motor's cables for a short circuit and the joint for something that blocks it",
    0x2310: "check the joint for something that blocks or overloads it",
    0x3000: "check the supply: its voltage and its plugs",
    0x3210: "check the supply's voltage, and brake more slowly where it rises while the arm brakes",
    0x3220: "check the supply: its voltage under load and its plugs",
    0x4000: "let it cool down, and check the load and the surroundings",
    0x5000: "switch it off and on; where it comes again, the drive is broken",
    0x5100: "check the supply of its electronics",
    0x5441: "check the safety circuit: safe torque off is asked for",
    0x6000: "switch it off and on; where it comes again, ask the maker",
    0x6320: "compare the `sdo` entries of its device file with its manual",
    0x7120: "check the motor's cables and the joint for something that blocks it",
    0x7300: "check the encoder and its cable",
    0x8100: "check the bus's cables; the master may have been stopped",
    0x8200: "compare `rpdo` and `tpdo` of its device file with its manual",
    0x8300: "check the joint for something that blocks or overloads it",
    0x8400: "check what drove the joint so fast: its load, and its limits of speed",
    0x8500: "check the joint for something that blocks it, and its limits of speed and acceleration",
    0x8600: "check the joint for something that blocks it, and its limits of speed and acceleration",
    0x8700: "frames miss their SYNC0: check the cycle's jitter (`rtcp doctor`)",
    0x9000: "check what is wired to its inputs",
}


@dataclass(frozen=True)
class Emergency:
    """An emergency message as it came from a slave."""

    position: int
    """Position of the slave on the cable, from 1."""
    name: str
    """Name of the slave."""
    error_code: int
    error_register: int
    """Object 0x1001 at the time."""
    data: bytes
    """Five bytes of the maker's."""

    @property
    def is_problem(self) -> bool:
        """Whether it reports an error; code 0 takes the one before back (CiA 301, 7.2.7)."""
        return self.error_code != 0

    def sentence(self) -> str:
        """Return the message in words."""
        return (
            f"slave {self.position} ({self.name}) sent emergency 0x{self.error_code:04X}: "
            f"{error_meaning(self.error_code)} (error register 0x{self.error_register:02X}, data {self.data.hex(' ')})"
            f"{_advice(self.error_code)}"
        )


def error_meaning(code: int) -> str:
    """Return what an error code (of an emergency or of object 0x603F) means."""
    for known in (code, code & 0xFFF0, code & 0xFF00, code & 0xF000):
        if known in ERROR_CODES and (known or not code):
            return ERROR_CODES[known]
    return "not in CiA 402"


def error_remedy(code: int) -> str:
    """Return what can be done about an error code; empty where nothing is known."""
    return next(
        (REMEDIES[known] for known in (code, code & 0xFFF0, code & 0xFF00, code & 0xF000) if known in REMEDIES), ""
    )


def error_words(code: int) -> str:
    """Return an error code with its meaning and what to do about it."""
    return f"0x{code:04X}: {error_meaning(code)}{_advice(code)}"


def _advice(code: int) -> str:
    remedy = error_remedy(code)
    return f"; {remedy}, then `rtcp reset`" if remedy else ""


def parse(message: bytes, position: int, name: str) -> Emergency | None:
    """Return the emergency in a CoE message, None where it holds something else.

    Args:
        message: CoE header of two bytes and what follows (ETG.1000.6, 5.6.4.2).
        position: position of the slave on the cable.
        name: name of the slave.
    """
    if len(message) < _MESSAGE.size:
        return None
    coe, code, register, data = _MESSAGE.unpack_from(message)
    return Emergency(position, name, code, register, data) if coe >> 12 == EMERGENCY else None
