from __future__ import annotations

import struct

import pytest

from rtcp.config.model import DataTypeName, DeviceDescription, Pdo, PdoEntry, SlaveConfig
from rtcp.devices.driver import Driver, make_codec
from rtcp.fieldbus.pdo import layout

BITS = Pdo(0x1A00, tuple(PdoEntry(0x6000, i, "bool", f"in{i}") for i in range(1, 4)))
PADDING = Pdo(0x1A01, tuple(PdoEntry(0, 0, "bool", f"pad{i}") for i in range(3)))
REST = Pdo(0x1A02, (PdoEntry(0x6010, 1, "int16", "value"), PdoEntry(0x6010, 2, "float32", "ratio")))


def test_an_image_of_whole_bytes_is_little_endian_without_gaps() -> None:
    codec = make_codec(layout((REST,)))
    assert codec.pack(-2, 1.5) == b"\xfe\xff\x00\x00\xc0\x3f"
    assert codec.unpack(b"\xfe\xff\x00\x00\xc0\x3f") == (-2, 1.5)


def test_single_bits_stand_from_bit_0_upwards() -> None:
    codec = make_codec(layout((BITS, PADDING, REST)))
    image = codec.pack(1, 0, 1, 0, 0, 0, -2, 1.5)
    assert int.from_bytes(image, "little") == 0b101 | 0xFFFE << 6 | 0x3FC00000 << 22
    assert codec.unpack(image) == (1, 0, 1, 0, 0, 0, -2, 1.5)


@pytest.mark.parametrize(("pdos", "bits", "length"), [((BITS,), 3, 1), ((BITS, PADDING, REST), 54, 7), ((), 0, 0)])
def test_a_layout_knows_its_length(pdos: tuple[Pdo, ...], bits: int, length: int) -> None:
    assert (layout(pdos).bits, layout(pdos).bytes) == (bits, length)


def entry(kind: DataTypeName, bits: int | None = None, index: int = 0x6000) -> PdoEntry:
    return PdoEntry(index, 1, kind, kind, bits=bits)


@pytest.mark.parametrize(
    ("kind", "bits", "value", "image"),
    [("int24", None, -2, "fe ff ff"), ("uint40", None, 0x0102030405, "05 04 03 02 01"), ("int56", None, -1, "ff " * 7),
     ("bits", 3, 5, "05"), ("bits", 12, 0xABC, "bc 0a"), ("bits", 64, 1 << 63, "00 " * 7 + "80"),
     ("bytes", 24, 0x030201, "01 02 03"), ("float32", None, 1.5, "00 00 c0 3f")],
)  # fmt: skip
def test_every_type_stands_in_the_image_as_long_as_it_is_also_behind_a_single_bit(
    kind: DataTypeName, bits: int | None, value: float, image: str
) -> None:
    codec = make_codec(layout((Pdo(0x1A00, (entry(kind, bits),)),)))
    assert codec.pack(value) == bytes.fromhex(image)
    assert codec.unpack(bytes.fromhex(image)) == (value,)
    shifted = make_codec(layout((Pdo(0x1A00, (entry("bits", 5, index=0), entry("bool"), entry(kind, bits))),)))
    assert (
        int.from_bytes(shifted.pack(0, 1, value), "little") == int.from_bytes(bytes.fromhex(image), "little") << 6 | 32
    )
    assert shifted.unpack(shifted.pack(0, 1, value)) == (0, 1, value)


def test_a_value_that_does_not_fit_is_never_sent_as_another_one() -> None:
    codec = make_codec(layout((Pdo(0x1A00, (entry("int24"),)),)))
    with pytest.raises(struct.error, match=r"int24: 8388608 does not fit int24: -8388608 to 8388607"):
        codec.pack(1 << 23)


def test_a_driver_offers_arrays_of_bytes_beside_its_numbers() -> None:
    outputs = Pdo(0x1600, (entry("bytes", 16), entry("bits", 8, index=0), entry("uint8")))
    inputs = Pdo(0x1A00, (entry("bytes", 24), entry("int24")))
    driver = Driver(SlaveConfig("a", DeviceDescription("d", "any", 1, 2, (outputs,), (inputs,))), 0.001)
    assert [field.name for field in driver.fields()] == ["int24", "uint8"]
    driver.decode(bytes.fromhex("01 02 03 ff ff ff"))
    assert (driver.arrays, driver.values) == ({"bytes": bytes((1, 2, 3))}, {"int24": -1.0})
    driver.array_targets["bytes"] = b"\x0a\x0b"
    driver.targets["uint8"] = 300.0
    assert driver.encode() == bytes.fromhex("0a 0b 00 ff")
