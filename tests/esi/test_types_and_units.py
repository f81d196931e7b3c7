"""Base types by name, number and length; their values; units in the notation of ETG.1004."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.esi import types
from rtcp.esi.model import EsiError
from rtcp.esi.types import Kind, decode, encode, named, of_bits, of_number, resolve
from rtcp.esi.units import unit


@pytest.mark.parametrize(
    ("name", "number", "bits", "kind"),
    [
        ("BOOL", 0x01, 1, Kind.UNSIGNED), ("BIT3", 0x32, 3, Kind.UNSIGNED), ("SINT", 0x02, 8, Kind.SIGNED),
        ("UINT16", 0x06, 16, Kind.UNSIGNED), ("INT24", 0x10, 24, Kind.SIGNED), ("UINT24", 0x16, 24, Kind.UNSIGNED),
        ("REAL", 0x08, 32, Kind.REAL), ("LREAL", 0x11, 64, Kind.REAL), ("ULINT", 0x1B, 64, Kind.UNSIGNED),
        ("STRING(50)", 0x09, 400, Kind.TEXT), ("visible_string(2)", 0x09, 16, Kind.TEXT),
        ("BITARR8", 0x2D, 8, Kind.UNSIGNED),
        ("ARRAY [0..30] OF BYTE", 0x0A, 248, Kind.BYTES), ("ARRAY[1..4] OF UDINT", 0x263, 128, Kind.BYTES),
    ],
)  # fmt: skip
def test_a_name_tells_number_length_and_kind(name: str, number: int, bits: int, kind: Kind) -> None:
    base_type = named(name)
    assert base_type is not None
    assert (base_type.number, base_type.bits, base_type.kind) == (number, bits, kind)


def test_what_is_no_base_type_is_the_plainest_of_its_length() -> None:
    assert named("DT607D") is None
    assert named("ARRAY [4..0] OF BYTE") is None
    assert [resolve("DT607D", bits).name for bits in (1, 7, 8, 24, 32, 64, 248)] == [
        "BOOL", "BIT7", "USINT", "UINT24", "UDINT", "ULINT", "ARRAY [0..30] OF BYTE",
    ]  # fmt: skip
    assert resolve("UINT", 8).name == "USINT"  # the length of the description counts


@given(st.sampled_from(sorted(types._BY_NUMBER)))
def test_a_number_tells_its_type_again(number: int) -> None:
    base_type = of_number(number, 0)
    assert base_type.number == number
    assert of_number(number, base_type.bits) == base_type


@given(st.integers(1, 64), st.integers(0, (1 << 64) - 1))
def test_numbers_of_every_length_come_back(bits: int, value: int) -> None:
    value %= 1 << bits
    data = encode(of_bits(bits), value) if of_bits(bits).kind is Kind.UNSIGNED else None
    if data is not None:
        assert len(data) == (bits + 7) // 8
        assert decode(of_bits(bits), data) == value


@pytest.mark.parametrize(
    ("name", "value", "data"),
    [
        ("DINT", -2, b"\xfe\xff\xff\xff"),
        ("INT24", -1, b"\xff\xff\xff"),
        ("BOOL", 1, b"\x01"),
        ("REAL", 1.5, b"\0\0\xc0\x3f"),
        ("STRING(4)", "ab", b"ab"),
        ("ARRAY [0..3] OF BYTE", b"\1\2", b"\1\2"),
    ],
)
def test_values_are_little_endian_bytes(name: str, value: types.Value, data: bytes) -> None:
    base_type = resolve(name, 0)
    assert encode(base_type, value) == data
    assert decode(base_type, data) == value


@pytest.mark.parametrize(
    ("name", "value"),
    [("USINT", 256), ("INT24", 1 << 24), ("DINT", "x"), ("STRING(1)", "ab"), ("REAL", "one"), ("SINT", float("inf"))],
)
def test_a_value_that_does_not_fit_is_refused(name: str, value: types.Value) -> None:
    with pytest.raises(EsiError, match="does not fit"):
        encode(resolve(name, 0), value)


@pytest.mark.parametrize(
    ("notation", "text", "factor", "si"),
    [
        (0xFD040000, "mA", 1e-3, "A"),
        (0x00B44700, "rpm", math.tau / 60, "rad/s"),
        (0xFFB44700, "0.1 rpm", math.tau / 600, "rad/s"),
        (0x00B50000, "inc", 1.0, "count"),
        (0x00B5B400, "inc/rev", 1 / math.tau, "count/rad"),
        (0xFE000000, "%", 0.01, ""),
        (0xFD000000, "‰", 0.001, ""),
        (0xFD560000, "mNm", 1e-3, "Nm"),
        (0xFD560400, "mNm/A", 1e-3, "Nm/A"),
        (0xFF2D0000, "0.1 °C", 0.1, "°C"),
        (0xF7030000, "ns", 1e-9, "s"),
        (0x00410000, "°", math.tau / 360, "rad"),
        (0xFF105700, "0.1 rad/s²", 0.1, "rad/s²"),
        (0x00B60300, "rpm/s", math.tau / 60, "rad/s²"),
    ],
)
def test_a_notation_tells_the_unit_and_its_factor_to_the_si(notation: int, text: str, factor: float, si: str) -> None:
    parsed = unit(notation)
    assert parsed is not None
    assert (parsed.text, parsed.si) == (text, si)
    assert parsed.factor == pytest.approx(factor, rel=1e-12)


def test_a_files_own_units_are_understood_by_their_symbol_or_kept_as_they_are() -> None:
    own = {0xA0: "%", 0xA1: "rad/s", 0xA2: "furlong"}
    assert unit(0x00A00000, own) == ("%", 0.01, "")
    assert unit(0xFD04A100, own) == ("mA/rad/s", 1e-3, "A/rad/s")
    assert unit(0x00A20000, own) == ("furlong", 1.0, "furlong")
    assert unit(0x00A20000) is None
