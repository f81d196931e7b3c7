"""Settings that a CiA 402 drive holds itself, beside its process data: limits, offsets, reactions to stops and faults.

They are read at the start, explained, and compared with what the joints need of them (`AxisNeeds`). A drive that would
let its joint fall, or move it, as soon as it is enabled is refused; other differences are notes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from rtcp.config.drive_limits import channel_factor, factor_of
from rtcp.config.model import DRIVEN_OUTPUTS, AxisNeeds, DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.config.scaling import (
    BOUNDING_OBJECTS,
    OBJECTS_PER_AXIS,
    QUICK_STOP_OPTION,
    TORQUE_UNITS,
    VELOCITY_UNITS,
    DriveScaling,
)
from rtcp.fieldbus.bus import slave_label
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import ABSENT, SdoClient
from rtcp.fieldbus.registers import Steps

Values = Mapping[tuple[int, int], bytes]
"""Objects as the drive holds them, little endian, by index of the first axis and subindex."""
Read = Callable[[int, int], Steps[bytes | None]]
"""Reads an object by index and subindex; None: the drive lacks it, or it cannot be read."""
Quantity = Literal["position", "velocity", "motor speed", "acceleration", "torque", "time"]

_WINDOW, _PROFILE_RATE, _QUICK_STOP_RATE, _OFFSET = 0x6065, 0x6084, 0x6085, 0x60B0
_TORQUES: Final = (0x6072, 0x60E0, 0x60E1)
_SPEEDS: Final = (0x607F, 0x6080)
_RANGE_LOW, _RANGE_HIGH = (0x607B, 1), (0x607B, 2)
_QUICK_STOP, _HALT, _FAULT_REACTION = QUICK_STOP_OPTION, 0x605D, 0x605E
_ADDED: Final = (0x60B1, 0x60B2)
"""Offsets that a drive adds to the output of its loops."""
_LIMITS: Mapping[tuple[int, int], tuple[str, Quantity]] = {
    (_WINDOW, 0): ("following error window", "position"),
    (0x6066, 0): ("following error time out", "time"),
    (0x6072, 0): ("max torque", "torque"),
    _RANGE_LOW: ("lowest position before it wraps", "position"),
    _RANGE_HIGH: ("highest position before it wraps", "position"),
    (0x607F, 0): ("max profile velocity", "velocity"),
    (0x6080, 0): ("max motor speed", "motor speed"),
    (_PROFILE_RATE, 0): ("profile deceleration", "acceleration"),
    (_QUICK_STOP_RATE, 0): ("quick stop deceleration", "acceleration"),
    (_OFFSET, 0): ("position offset", "position"),
    (0x60B1, 0): ("velocity offset", "velocity"),
    (0x60B2, 0): ("torque offset", "torque"),
    (0x60E0, 0): ("positive torque limit", "torque"),
    (0x60E1, 0): ("negative torque limit", "torque"),
}
"""Name and quantity of an object (IEC 61800-7-201)."""
_SIGNED: Final = {0x605A, 0x605B, 0x605C, _HALT, _FAULT_REACTION, 0x607B, _OFFSET, *_ADDED}
_SI: Mapping[Quantity, str] = {
    "position": "{}", "velocity": "{}/s", "motor speed": "{}/s", "acceleration": "{}/s^2", "torque": "Nm", "time": "s",
}  # fmt: skip
"""SI unit of a quantity; {}: the unit of positions."""
_OFF, _SLOW_DOWN, _RAMP = "the torque goes off at once", "slows down by 0x6084", "slows down by 0x6085"
_AT_CURRENT, _AT_VOLTAGE = "slows down at the current limit", "slows down at the voltage limit"
_STOPS: Final = (_SLOW_DOWN, _RAMP, _AT_CURRENT, _AT_VOLTAGE)
OPTIONS: Mapping[int, tuple[str, Mapping[int, str]]] = {
    _QUICK_STOP: ("quick stop option code", {
        0: _OFF,
        **{code: f"{stop}, then the torque goes off" for code, stop in enumerate(_STOPS, 1)},
        **{code: f"{stop}, then holds" for code, stop in enumerate(_STOPS, 5)},
    }),
    0x605B: ("shutdown option code", {0: _OFF, 1: f"{_SLOW_DOWN}, then the torque goes off"}),
    0x605C: ("disable operation option code", {0: _OFF, 1: f"{_SLOW_DOWN}, then the torque goes off"}),
    _HALT: ("halt option code", {code: f"{stop}, then holds" for code, stop in enumerate(_STOPS, 1)}),
    _FAULT_REACTION: ("fault reaction option code", {
        0: _OFF, **{code: f"{stop}, then the torque goes off" for code, stop in enumerate(_STOPS, 1)},
    }),
}  # fmt: skip
"""Name of each option code, and its values in words (IEC 61800-7-201)."""
_HOLDING: Final = range(5, 9)
"""Quick stop option codes after which the drive stays in quick stop active, with torque."""
_HALT_RATES: Mapping[int, int] = {1: _PROFILE_RATE, 2: _QUICK_STOP_RATE}
"""Halt option code that ramps down and holds -> the object with its deceleration."""
_BY_RATE: Final = (2, 6)
"""Quick stop option codes that use 0x6085."""
_ENCODER, _GEAR, _FEED = 0x608F, 0x6091, 0x6092
_RATED, _VELOCITY_UNIT, _ACCELERATION_UNIT = (0x6076, 0), (0x60A9, 0), (0x60AA, 0)
_UNITS: Final = (
    *((index, part) for index in (_ENCODER, _GEAR, _FEED) for part in (1, 2)), _RATED, _VELOCITY_UNIT,
    _ACCELERATION_UNIT,
)  # fmt: skip
OBJECTS: Final = (*_LIMITS, *((index, 0) for index in OPTIONS), *_UNITS)
"""Objects that `settings_of` and `compare` use, of the first axis: index and subindex."""
_MINUTE_S: Final = 60.0
_PER_SECOND: Final = {0x03: 0x57}
"""Denominator of a velocity -> that of its acceleration: s, s squared (ETG.1004). Others are followed by `s`."""
_ROUNDING: Final = 1e-3
"""Largest relative difference of a limit that the drive rounds to its counts."""
_WRITE_ONLY: Final = 0x06010001
UNREADABLE: Final = ABSENT | {_WRITE_ONLY}
"""Abort codes of an object that cannot be read."""


@dataclass(frozen=True)
class Setting:
    """A setting of a drive."""

    index: int
    """Object index, of its axis."""
    sub_index: int
    name: str
    raw: int
    """Value in the drive."""
    value: float | None
    """Value in `unit`, at the joint or, without a device file, at the drive's output; None: it has no scale."""
    unit: str
    meaning: str
    """What the value does, in words; empty: it is a number."""

    @property
    def text(self) -> str:
        """Object, name, value in the drive and in SI units, or its meaning."""
        return f"{self.name} ({self.where}) is {self.raw}" + (f", {self.scaled}" if self.scaled else "")

    @property
    def scaled(self) -> str:
        """The meaning, or the value with its unit; empty: unknown."""
        return self.meaning or ("" if self.value is None else f"{self.value:.4g} {self.unit}")

    @property
    def where(self) -> str:
        """Object, as messages name it."""
        return f"0x{self.index:04X}" + (f":{self.sub_index}" if self.sub_index else "")


