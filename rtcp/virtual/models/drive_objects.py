"""The objects of a Cubemars ORH drive (CiA 402-2, ETG.6010), as tables.

All positions, velocities, accelerations and torques have 10000 counts per rad, rad/s, rad/s^2 and Nm, unlike the
standard's increments and per mille of the rated torque: vendor-specific, like the 32-bit actual torque.
"""

from __future__ import annotations

from rtcp.virtual.models.mechanics import ENCODER_INCREMENTS, GEAR_RATIO, ActuatorSize
from rtcp.virtual.objects import Access, DataType, Entry, ObjectCode, ObjectDictionary, SdoAbort, Value, WriteHook

COUNTS = 10000.0
UNIT = 1.0 / COUNTS

TORQUE_LIMIT = 50.0
POSITION_RANGE = 12.5
VELOCITY_RANGE = 10.0
ACCELERATION_LIMIT = 4.0
TEMPERATURE_LOCK = 90.0
VOLTAGE_LOCK = 60.0
HISTORY_LENGTH = 8

HOMING_METHODS = (33, 34, 35, 37)
"""Next index pulse in negative or positive direction; present position (old and new number)."""
SUPPORTED_MODES = (1, 3, 6, 8, 9, 10)

_I8, _I16, _I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32
_U8, _U16, _U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
_RO, _RW = Access.RO, Access.RW
_RX, _TX = Access.RW | Access.RXPDO, Access.RO | Access.TXPDO

Row = tuple[int, str, DataType, int, Access]
_VALUE_RANGE_EXCEEDED = 0x06090030


def _only(*allowed: int) -> WriteHook:
    def check(_: Entry, value: Value) -> None:
        if value not in allowed:
            raise SdoAbort(_VALUE_RANGE_EXCEEDED)

    return check


_STATE_AND_MODE: tuple[Row, ...] = (
    (0x603F, "Error code", _U16, 0, _TX),
    (0x6040, "Controlword", _U16, 0, _RX),
    (0x6041, "Statusword", _U16, 0, _TX),
    (0x605A, "Quick stop option code", _I16, 2, _RW),
    (0x605B, "Shutdown option code", _I16, 0, _RW),
    (0x605C, "Disable operation option code", _I16, 1, _RW),
    (0x605D, "Halt option code", _I16, 1, _RW),
    (0x605E, "Fault reaction option code", _I16, 2, _RW),
    (0x6060, "Modes of operation", _I8, 0, _RX),
    (0x6061, "Modes of operation display", _I8, 0, _TX),
    (0x6502, "Supported drive modes", _U32, sum(1 << mode - 1 for mode in SUPPORTED_MODES), _RO),
)
_POSITION: tuple[Row, ...] = (
    (0x6062, "Position demand value", _I32, 0, _TX),
    (0x6063, "Position actual internal value", _I32, 0, _TX),
    (0x6064, "Position actual value", _I32, 0, _TX),
    (0x6065, "Following error window", _U32, 1000, _RW),
    (0x6066, "Following error time out", _U16, 50, _RW),
    (0x6067, "Position window", _U32, 10, _RW),
    (0x6068, "Position window time", _U16, 10, _RW),
    (0x607A, "Target position", _I32, 0, _RX),
    (0x607C, "Home offset", _I32, 0, _RW),
    (0x60B0, "Position offset", _I32, 0, _RX),
    (0x60F4, "Following error actual value", _I32, 0, _TX),
)
_VELOCITY: tuple[Row, ...] = (
    (0x606B, "Velocity demand value", _I32, 0, _TX),
    (0x606C, "Velocity actual value", _I32, 0, _TX),
    (0x606D, "Velocity window", _U16, 100, _RW),
    (0x606E, "Velocity window time", _U16, 10, _RW),
    (0x606F, "Velocity threshold", _U16, 50, _RW),
    (0x6070, "Velocity threshold time", _U16, 10, _RW),
    (0x6080, "Max motor speed", _U32, round(VELOCITY_RANGE * COUNTS), _RW),
    (0x6081, "Profile velocity", _U32, 10000, _RX),
    (0x6083, "Profile acceleration", _U32, round(ACCELERATION_LIMIT * COUNTS), _RX),
    (0x6084, "Profile deceleration", _U32, round(ACCELERATION_LIMIT * COUNTS), _RX),
    (0x6085, "Quick stop deceleration", _U32, 100000, _RW),
    (0x6086, "Motion profile type", _I16, 0, _RW),
    (0x6098, "Homing method", _I8, 37, _RW),
    (0x609A, "Homing acceleration", _U32, 10000, _RW),
    (0x60B1, "Velocity offset", _I32, 0, _RX),
    (0x60C5, "Max acceleration", _U32, round(ACCELERATION_LIMIT * COUNTS), _RW),
    (0x60FF, "Target velocity", _I32, 0, _RX),
)
_TORQUE: tuple[Row, ...] = (
    (0x6071, "Target torque", _I32, 0, _RX),
    (0x6074, "Torque demand value", _I32, 0, _TX),
    (0x6077, "Torque actual value", _I32, 0, _TX),
    (0x6078, "Current actual value", _I16, 0, _TX),
    (0x60B2, "Torque offset", _I32, 0, _RX),
)
_ALLOWED = {
    0x605A: (0, 1, 2, 5, 6),
    0x605B: (0, 1),
    0x605C: (0, 1),
    0x605D: (1, 2),
    0x605E: (0, 1, 2),
    0x6086: (0,),
    0x6098: HOMING_METHODS,
}
"""Allowed values of SDO writes; others get abort 0x06090030."""
_BOUNDS = {
    0x6080: (0, round(VELOCITY_RANGE * COUNTS)),
    0x6083: (1, 0xFFFFFFFF),
    0x6084: (1, 0xFFFFFFFF),
    0x6085: (1, 0xFFFFFFFF),
    0x609A: (1, 0xFFFFFFFF),
    0x60C5: (1, round(ACCELERATION_LIMIT * COUNTS)),
}


