"""Compare the units of a CiA 402 drive with its device's file (IEC 61800-7-201, clause 7).

A drive whose encoder, gear or rated torque differ from the file would move its joint too far, or push too hard: it is
refused. A missing object gives a note.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Final

from rtcp.config.model import SlaveConfig
from rtcp.config.scaling import (
    FACTOR_TOLERANCE,
    OBJECTS_PER_AXIS,
    TORQUE_UNITS,
    VELOCITY_UNITS,
    DriveScaling,
)
from rtcp.fieldbus.drive_settings import UNREADABLE, axis_label
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.registers import Steps

_ENCODER, _GEAR, _FEED = 0x608F, 0x6091, 0x6092
"""Ratios: subindex 1 by subindex 2."""
_RATED_CURRENT, _RATED_TORQUE, _VELOCITY_UNIT = 0x6075, 0x6076, 0x60A9
_AMPERE_PER_COUNT: Final = 1e-3


def compare_scaling(sdo: SdoClient, config: SlaveConfig) -> Steps[list[str]]:
    """Read the units of each axis of a drive; return a sentence for each object that it lacks.

    Raises:
        BusError: its units differ from its device's file, or it does not answer.
    """
    device = config.device
    notes: list[str] = []
    faults: list[str] = []
    for axis in device.axes:
        scaling = device.scaling_of(axis)
        if scaling is None:
            continue
        where = axis_label(sdo, config, axis)
        lacking: list[str] = []
        for index, key, wanted, reading, unit in _compared(scaling, (axis - 1) * OBJECTS_PER_AXIS):
            actual = yield from reading(sdo, index)
            if actual is None:
                # Without a feed constant drive and file both use encoder and gear.
                if key != "feed_constant" or scaling.feed_constant is not None:
                    lacking.append(f"0x{index:04X} ({key})")
            elif not _equal(actual, wanted):
                faults.append(
                    f"{where}: the drive counts otherwise than its file: 0x{index:04X} holds {_text(actual)}{unit}, "
                    f"the file has {_text(wanted)} (key `{key}` of `scaling` in {config.file or 'its device file'}): "
                    "correct the one that is wrong before the arm moves"
                )
        if lacking:
            notes.append(f"{where} has no {', '.join(lacking)}: whether its file is right about it is not checked")
    if faults:
        raise BusError(*faults)
    return notes


Value = float | str
Reading = Callable[[SdoClient, int], Steps[Value | None]]


def _compared(scaling: DriveScaling, shift: int) -> Iterator[tuple[int, str, Value, Reading, str]]:
    """Yield object, key, the file's value, reader of the drive's value, and unit; `shift`: index offset of the axis."""
    yield _ENCODER + shift, "encoder_increments", scaling.encoder_increments, _ratio, " increments a motor revolution"
    yield _GEAR + shift, "gear_ratio", scaling.gear_ratio, _ratio, " motor revolutions a revolution of the output"
    if scaling.feed_constant != 0:
        counts_per_turn = scaling.counts_per_output_turn
        yield _FEED + shift, "feed_constant", counts_per_turn, _ratio, " counts a revolution of the output"
    for index, key, rated, unit, count in (
        (_RATED_TORQUE, "rated_torque", scaling.rated_torque, " Nm", TORQUE_UNITS[scaling.rated_torque_unit]),
        (_RATED_CURRENT, "rated_current", scaling.rated_current, " A", _AMPERE_PER_COUNT),
    ):
        if rated is not None:
            # The drive holds whole counts, so the file's value is rounded to counts.
            yield index + shift, key, round(rated / count) * count, _counts(count), unit
    yield _VELOCITY_UNIT + shift, "velocity_unit", scaling.velocity_unit, _velocity_unit, ""


def _equal(actual: Value, wanted: Value) -> bool:
    if isinstance(actual, str) or isinstance(wanted, str):
        return actual == wanted
    return math.isclose(actual, wanted, rel_tol=FACTOR_TOLERANCE)


def _text(value: Value) -> str:
    return value if isinstance(value, str) else f"{value:.10g}"


def _reading(sdo: SdoClient, index: int, subindex: int) -> Steps[int | None]:
    """Return an object as an unsigned integer; None: the drive lacks it, or it cannot be read."""
    try:
        return (yield from sdo.reading_int(index, subindex))
    except SdoAborted as error:
        if error.code in UNREADABLE:
            return None
        raise


def _ratio(sdo: SdoClient, index: int) -> Steps[Value | None]:
    """Return subindex 1 divided by subindex 2; None: the drive lacks them, or holds 0."""
    above = yield from _reading(sdo, index, 1)
    below = yield from _reading(sdo, index, 2)
    return above / below if above and below else None


def _counts(count: float) -> Reading:
    def read(sdo: SdoClient, index: int) -> Steps[Value | None]:
        counts = yield from _reading(sdo, index, 0)
        return counts * count if counts else None  # 0: not configured in the drive

    return read


def _velocity_unit(sdo: SdoClient, index: int) -> Steps[Value | None]:
    """Return the unit of velocities, as its number where `velocity_unit` does not know it."""
    code = yield from _reading(sdo, index, 0)
    return None if not code else VELOCITY_UNITS.get(code, f"the unit 0x{code:08X}")