def settings_of(values: Values, axis: int, device: DeviceDescription | None = None, unit: str = "rad") -> list[Setting]:
    """Return the settings of an axis.

    Args:
        values: objects of the axis, some of `OBJECTS`.
        axis: number of the axis, from 1.
        device: the drive's file, whose scale is used; None: that of its own objects, at its output shaft.
        unit: unit of the positions in that file, rad or m.
    """
    shift = (axis - 1) * OBJECTS_PER_AXIS
    settings = []
    for (index, sub_index), (name, quantity) in _LIMITS.items():
        if (data := values.get((index, sub_index))) is None:
            continue
        raw = _number(index, data)
        factor = _factor(index, quantity, values, axis, device, unit)
        value = None if factor is None else raw * factor
        meaning = "not supervised" if index == _WINDOW and _is_off(data) else ""
        settings.append(Setting(index + shift, sub_index, name, raw, value, _SI[quantity].format(unit), meaning))
    for index, (name, meanings) in OPTIONS.items():
        if (data := values.get((index, 0))) is not None:
            code = _number(index, data)
            meaning = meanings.get(code, "by the manual of the drive")
            settings.append(Setting(index + shift, 0, name, code, None, "", meaning))
    return sorted(settings, key=lambda setting: (setting.index, setting.sub_index))