def define_objects(objects: ObjectDictionary, size: ActuatorSize, sync_error_limit: int) -> None:
    """Add the objects of a drive of this size, except identity and PDO objects (0x16xx, 0x1Axx, 0x1Cxx)."""
    for index, name, data_type, value, access in _STATE_AND_MODE + _POSITION + _VELOCITY + _TORQUE:
        low, high = _BOUNDS.get(index, (None, None))
        hook = _only(*_ALLOWED[index]) if index in _ALLOWED else None
        objects.variable(index, name, data_type, value, access, minimum=low, maximum=high, on_write=hook)
    # The error register is mappable.
    objects[0x1001, 0].access = _TX
    _add_synchronisation(objects, sync_error_limit)
    _add_limits(objects, size)
    _add_history(objects)


def _record(objects: ObjectDictionary, index: int, name: str, *entries: Entry) -> None:
    obj = objects.record(index, name, list(entries))
    obj.entries[0].value = obj.highest_subindex


def _add_synchronisation(objects: ObjectDictionary, limit: int) -> None:
    """Add 0x10F1 and 0x1C32/0x1C33 (ETG.1020), which the slave's application updates."""
    _record(objects, 0x10F1, "Error settings",
            Entry(0x10F1, 1, "Local error reaction", _U32, 1, _RW),
            Entry(0x10F1, 2, "Sync error counter limit", _U16, limit, _RW))  # fmt: skip
    for index, name in ((0x1C32, "Output sync manager parameter"), (0x1C33, "Input sync manager parameter")):
        _record(objects, index, name,
                Entry(index, 1, "Synchronization type", _U16, 1, _RW),
                Entry(index, 2, "Cycle time", _U32, 0, _RW),
                Entry(index, 3, "Shift time", _U32, 0, _RO),
                Entry(index, 4, "Synchronization types supported", _U16, 0x0007, _RO),
                Entry(index, 5, "Minimum cycle time", _U32, 100_000, _RO),
                Entry(index, 6, "Calc and copy time", _U32, 10_000, _RO),
                Entry(index, 11, "SM event missed counter", _U16, 0, _RO),
                Entry(index, 12, "Cycle exceeded counter", _U16, 0, _RO),
                Entry(index, 32, "Sync error", DataType.BOOLEAN, 0, _RO))  # fmt: skip


