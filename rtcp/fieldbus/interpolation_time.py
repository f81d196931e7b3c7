"""The interpolation time of a drive (0x60C2, CiA 402-2): value (subindex 1) times 10^exponent (subindex 2) seconds.

A drive that interpolates over another time than the cycle lags behind its targets, or stops between them: where a drive
has the object, it must give the cycle. Drives differ: some have subindex 1 alone, in ms; some have larger types, take
some exponents only, or cannot be written.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from rtcp.config.scaling import OBJECTS_PER_AXIS
from rtcp.fieldbus.bus import slave_label
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import ABSENT, SdoClient, abort_meaning
from rtcp.fieldbus.registers import Steps

INTERPOLATION_TIME: Final = 0x60C2
_VALUE, _EXPONENT = 1, 2
"""Subindices."""
_LARGEST: Final = 8
"""Most bytes of a value that count."""
_MS: Final = -3
"""Exponent of a drive without subindex 2."""


def expressions(period_ns: int, bits: int = 8) -> Iterator[tuple[int, int]]:
    """Yield each (value, exponent) with value * 10^exponent s = `period_ns`, a value of `bits`, smallest value first.

    500 us is (5, -4) and (50, -5); no byte expresses 333 us.
    """
    for exponent in range(9, -10, -1):
        value, rest = divmod(period_ns, 10 ** (exponent + 9))
        if not rest and 0 < value < 1 << bits:
            yield value, exponent


class OtherInterpolationTime(BusError):
    """A drive whose interpolation time is not the cycle."""


def set_interpolation_time(sdo: SdoClient, period_ns: int, axis: int = 1) -> Steps[list[str]]:
    """Let the interpolation time of an axis be the cycle; return a note where the drive has none, or keeps 0.

    Raises:
        OtherInterpolationTime: the drive has another time and does not take the cycle.
        BusError: it does not answer.
    """
    where = slave_label(sdo.position, sdo.name)
    index = INTERPOLATION_TIME + (axis - 1) * OBJECTS_PER_AXIS
    try:
        value = yield from sdo.reading(index, _VALUE)
    except SdoAborted as error:
        if error.code in ABSENT:
            return [f"{where} has no interpolation time (0x{index:04X})"]
        raise
    try:
        exponent: bytes | None = yield from sdo.reading(index, _EXPONENT)
    except SdoAborted as error:
        if error.code not in ABSENT:
            raise
        exponent = None
    kept_ns = _time_ns(value, exponent)
    present = _MS if exponent is None else _signed(exponent)
    # A drive takes most likely a time in the unit that it has.
    pairs = sorted(expressions(period_ns, 8 * min(len(value), _LARGEST)), key=lambda pair: pair[1] != present)
    if exponent is None:
        pairs = [pair for pair in pairs if pair[1] == _MS]
    why = f"{len(value) * 8} bits{' in ms' if exponent is None else ''} cannot express the cycle"
    for number, power in pairs:
        if kept_ns == period_ns:
            break
        try:
            yield from _write(sdo, index, _VALUE, number, len(value))
            if exponent is not None and power != _signed(exponent):
                yield from _write(sdo, index, _EXPONENT, power, len(exponent))
            why = "it does not keep what is written"
        except SdoAborted as error:
            why = f"a write is refused ({abort_meaning(error.code)})"
        value = yield from sdo.reading(index, _VALUE)
        exponent = exponent and (yield from sdo.reading(index, _EXPONENT))
        kept_ns = _time_ns(value, exponent)
    if kept_ns == period_ns:
        return []
    if kept_ns == 0:
        return [f"{where}: its interpolation time (0x{index:04X}) is 0 and was left as it is, by SYNC0: {why}"]
    raise OtherInterpolationTime(
        f"{where}: its interpolation time (0x{index:04X}) is {kept_ns / 1000:g} us, the cycle (`cycle.period_us`) is "
        f"{period_ns / 1000:g} us, and they must be equal: {why}; change the one that is wrong"
    )


def _write(sdo: SdoClient, index: int, subindex: int, number: int, size: int) -> Steps[None]:
    """Write a byte, or where the drive refuses that as many bytes as it has sent."""
    signed = subindex == _EXPONENT
    if signed or number < 1 << 8:
        try:
            yield from sdo.writing(index, subindex, number.to_bytes(1, "little", signed=signed))
            return
        except SdoAborted:
            if size == 1:
                raise
    yield from sdo.writing(index, subindex, number.to_bytes(size, "little", signed=signed))


def _signed(exponent: bytes) -> int:
    """Return an exponent by its lowest byte: a drive may send more bytes, with or without the sign."""
    return int.from_bytes(exponent[:1], "little", signed=True)


def _time_ns(value: bytes, exponent: bytes | None) -> int:
    """Return the time, ns; a part of 1 ns counts as 1 ns, so that it equals no cycle."""
    power = 9 + (_MS if exponent is None else _signed(exponent))
    number = int.from_bytes(value[:_LARGEST], "little")
    return int(number * 10**power if power >= 0 else -(-number // 10**-power))