def after_start(values: Values, config: SlaveConfig, axis: int) -> Values:
    """Return the settings of an axis with the start-up SDOs and the limits that the start writes into the drive."""
    shift = (axis - 1) * OBJECTS_PER_AXIS
    written = {
        (sdo.index - shift, sdo.sub_index): sdo.integer_data
        for sdo in (*config.device.sdo, *config.limits)
        if "int" in sdo.type
    }
    return {at: written.get(at, data) for at, data in values.items()}


def compare(
    values: Values, device: DeviceDescription, needs: AxisNeeds | None, where: str, file: str, axis: int = 1
) -> tuple[list[str], list[str]]:
    """Return notes and faults, in sentences: where the settings of an axis differ from what is needed of them.

    Args:
        values: objects of the axis, some of `OBJECTS`. For a mapped object the channel's `safe` counts.
        device: the drive's file.
        needs: of its joint; None: it moves none, and only its reaction to a quick stop is looked at.
        where: the slave and its axis, in words.
        file: the device's file, in words.
        axis: number of the axis, from 1.
    """
    sent = {
        (entry.index - (axis - 1) * OBJECTS_PER_AXIS, entry.sub_index): _data(entry)
        for pdo, entry in _outputs(device)
        if entry.safe is not None and pdo.axis_of(entry) == axis
    }
    values = {**values, **sent}
    found = {
        (setting.index - (axis - 1) * OBJECTS_PER_AXIS, setting.sub_index): setting
        for setting in settings_of(values, axis, device, "rad" if needs is None else needs.unit)
    }
    remedy = f"write another value among the start-up SDOs of {file}"
    notes = [f"{where}: {text}" for text in _stop_notes(found, needs, remedy)]
    if needs is None:
        return notes, []
    notes += [f"{where}: {text}: {remedy}" for text in _limit_notes(found, values, needs)]
    return notes, [f"{where}: {text}" for text in _faults(found, needs, remedy)]


def _stop_notes(found: Mapping[tuple[int, int], Setting], needs: AxisNeeds | None, remedy: str) -> Iterator[str]:
    stop, fault = found.get((_QUICK_STOP, 0)), found.get((_FAULT_REACTION, 0))
    if stop is not None:
        keys = "" if needs is None or not needs.quick_stops else f"; `stops` has it for {', '.join(needs.quick_stops)}"
        if stop.raw not in _HOLDING:
            yield f"after a quick stop it does not hold: {stop.text}; 5 to 8 hold{keys}: {remedy}"
        elif stop.raw not in _BY_RATE:
            yield (
                f"{stop.text}; the times and distances of the stop reactions follow from 0x6085, which it does not "
                f"use: {remedy}"
            )
    if needs is not None and fault is not None and fault.raw <= 0:
        drops = "the torque goes off at once, and the joint moves on until its brake closes"
        then = drops if fault.raw == 0 else "it reacts as its maker has made it, which `rtcp` does not know"
        yield f"{fault.text}; in a fault, and when frames no longer reach it, {then}; 2 slows down by 0x6085: {remedy}"


