from __future__ import annotations

import pytest

from rtcp.config.model import Pdo, PdoEntry
from rtcp.devices.driver import make_codec
from rtcp.fieldbus.pdo import layout

BITS = Pdo(0x1A00, tuple(PdoEntry(0x6000, i, "bool", f"in{i}") for i in range(1, 4)))
PADDING = Pdo(0x1A01, tuple(PdoEntry(0, 0, "bool", f"pad{i}") for i in range(3)))
REST = Pdo(0x1A02, (PdoEntry(0x6010, 1, "int16", "value"), PdoEntry(0x6010, 2, "float32", "ratio")))


def test_an_image_of_whole_bytes_is_little_endian_without_gaps():
    codec = make_codec(layout((REST,)))
    assert codec.pack(-2, 1.5) == b"\xfe\xff\x00\x00\xc0\x3f"
    assert codec.unpack(b"\xfe\xff\x00\x00\xc0\x3f") == (-2, 1.5)


def test_single_bits_stand_from_bit_0_upwards():
    codec = make_codec(layout((BITS, PADDING, REST)))
    image = codec.pack(1, 0, 1, 0, 0, 0, -2, 1.5)
    assert int.from_bytes(image, "little") == 0b101 | 0xFFFE << 6 | 0x3FC00000 << 22
    assert codec.unpack(image) == (1, 0, 1, 0, 0, 0, -2, 1.5)


@pytest.mark.parametrize(("pdos", "bits", "length"), [((BITS,), 3, 1), ((BITS, PADDING, REST), 54, 7), ((), 0, 0)])
def test_a_layout_knows_its_length(pdos, bits, length):
    assert (layout(pdos).bits, layout(pdos).bytes) == (bits, length)