def _add_limits(objects: ObjectDictionary, size: ActuatorSize) -> None:
    position = round(POSITION_RANGE * COUNTS)
    torque = round(min(TORQUE_LIMIT, size.start_stop_torque) * COUNTS)
    speed = round(size.speed_limit * COUNTS)
    objects.variable(0x6072, "Max torque", _U32, torque, _RX, maximum=round(size.start_stop_torque * COUNTS))
    objects.variable(0x6075, "Motor rated current", _U32, round(size.rated_current * 1000))
    objects.variable(0x6076, "Motor rated torque", _U32, round(size.rated_torque * COUNTS))
    objects.variable(0x607F, "Max profile velocity", _U32, speed, _RX, maximum=round(VELOCITY_RANGE * COUNTS))
    _record(objects, 0x607D, "Software position limit",
            Entry(0x607D, 1, "Minimum", _I32, -position, _RW, minimum=-position, maximum=position),
            Entry(0x607D, 2, "Maximum", _I32, position, _RW, minimum=-position, maximum=position))  # fmt: skip
    _record(objects, 0x608F, "Position encoder resolution",
            Entry(0x608F, 1, "Encoder increments", _U32, ENCODER_INCREMENTS),
            Entry(0x608F, 2, "Motor revolutions", _U32, 1))  # fmt: skip
    _record(objects, 0x6091, "Gear ratio",
            Entry(0x6091, 1, "Motor revolutions", _U32, GEAR_RATIO),
            Entry(0x6091, 2, "Shaft revolutions", _U32, 1))  # fmt: skip
    _record(objects, 0x6099, "Homing speeds",
            Entry(0x6099, 1, "Speed during search for switch", _U32, 2000, _RW),
            Entry(0x6099, 2, "Speed during search for zero", _U32, 1000, _RW))  # fmt: skip
    _record(objects, 0x60C2, "Interpolation time period",
            Entry(0x60C2, 1, "Value (0: the SYNC0 cycle)", _U8, 0, _RW),
            Entry(0x60C2, 2, "Exponent", _I8, -3, _RW, minimum=-6, maximum=0))  # fmt: skip
    _record(objects, 0x2000, "Drive condition",
            Entry(0x2000, 1, "Motor temperature (0.1 C)", _I16, 0, _TX),
            Entry(0x2000, 2, "Bus voltage (10 mV)", _U16, 0, _TX),
            Entry(0x2000, 3, "Overload integrator (0.1 %)", _U16, 0, _TX))  # fmt: skip
    _record(objects, 0x2001, "Firmware limits",
            Entry(0x2001, 1, "Torque limit", _U32, round(TORQUE_LIMIT * COUNTS)),
            Entry(0x2001, 2, "Position range", _U32, position),
            Entry(0x2001, 3, "Velocity range", _U32, round(VELOCITY_RANGE * COUNTS)),
            Entry(0x2001, 4, "Acceleration limit", _U32, round(ACCELERATION_LIMIT * COUNTS)),
            Entry(0x2001, 5, "Temperature lock (0.1 C)", _I16, round(TEMPERATURE_LOCK * 10)),
            Entry(0x2001, 6, "Voltage lock (10 mV)", _U16, round(VOLTAGE_LOCK * 100)))  # fmt: skip


def _add_history(objects: ObjectDictionary) -> None:
    """Add 0x1003 (CiA 301): the newest error at subindex 1; writing 0 to subindex 0 clears it."""
    slots = [Entry(0x1003, place, f"Standard error field {place}", _U32) for place in range(1, HISTORY_LENGTH + 1)]

    def clear(_: Entry, value: Value) -> None:
        if value != 0:
            raise SdoAbort(_VALUE_RANGE_EXCEEDED)
        for slot in slots:
            slot.value = 0

    history = objects.record(0x1003, "Pre-defined error field", list(slots), code=ObjectCode.ARRAY, count_access=_RW)
    history.entries[0].value = 0
    history.entries[0].on_write = clear