def _limit_notes(found: Mapping[tuple[int, int], Setting], values: Values, needs: AxisNeeds) -> Iterator[str]:
    joint = needs.joint
    for index in _TORQUES:
        limit = found.get((index, 0))
        if limit is None or limit.value is None or limit.raw == 0:
            continue
        if limit.value < needs.holding_torque:
            yield (
                f"{limit.text}, and {joint} needs {needs.holding_torque:.4g} Nm to carry the arm in the worst pose of "
                "its range: enabled there, the arm sags"
            )
        elif limit.value < needs.supervised_torque < math.inf:
            yield (
                f"{limit.text}, and the supervision stops {joint} at {needs.supervised_torque:.4g} Nm, which the drive "
                "never gives"
            )
    for index in _SPEEDS:
        limit = found.get((index, 0))
        if limit is not None and limit.value is not None and limit.value < needs.velocity * (1 - _ROUNDING):
            wanted = f"{needs.velocity:.4g} {limit.unit}"
            yield f"{limit.text}, and the speed limit of {joint} is {wanted}, which it does not reach"
    window = found.get((_WINDOW, 0))
    allowed = needs.following_error
    if window is not None and window.value is not None and not window.meaning and window.value < allowed < math.inf:
        yield (
            f"{window.text}, and the supervision of {joint} allows {allowed:.4g} {window.unit}: the drive goes to "
            "fault first"
        )
    rate = found.get((_QUICK_STOP_RATE, 0))
    if rate is not None and rate.value is not None and rate.value < needs.deceleration:
        yield (
            f"{rate.text}, and a quick stop of {joint} needs at least {needs.deceleration:.4g} {rate.unit} to end "
            "while the platform waits for it"
        )
    profile = found.get((_PROFILE_RATE, 0)) if needs.halt_deceleration else None
    for unscaled in (rate, profile):
        if unscaled is None or unscaled.value is not None or _ACCELERATION_UNIT not in values:
            continue
        unit = int.from_bytes(values[_ACCELERATION_UNIT], "little")
        yield (
            f"{unscaled.text} counts of the unit 0x{unit:08X} (0x60AA), which is not that of velocities by the "
            f"second: the times and distances of the stop reactions do not hold for {joint}"
        )
    for index in _ADDED:
        offset = found.get((index, 0))
        named = "velocity_offset" if index == _ADDED[0] else "torque_offset"
        if offset is not None and offset.raw and named not in needs.driven:
            yield f"{offset.text}, which it adds to the output of its loops"


def _faults(found: Mapping[tuple[int, int], Setting], needs: AxisNeeds, remedy: str) -> Iterator[str]:
    joint = needs.joint
    for index in _TORQUES:
        limit = found.get((index, 0))
        if limit is not None and limit.raw == 0:
            yield f"{limit.text}: enabled, {joint} has no torque, and the arm falls: {remedy}"
    offset = found.get((_OFFSET, 0))
    if offset is not None and offset.raw:
        yield f"{offset.text}: enabled, {joint} would move by it: write 0"
    if needs.halt_deceleration:
        yield from _halt_faults(found, needs, remedy)
    low, high = found.get(_RANGE_LOW), found.get(_RANGE_HIGH)
    if low is None or high is None or not low.raw < high.raw or low.value is None or high.value is None:
        return
    ends, (lowest, highest) = sorted((low.value, high.value)), needs.position
    if not ends[0] <= lowest <= highest <= ends[1]:
        yield (
            f"its position wraps at {ends[0]:.4g} and {ends[1]:.4g} {low.unit} ({low.text}; {high.text}), and {joint} "
            f"uses {lowest:.4g} to {highest:.4g} {low.unit} there: it would turn the other way round. Allowed is a "
            "range of the joint, with its zero offset, that does not reach the ends; or write 0 to both, where the "
            "drive then counts on"
        )


def _halt_faults(found: Mapping[tuple[int, int], Setting], needs: AxisNeeds, remedy: str) -> Iterator[str]:
    """Yield why an external axis that is halted before the end of its range would not be at rest there."""
    axis, halt = needs.joint, found.get((_HALT, 0))
    code = 1 if halt is None else halt.raw
    if halt is not None and code not in _HALT_RATES:
        yield (
            f"{halt.text}, and {axis} is halted before the end of its range: allowed are 1 and 2, which ramp down by "
            f"0x6084 and 0x6085, and hold: {remedy}"
        )
    for index in dict.fromkeys((_PROFILE_RATE, _HALT_RATES.get(code, _PROFILE_RATE))):
        rate = found.get((index, 0))
        if rate is not None and rate.value is not None and rate.value < needs.halt_deceleration * (1 - _ROUNDING):
            yield (
                f"{rate.text}, and `acceleration` of {axis} is {needs.halt_deceleration:.4g} {rate.unit}: halted, it "
                f"would need a longer way than is kept to the end of its range: {remedy}, or lower `acceleration`"
            )


