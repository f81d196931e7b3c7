"""`rtcp foe`, `eeprom`, `alias`, `state` and `scan --describe`: real segments, each for as long as a command takes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.esi.sii import crc, write_sii
from tests.fieldbus.terminals import DEVICES, write_segment

pytestmark = pytest.mark.alone

Rtcp = Callable[..., Any]


@pytest.fixture
def files(arm: Path) -> tuple[str, ...]:
    """Options for a segment of a slave with files and one without mailbox."""
    write_segment(arm.parent / "segment.yaml", "files", "bits4, alias: 5")
    return ("--config", str(arm), "--bus", "virtual")


def test_an_image_goes_into_the_eeprom_only_where_it_is_sound_and_of_this_device(
    rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path
) -> None:
    image = tmp_path / "image.bin"
    ended = rtcp("eeprom", "read", "1", "--out", str(image), *files)
    assert (ended.code, image.read_bytes()) == (0, write_sii(DEVICES["files"]))
    changed = bytearray(image.read_bytes())
    changed[28:30] = b"\x2a\x00"  # its serial number
    image.write_bytes(changed)
    ended = rtcp("eeprom", "write", "1", str(image), "--yes", *files)
    assert (ended.code, ended.out.splitlines()[-1]) == (
        0, "slave 1: 1 words written and read back; switch it off and on to have it load them"
    )  # fmt: skip
    foreign = rtcp("eeprom", "write", "2", str(image), "--yes", *files)
    assert foreign.code == 3
    assert "the image is of vendor 0x00000E2A, product 0x00000028, the slave of vendor 0x00000E2A" in foreign.trouble
    image.write_bytes(bytes((changed[0] ^ 1,)) + changed[1:])
    damaged = rtcp("eeprom", "write", "1", str(image), "--yes", *files)
    assert damaged.code == 2
    assert f"the checksum in word 7 of the image is 0x{crc(changed[:14]):02X}" in damaged.trouble


def test_a_dump_shows_what_the_eeprom_says(rtcp: Rtcp, files: tuple[str, ...]) -> None:
    ended = rtcp("eeprom", "dump", "2", *files)
    assert ended.code == 0
    for part in ("Terminal 14", "product 0x0000000E", "alias 5", "SM0", "0x0F00", "RxPDO 0x1601", "BIT4", "value 1"):
        assert part in ended.out


def test_an_alias_is_written_under_the_checksum_and_a_state_is_left_as_it_was_requested(
    rtcp: Rtcp, files: tuple[str, ...]
) -> None:
    ended = rtcp("alias", "set", "1", "0x1234", *files)
    assert ended.out == "slave 1: alias 4660 written; switch it off and on to have it load it\n"
    assert rtcp("alias", "set", "1", "65536", *files).code == 2
    assert rtcp("state", "1", "boot", *files).out == "slave 1: BOOT\n"
    refused = rtcp("state", "2", "BOOT", *files)
    assert refused.code == 3
    assert "slave 2 (Terminal 14) did not reach BOOT" in refused.trouble
    assert rtcp("state", "2", "OP", *files).code == 2


def test_files_are_written_and_what_is_refused_is_told(rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path) -> None:
    firmware = tmp_path / "firmware"
    firmware.write_bytes(bytes(range(256)) * 8)
    ended = rtcp("foe", "write", "1", str(firmware), "--boot", *files)
    assert (ended.code, ended.out) == (0, "slave 1: 2048 bytes written to its file firmware\n")
    refused = rtcp("foe", "write", "1", str(firmware), *files)
    assert refused.code == 3
    assert "only in BOOT: add --boot" in refused.trouble
    absent = rtcp("foe", "read", "1", "nothing", "--out", str(tmp_path / "x"), *files)
    assert (absent.code, (tmp_path / "x").exists()) == (3, False)


def test_a_live_slave_describes_itself(rtcp: Rtcp, files: tuple[str, ...]) -> None:
    device = json.loads(rtcp("scan", "--describe", "1", "--json", *files).out)
    wanted = DEVICES["files"]
    assert device["identity"]["product_code"] == wanted.identity.product_code
    assert [(pdo["index"], pdo["sync_manager"]) for pdo in device["rx_pdos"]] == [(0x1601, 2)]
    (entry,) = device["tx_pdos"][0]["entries"]
    assert (entry["index"], entry["bits"], entry["type"], entry["name"]) == (0x6000, 16, "UINT", "value 1")
    assert [sm["start"] for sm in device["sync_managers"]] == [sm.start for sm in wanted.sync_managers]
    assert {0x1000, 0x1018, 0x1C12, 0x1601, 0x6000} <= {one["index"] for one in device["objects"]}
    assert device["mailbox"]["foe"]
    plain = rtcp("scan", "--describe", "2", *files)
    assert "TxPDO 0x1A01" in plain.out
    found = json.loads(rtcp("scan", "--json", *files).out)
    assert [(one["output_bits"], one["input_bits"]) for one in found] == [(16, 16), (4, 4)]
    assert found[0]["outputs"][0]["entries"][0]["name"] == "value 1"


@pytest.mark.parametrize(
    "command",
    [("foe", "read", "1", "x", "--out", "y"), ("eeprom", "dump", "1"), ("alias", "set", "1", "5"),
     ("state", "1", "INIT"), ("scan", "--describe", "1")],
)  # fmt: skip
def test_what_needs_the_bus_for_itself_is_refused_while_a_platform_holds_it(
    platform: Any, rtcp: Rtcp, command: tuple[str, ...]
) -> None:
    ended = rtcp(*command)
    assert ended.code == 3
    assert "holds the bus virtual" in ended.trouble
