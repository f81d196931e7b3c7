"""Meanings of the numbers that slaves send: AL states, AL status codes (ETG.1020), error codes (CiA 301, 402-2)."""

from __future__ import annotations

ERROR_BIT = 0x10
"""Error indication in AL status, acknowledge in AL control (ETG.1000.6, 5.3.1 and 5.3.2)."""
STATE_NAMES = {0: "no answer", 1: "INIT", 2: "PRE-OP", 3: "BOOT", 4: "SAFE-OP", 8: "OP"}
"""AL states (ETG.1000.6, table 9); 0: no answer."""

# code: (meaning, remedy; empty where the meaning implies it)
AL_STATUS_CODES: dict[int, tuple[str, str]] = {
    0x0000: ("no error", ""),
    0x0001: ("unspecified error", "look at the device's own diagnosis"),
    0x0002: ("no memory", "map fewer objects"),
    0x0003: ("invalid device setup", "check its modules and its wiring"),
    0x0004: ("invalid revision", "compare its firmware with its description"),
    0x0006: ("SII and firmware do not match", "write the EEPROM that belongs to this firmware"),
    0x0007: ("firmware update not successful", "update its firmware again"),
    0x000E: ("licence error", "the device lacks a licence of its maker"),
    0x0011: ("invalid requested state change", "go through the states one by one"),
    0x0012: ("unknown requested state", ""),
    0x0013: ("bootstrap not supported", ""),
    0x0014: ("no valid firmware", "update its firmware"),
    0x0015: ("invalid mailbox configuration for BOOT", "compare SM0 and SM1 with its EEPROM"),
    0x0016: ("invalid mailbox configuration for PRE-OP", "compare SM0 and SM1 with its EEPROM"),
    0x0017: ("invalid sync manager configuration", "compare SM2 and SM3 with its PDO mapping"),
    0x0018: ("no valid inputs available", "the device cannot give input data yet"),
    0x0019: ("no valid outputs", "process data must arrive before OP is requested"),
    0x001A: ("synchronization error", "frames miss their SYNC0 window: check the cycle's jitter and `send_phase`"),
    0x001B: ("sync manager watchdog", "no process data came for longer than `watchdog_ms`"),
    0x001C: ("invalid sync manager types", ""),
    0x001D: ("invalid output configuration", "the length of SM2 differs from the assigned RxPDOs: check `rpdo`"),
    0x001E: ("invalid input configuration", "the length of SM3 differs from the assigned TxPDOs: check `tpdo`"),
    0x001F: ("invalid watchdog configuration", "check `watchdog_ms`"),
    0x0020: ("slave needs cold start", "switch it off and on"),
    0x0021: ("slave needs INIT", "request INIT first"),
    0x0022: ("slave needs PRE-OP", "request PRE-OP first"),
    0x0023: ("slave needs SAFE-OP", "request SAFE-OP first"),
    0x0024: ("invalid input mapping", "check `tpdo`"),
    0x0025: ("invalid output mapping", "check `rpdo`"),
    0x0026: ("inconsistent settings", "check `rpdo`, `tpdo` and `sdo` against its manual"),
    0x0027: ("free run not supported", "set `assign_activate` as in its ESI file"),
    0x0028: ("synchronization not supported", "set `assign_activate` to 0"),
    0x0029: ("free run needs three-buffer mode", ""),
    0x002A: ("background watchdog", "look at the device's own diagnosis"),
    0x002B: ("no valid inputs and outputs", ""),
    0x002C: ("fatal SYNC error: no SYNC0 was seen", "check `assign_activate` and distributed clocks"),
    0x002D: ("no SYNC error: SYNC0 was never seen", "check `assign_activate` and distributed clocks"),
    0x002E: ("cycle time too small", "choose a longer `period_us`"),
    0x0030: ("invalid DC SYNC configuration", "check `assign_activate` and `period_us`"),
    0x0031: ("invalid DC latch configuration", ""),
    0x0032: ("PLL error: the device cannot follow the master's clock", "check the cycle's jitter"),
    0x0033: ("DC SYNC IO error", "check the cycle's jitter"),
    0x0034: ("DC SYNC timeout: too many SYNC events were missed", "check the cycle's jitter"),
    0x0035: ("invalid DC SYNC cycle time", "check `period_us`"),
    0x0036: ("invalid DC SYNC0 cycle time", "check `period_us`"),
    0x0037: ("invalid DC SYNC1 cycle time", "check `assign_activate`"),
    0x0041: ("AoE mailbox error", ""),
    0x0042: ("EoE mailbox error", ""),
    0x0043: ("CoE mailbox error", ""),
    0x0044: ("FoE mailbox error", ""),
    0x0045: ("SoE mailbox error", ""),
    0x004F: ("VoE mailbox error", ""),
    0x0050: ("EEPROM no access", "the master must hand the EEPROM over to the device"),
    0x0051: ("EEPROM error", "check the device's EEPROM"),
    0x0052: ("external hardware is not ready", "check the device's supply"),
    0x0060: ("slave restarted locally", ""),
    0x0061: ("device identification value updated", ""),
    0x0070: ("detected module list does not match the configured one", ""),
    0x00F0: ("application controller available", ""),
}  # fmt: skip

