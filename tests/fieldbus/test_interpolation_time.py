"""The interpolation time (0x60C2) in the forms that drives have it, on the in-process bus."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import SlaveConfig
from rtcp.fieldbus.errors import BusError
from rtcp.testing.bus import InProcessBus
from rtcp.virtual.models import CubemarsDrive, create
from rtcp.virtual.objects import Access, DataType, Entry, SdoAbort, Value

DEVICE = load(default_config()).slaves[1].device
NAME = "Interpolation time period"
U8, U16, U32, I8, I16 = (
    DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.INTEGER8, DataType.INTEGER16,
)  # fmt: skip
RW, RO = Access.RW, Access.RO
Form = tuple[tuple[DataType, int, Access], ...]
"""Type, value at power-on and rights of each subindex from 1 on."""
RECORD: Form = ((U8, 2, RW), (I8, -3, RW))


def started(form: Form, period_us: int, only: Callable[[Entry, Value], bool] | None = None) -> tuple[float, list[str]]:
    """Start a drive with the object in this form, which takes `only` some values; return its time, us, and notes."""
    model = create("cubemars-orh70")
    assert isinstance(model, CubemarsDrive)

    def check(entry: Entry, value: Value) -> None:
        if only is not None and not only(entry, value):
            raise SdoAbort(0x06090030)

    entries = [
        Entry(0x60C2, subindex, "part", kind, value, access, on_write=check)
        for subindex, (kind, value, access) in enumerate(form, 1)
    ]
    model.objects.remove(0x60C2)
    if entries:
        model.objects.record(0x60C2, NAME, entries)
    bus = InProcessBus([model])
    bus.configure([SlaveConfig("drive1", DEVICE, "devices/x.yaml")], period_us * 1000)
    value = entries[0].value if entries else 0
    exponent = entries[1].value if len(entries) > 1 else -3
    # A drive with an unsigned exponent holds 253 for -3.
    return value * 10.0 ** (exponent + 6 - 256 * (exponent > 127)), [note for note in bus.notes if "0x60C2" in note]


@pytest.mark.parametrize(
    ("form", "period_us"),
    [
        (RECORD, 1000),
        (RECORD, 500),
        (RECORD, 250),
        (((U8, 0, RW),), 2000),
        (((U8, 2, RO),), 2000),
        (((U8, 250, RO), (I8, -6, RO)), 250),
        (((U8, 25, RO), (I8, -5, RO)), 250),
        (((U8, 0, RW), (I8, -3, RO)), 4000),
        (((U16, 0, RW), (I8, -6, RW)), 333),
        (((U32, 1000, RW), (I8, -6, RO)), 500),
        (((U32, 1000, RW), (I16, -6, RO)), 500),
        (((U8, 1, RW), (U8, 0xFD, RO)), 2000),
    ],
)
def test_in_whatever_form_the_cycle_is_written_or_accepted(form: Form, period_us: int) -> None:
    assert started(form, period_us) == (pytest.approx(period_us), [])


def test_a_drive_that_takes_one_exponent_alone_is_given_the_cycle_in_it() -> None:
    for exponent, value in ((-4, 5), (-5, 50)):
        form = ((U8, 1, RW), (I8, -3, RW))
        allowed = {1: {value}, 2: {exponent}}
        assert started(form, 500, lambda entry, new, a=allowed: new in a[entry.subindex]) == (pytest.approx(500), [])  # type: ignore[misc]


@pytest.mark.parametrize(
    ("form", "period_us", "has", "why"),
    [
        (((U8, 1, RO), (I8, -3, RO)), 500, "is 1000 us", "read-only"),
        (((U8, 1, RW),), 500, "is 1000 us", "8 bits in ms cannot express the cycle"),
        (((U8, 1, RO),), 2000, "is 1000 us", "read-only"),
        (((U8, 1, RW), (I8, -3, RW)), 333, "is 1000 us", "8 bits cannot express the cycle"),
    ],
)
def test_another_time_than_the_cycle_that_stays_is_refused_with_both(
    form: Form, period_us: int, has: str, why: str
) -> None:
    with pytest.raises(BusError) as refused:
        started(form, period_us)
    text = str(refused.value)
    assert f"slave 1 (drive1): its interpolation time (0x60C2) {has}" in text
    assert f"the cycle (`cycle.period_us`) is {period_us} us" in text
    assert why in text


def test_no_such_object_and_one_that_is_0_are_noted() -> None:
    assert started((), 1000)[1] == ["slave 1 (drive1) has no interpolation time (0x60C2)"]
    assert "is 0 and was left as it is" in started(((U8, 0, RW),), 500)[1][0]