def _factor(
    index: int, quantity: Quantity, values: Values, axis: int, device: DeviceDescription | None, unit: str
) -> float | None:
    """Return the SI units per count of an object; None: unknown."""
    if quantity == "time":
        return 1e-3
    scaling = _own_scaling(values) if device is None else device.scaling_of(axis)
    if device is not None:
        shifted = index + (axis - 1) * OBJECTS_PER_AXIS
        # A file that names an object says what it counts in: makers differ from the standard there.
        stated = [factor_of(device, entry) for entry in device.limits if entry.index == shifted]
        wanted = _SI[quantity].format(unit)
        stated += [e.factor for _, e in _outputs(device) if e.index == shifted and e.unit == wanted]
        if stated and stated[0] is not None:
            return abs(stated[0])
    if quantity == "motor speed":
        if scaling is None:
            return None
        return 2.0 * math.pi / _MINUTE_S / abs(scaling.gear_ratio * scaling.external_gear_ratio)
    if quantity == "acceleration" and not _counts_velocities(values):
        return None
    physical = "velocity" if quantity == "acceleration" else quantity
    factor = None if device is None else channel_factor(device, physical, axis)
    if factor is None and scaling is not None:
        factor = scaling.factor(physical)
    return None if factor is None else abs(factor)


def _own_scaling(values: Values) -> DriveScaling | None:
    """Return the scale of a drive's own objects, torques at the shaft of its rated torque; None: it has too few."""
    encoder, gear, feed = (_ratio(values, index) for index in (_ENCODER, _GEAR, _FEED))
    if not (encoder or feed):
        return None
    unit = VELOCITY_UNITS.get(_unsigned(values, _VELOCITY_UNIT) or 0x00B50300)
    if unit is None:
        return None
    return DriveScaling(
        encoder_increments=encoder or (feed or 1.0) / (gear or 1.0),
        gear_ratio=gear or 1.0,
        feed_constant=feed,
        velocity_unit=unit,
        rated_torque=_unsigned(values, _RATED) * TORQUE_UNITS["mNm"] or None,
        torque_at="output",
    )


def _ratio(values: Values, index: int) -> float | None:
    above, below = _unsigned(values, (index, 1)), _unsigned(values, (index, 2))
    return above / below if above and below else None


def _counts_velocities(values: Values) -> bool:
    """Whether accelerations are velocities by the second: 0x60AA is missing or 0, or the unit of 0x60A9 by `s`."""
    acceleration, velocity = _unsigned(values, _ACCELERATION_UNIT), _unsigned(values, _VELOCITY_UNIT)
    if not acceleration:
        return True
    same_angle = acceleration >> 16 == velocity >> 16
    time, wanted = acceleration >> 8 & 0xFF, velocity >> 8 & 0xFF
    return same_angle and time == _PER_SECOND.get(wanted, wanted)


def _unsigned(values: Values, at: tuple[int, int]) -> int:
    return int.from_bytes(values.get(at, b""), "little")


def _number(index: int, data: bytes) -> int:
    return int.from_bytes(data, "little", signed=index in _SIGNED)