# CiA 301, table 21; CiA 402-2, table 8.
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

# Remedies before `rtcp reset`; looked up as `ERROR_CODES` are.
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


def state_name(state: int) -> str:
    """Return the state in words; the error indication is named: `SAFE-OP + ERROR`."""
    base = state & 0x0F
    name = STATE_NAMES.get(base, f"unknown state {base}")
    return f"{name} + ERROR" if state & ERROR_BIT else name


def code_meaning(code: int) -> str:
    """Return the meaning of an AL status code (ETG.1020, or the maker's own)."""
    if code in AL_STATUS_CODES:
        return AL_STATUS_CODES[code][0]
    return "specific to the maker" if code >= 0x8000 else "not in ETG.1020"


def code_remedy(code: int) -> str:
    """Return the remedy for an AL status code; empty: none is known."""
    return AL_STATUS_CODES.get(code, ("", ""))[1]


def status_words(status: int, code: int) -> str:
    """Return AL status and AL status code in words, with the remedy if one is known."""
    if not status & ERROR_BIT:
        return state_name(status)
    remedy = code_remedy(code)
    return f"{state_name(status)} (0x{code:04X}: {code_meaning(code)})" + (f"; {remedy}" if remedy else "")


def refusal(slave: str, requested: int, state: int, code: int) -> str:
    """Return the message for a slave that did not reach a requested state.

    Args:
        slave: the slave as `bus.slave_label` names it.
        requested: AL state that was requested.
        state: AL state that it is in, error indication included.
        code: its AL status code; 0: none.
    """
    if not state & 0x0F:
        return f"{slave} did not reach {state_name(requested)}: it does not answer; check its cable and its supply"
    reason = f"AL status code 0x{code:04X}: {code_meaning(code)}" if code else "it gave no reason (AL status code 0)"
    remedy = code_remedy(code)
    return f"{slave} did not reach {state_name(requested)}: it is in {state_name(state)}; {reason}" + (
        f"; {remedy}" if remedy else ""
    )


def error_meaning(code: int) -> str:
    """Return the meaning of an error code (of an emergency or of object 0x603F)."""
    for known in (code, code & 0xFFF0, code & 0xFF00, code & 0xF000):
        if known in ERROR_CODES and (known or not code):
            return ERROR_CODES[known]
    return "not in CiA 402"


def error_remedy(code: int) -> str:
    """Return the remedy for an error code; empty: none is known."""
    return next(
        (REMEDIES[known] for known in (code, code & 0xFFF0, code & 0xFF00, code & 0xF000) if known in REMEDIES), ""
    )


def error_words(code: int) -> str:
    """Return an error code with its meaning and its remedy."""
    return f"0x{code:04X}: {error_meaning(code)}{error_advice(code)}"


def error_advice(code: int) -> str:
    """Return the remedy for an error code as the end of a sentence; empty: none is known."""
    remedy = error_remedy(code)
    return f"; {remedy}, then `rtcp reset`" if remedy else ""
