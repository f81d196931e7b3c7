"""`rtcp scan` and `rtcp sdo` through the running platform, and the values that `sdo` takes."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.cli.bus import _branches, decode, encode, parse_object
from rtcp.cli.output import CommandError
from rtcp.config.model import BITS


def test_a_scan_shows_identity_state_pdo_map_clock_and_delay(platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("scan")
    assert ended.code == 0
    for text in (
        "virtual: 1 slave", "DIEWU 16DI16DO", "vendor 0x00000D1E", "product 0x00161602", "revision 0x00010000",
        "serial 7", "PRE-OP", "CoE", "0x1080 128 bytes", "SM0 0x1000", "RxPDO 0x1600", "0x7000:1", "TxPDO 0x1A00",
        "(padding)", "2.4", "820", "0 open", "behind the master", "1 no link (3 damaged frames, 1 lost link)",
    ):  # fmt: skip
        assert text in ended.out
    assert max(len(line) for line in ended.out.splitlines()) <= 80


def test_the_slaves_of_a_branch_are_indented_and_the_last_branch_goes_on_where_its_junction_stands() -> None:
    tree = [(0, 0), (1, 3), (2, 1), (1, 1), (4, 1)]
    slaves = [{"position": n, "parent": parent, "parent_port": port} for n, (parent, port) in enumerate(tree, 1)]
    assert _branches(slaves) == [0, 1, 1, 0, 0]


def test_the_json_of_a_scan_is_the_list_of_slaves(platform: Any, rtcp: Callable[..., Any]) -> None:
    slaves = json.loads(rtcp("scan", "--json").out)
    assert [(slave["position"], slave["name"], slave["delay_ns"]) for slave in slaves] == [(1, "DIEWU 16DI16DO", 820)]


def test_a_bus_that_the_platform_does_not_use_is_opened_and_not_asked_of_it(
    platform: Any, rtcp: Callable[..., Any]
) -> None:
    ended = rtcp("scan", "--bus", "rtcp-none0")
    assert ended.code == 2
    assert "rtcp-none0" in ended.trouble
    assert platform.asked("scan") == []


@pytest.mark.parametrize("slave", ["3", "drive2"])
def test_a_slave_is_named_by_position_or_by_name(platform: Any, rtcp: Callable[..., Any], slave: str) -> None:
    platform.objects[3, 0x6041, 0] = b"\x37\x06"
    ended = rtcp("sdo", "read", slave, "0x6041", "--type", "uint16")
    assert (ended.code, ended.out) == (0, "1591\n")


def test_a_slave_of_no_such_name_is_refused_with_those_there_are(platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("sdo", "read", "drive9", "0x6041")
    assert ended.code == 2
    assert "drive9" in ended.trouble
    assert "io, drive1" in ended.trouble


def test_a_read_without_a_type_shows_hex_and_what_it_may_mean(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.objects[2, 0x6064, 0] = (-7071).to_bytes(4, "little", signed=True)
    platform.objects[2, 0x1008, 0] = b"Cubemars ORH70"
    assert rtcp("sdo", "read", "2", "6064h").out == "61 e4 ff ff   uint32 4294960225 (0xFFFFE461)   int32 -7071\n"
    assert "string 'Cubemars ORH70'" in rtcp("sdo", "read", "2", "0x1008").out


@pytest.mark.parametrize(
    ("value", "type_name", "written"),
    [
        ("-5", "int8", b"\xfb"), ("0x10", "uint16", b"\x10\x00"), ("-1", "INT32", b"\xff\xff\xff\xff"),
        ("-0.5", "float32", b"\x00\x00\x00\xbf"), ("-2e0", "float64", b"\0\0\0\0\0\0\0\xc0"), ("true", "bool", b"\x01"),
        ("arm", "string", b"arm"), ("01ff", "bytes", b"\x01\xff"), ("-2", "int24", b"\xfe\xff\xff"),
        ("18446744073709551615", "uint64", b"\xff" * 8),
    ],
)  # fmt: skip
def test_a_write_carries_the_bytes_of_its_type(
    platform: Any, rtcp: Callable[..., Any], value: str, type_name: str, written: bytes
) -> None:
    ended = rtcp("sdo", "write", "drive1", "0x6060:01", value, "--type", type_name)
    assert ended.code == 0
    assert platform.objects == {(2, 0x6060, 1): written}


@pytest.mark.parametrize(
    ("value", "type_name", "words"),
    [
        ("128", "int8", "128 does not fit int8: -128 to 127"), ("-1", "uint16", "-1 does not fit uint16: 0 to 65535"),
        ("1.5", "int16", "'1.5' is not a whole number"), ("-nan", "float32", "not finite"), ("1e39", "float32", "fit"),
        ("0xzz", "uint8", "whole number"), ("2", "bool", "does not fit bool"), ("0x0g", "bytes", "hex"),
        ("1", "uint12", "uint12"), ("0x1000000", "uint24", "0 to 16777215"), ("-1", "uint40", "0 to 1099511627775"),
    ],
)  # fmt: skip
def test_a_value_that_does_not_fit_its_type_is_refused(
    platform: Any, rtcp: Callable[..., Any], value: str, type_name: str, words: str
) -> None:
    ended = rtcp("sdo", "write", "1", "0x6060", value, "--type", type_name)
    assert ended.code == 2
    assert words in ended.trouble
    assert platform.requests == []


def test_a_misspelt_option_of_a_write_is_refused(platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("sdo", "write", "1", "0x6060", "-5", "--type", "int8", "--buss", "virtual")
    assert ended.code == 2
    assert "did you mean --bus?" in ended.trouble
    assert platform.requests == []


@pytest.mark.parametrize("text", ["6041", "0x", "0x12345", "0x6041:256", "0x6041:-1", "0x6041:x", "status", "0x6041:"])
def test_what_is_no_object_is_refused(platform: Any, rtcp: Callable[..., Any], text: str) -> None:
    ended = rtcp("sdo", "read", "1", text)
    assert ended.code == 2
    assert ended.trouble


def test_bytes_of_another_length_than_the_type_are_refused(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.objects[1, 0x6041, 0] = b"\x37\x06"
    ended = rtcp("sdo", "read", "1", "0x6041", "--type", "int32")
    assert ended.code == 2
    assert "2 bytes (3706), int32 has 4" in ended.trouble


@pytest.mark.parametrize(
    ("text", "address"),
    [("0x6041", (0x6041, 0)), ("6041H", (0x6041, 0)), ("0x1018:0x0A", (0x1018, 10)), ("1c12h:1", (0x1C12, 1))],
)
def test_an_object_is_written_in_hex_with_its_subindex(text: str, address: tuple[int, int]) -> None:
    assert parse_object(text) == address


@given(type_name=st.sampled_from([name for name in BITS if "int" in name]), number=st.integers(-(1 << 64), 1 << 65))
def test_an_integer_comes_back_as_it_was_or_is_refused(type_name: str, number: int) -> None:
    size, signed = BITS[type_name] // 8, type_name.startswith("int")
    fits = -(1 << 8 * size - 1) <= number < 1 << 8 * size - 1 if signed else 0 <= number < 1 << 8 * size
    if fits:
        assert decode(encode(str(number), type_name), type_name) == str(number)
    else:
        with pytest.raises(CommandError, match="does not fit"):
            encode(str(number), type_name)