def _data(entry: PdoEntry) -> bytes:
    """Return the safe value of an output as the drive holds it."""
    counts = round((entry.safe or 0.0) / entry.factor)
    return (counts & (1 << entry.length) - 1).to_bytes(-(-entry.length // 8), "little")


def _is_off(data: bytes) -> bool:
    """Whether a following error window is that of no supervision, the largest number."""
    return data == b"\xff" * len(data)


# -- at the start ---------------------------------------------------------------------------------------------------


def reading_values(read: Read, axis: int) -> Steps[Values]:
    """Return those of `OBJECTS` that an axis has."""
    values = {}
    for index, sub_index in OBJECTS:
        data = yield from read(index + (axis - 1) * OBJECTS_PER_AXIS, sub_index)
        if data:
            values[index, sub_index] = data
    return values


def reader(sdo: SdoClient) -> Read:
    """Return a function that reads a slave's objects in steps."""

    def read(index: int, sub_index: int) -> Steps[bytes | None]:
        try:
            return (yield from sdo.reading(index, sub_index))
        except SdoAborted as error:
            if error.code in UNREADABLE:
                return None
            raise

    return read


def check_settings(sdo: SdoClient, config: SlaveConfig) -> Steps[tuple[DeviceDescription, list[str]]]:
    """Read the settings of each axis of a drive that is set up, in PRE-OP, and compare them.

    Returns:
        The description of the device, with the drive's own value as `safe` of each output that `rtcp` does not drive
        and whose file states none; and notes.

    Raises:
        BusError: enabled, its joint would fall or move by itself; or an own value cannot be read.
    """
    device, read = config.device, reader(sdo)
    if device.kind != "cia402" or not device.coe:
        return device, []
    file = config.file or "its device file"
    device, faults = yield from _with_own_values(sdo, config, read)
    notes: list[str] = []
    for axis in device.axes:
        values = yield from reading_values(read, axis)
        where = axis_label(sdo, config, axis)
        noted, refused = compare(values, device, config.needs_of(axis), where, file, axis)
        notes += noted
        faults += refused
    if faults:
        raise BusError(*faults)
    return device, notes


def axis_label(sdo: SdoClient, config: SlaveConfig, axis: int) -> str:
    """Return slave and axis, in words."""
    return slave_label(sdo.position, sdo.name) + ("" if config.device.axes == (1,) else f", axis {axis}")


def _outputs(device: DeviceDescription) -> Iterator[tuple[Pdo, PdoEntry]]:
    """Yield the outputs that are numbers and not driven by the driver of the drive, with their PDOs."""
    for pdo in device.rpdo:
        for entry in pdo.channels:
            if entry.is_number and entry.name not in DRIVEN_OUTPUTS:
                yield pdo, entry


def _with_own_values(sdo: SdoClient, config: SlaveConfig, read: Read) -> Steps[tuple[DeviceDescription, list[str]]]:
    """Return the description with the drive's own values, and a sentence for each that it cannot tell."""
    device, faults = config.device, []
    driven = {(needs.axis, name) for needs in config.needs for name in needs.driven}
    own: dict[tuple[int, int], float] = {}
    remedy = f"state `safe` at the channel in {config.file or 'its device file'}"
    for pdo, entry in _outputs(device):
        if entry.safe is not None or (pdo.axis_of(entry), entry.name) in driven:
            continue
        data = yield from read(entry.index, entry.sub_index)
        where, axis = f"0x{entry.index:04X}:{entry.sub_index} ({entry.name})", pdo.axis_of(entry)
        if not data:
            faults.append(
                f"{axis_label(sdo, config, axis)}: {where} is always sent to it, and its own value cannot be read: "
                f"{remedy}"
            )
            continue
        counts = int.from_bytes(data, "little", signed=entry.type.startswith("int"))
        own[entry.index, entry.sub_index] = counts * entry.factor
        bound = BOUNDING_OBJECTS.get(entry.index - (axis - 1) * OBJECTS_PER_AXIS)
        if bound is not None and not counts:
            faults.append(
                f"{axis_label(sdo, config, axis)}: {where} is 0 in the drive, and 0 would always be sent: enabled it "
                f"would have no torque, or no motion ({bound}): {remedy}"
            )
    return replace(device, rpdo=_stated(device.rpdo, own)), faults


def _stated(pdos: Sequence[Pdo], own: Mapping[tuple[int, int], float]) -> tuple[Pdo, ...]:
    return tuple(
        replace(
            pdo,
            channels=tuple(
                replace(entry, safe=own[entry.index, entry.sub_index])
                if (entry.index, entry.sub_index) in own
                else entry
                for entry in pdo.channels
            ),
        )
        for pdo in pdos
    )
