"""Slaves of an ESI file or an SII image, under a master without device descriptions."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.segment import load_segment
from rtcp.esi.reader import find_device, read_esi
from rtcp.esi.sii import write_sii
from rtcp.virtual.behaviour import Behaviour, Option
from rtcp.virtual.coe import read, write
from rtcp.virtual.described import DescribedDevice
from rtcp.virtual.segment import check_segment, make_segment
from tests.findings import assert_finds
from tests.virtual.conftest import VENDOR, Master, abort_of, described

OP, PRE_OP = 8, 2
COUPLER, INPUTS, OUTPUTS, DRIVE, TWO = 0x10, 0x11, 0x12, 0x20, 0x30


def device(product: int, behaviour: type[Behaviour] | None = None, **options: object) -> DescribedDevice:
    description = find_device(read_esi(VENDOR), product=product)
    return DescribedDevice(description, lambda alias: write_sii(description, alias), behaviour, **options)


def assert_op(result: dict[str, Any], counter: int) -> None:
    assert (result["safe_op"], result["state"]) == (4, OP)
    assert result["codes"] == [[OP, 0]] * result["slaves"]
    # -1: the host delayed the frame beyond the master's timeout.
    assert {*result["counters"]} <= {counter, -1}
    assert counter in result["counters"]


def test_terminals_with_a_few_bits_without_mailbox_share_bytes_with_their_neighbours(master: Master) -> None:
    set_to = "behaviour: 'tests.virtual.test_described:Pattern', options: {levels: "
    result = master(
        described(COUPLER), described(INPUTS, set_to + "2}"), described(OUTPUTS), described(INPUTS, set_to + "1}"),
        described(OUTPUTS), outputs=("", "", "a5", "", "a5"),
    )  # fmt: skip
    assert_op(result, 1 + 2 + 1 + 2)
    assert result["inputs"][1:4:2] == ["06", "06"]  # the two share a byte: 2 in its low bits, 1 above them
    assert result["bytes"] == 2


class Pattern(Behaviour):
    """Shows levels at its inputs."""

    options = {"levels": Option(0, 0, 3, "levels", whole=True)}

    def on_start(self) -> None:
        levels = int(self.option("levels"))
        self[0x6000, 1], self[0x6010, 1] = levels & 1, levels >> 1


def test_a_drive_with_coe_of_an_esi_file_goes_to_op(master: Master) -> None:
    result = master(described(DRIVE), described(DRIVE, "alias: 7"))
    assert_op(result, 6)
    assert [len(data) for data in result["inputs"]] == [26, 26]
    assert result["dc"]


def test_two_sync_managers_a_direction_one_of_a_single_buffer_carry_bits_24_bits_and_bytes(master: Master) -> None:
    behaviour = "behaviour: 'tests.virtual.behaviours:Echo', options: {gain: 3}"
    outputs = (100_000).to_bytes(3, "little").hex() + f"{9 << 3:02x}" + bytes(range(31)).hex()
    result = master(described(TWO, behaviour), outputs=(outputs,))
    assert_op(result, 3)
    value, temperature, answer = result["inputs"][0][:6], result["inputs"][0][6:14], result["inputs"][0][14:]
    assert int.from_bytes(bytes.fromhex(value), "little", signed=True) == -300_000
    assert struct.unpack("<f", bytes.fromhex(temperature)) == (4.5,)
    assert int.from_bytes(bytes.fromhex(answer), "little") == sum(range(31))


def test_an_sii_image_alone_makes_the_same_slave(master: Master, tmp_path: Path) -> None:
    image = write_sii(find_device(read_esi(VENDOR), product=DRIVE))
    (tmp_path / "drive.bin").write_bytes(image)
    result = master("sii: drive.bin", "sii: drive.bin, alias: 5")
    assert_op(result, 6)
    assert [len(data) for data in result["inputs"]] == [26, 26]


def test_the_eeprom_is_that_of_the_description_with_the_alias_under_the_checksum(tmp_path: Path) -> None:
    image = write_sii(find_device(read_esi(VENDOR), product=DRIVE))
    (tmp_path / "drive.bin").write_bytes(image)
    config = tmp_path / "segment.yaml"
    config.write_text(f"slaves:\n- {{{described(DRIVE)}}}\n- sii: drive.bin\n- {{sii: drive.bin, alias: 5}}\n")
    slaves = make_segment(load_segment(config), 0).slaves
    assert [bytes(slave.esc.eeprom.image) == image for slave in slaves] == [True, True, False]
    assert (slaves[2].esc.get(0x0012, 2), slaves[2].esc.eeprom.image[14:]) == (5, slaves[2].esc.eeprom.image[14:])
    assert slaves[2].esc.get(0x0502, 2) & 0x0800 == 0


def assign(slave: DescribedDevice, index: int, *pdos: int) -> None:
    write(slave.objects, index, 0, False, PRE_OP, b"\0")
    for n, pdo in enumerate(pdos, 1):
        write(slave.objects, index, n, False, PRE_OP, pdo.to_bytes(2, "little"))
    write(slave.objects, index, 0, False, PRE_OP, bytes((len(pdos),)))


def test_pdos_that_exclude_each_other_and_mandatory_ones_rule_the_assignment() -> None:
    slave = device(DRIVE)
    assign(slave, 0x1C12, 0x1601)
    assert slave.lay_out(2).byte_length == 4
    assert abort_of(assign, slave, 0x1C12, 0x1600, 0x1601) == 0x06040043
    assert abort_of(assign, slave, 0x1C13, 0x1A01) == 0x06040043
    assign(slave, 0x1C13, 0x1A00, 0x1A01)
    assert abort_of(assign, slave, 0x1C12, 0x1A00) == 0x06040041
    assert abort_of(assign, slave, 0x1C12, 0x1602) == 0x06020000
    assert abort_of(assign, device(TWO), 0x1C12, 0x1700) == 0x06010002


def test_a_device_without_a_dictionary_has_the_objects_that_its_pdos_map() -> None:
    slave = device(DRIVE)
    assert read(slave.objects, 0x1600, 0, True, PRE_OP) == struct.pack("<BxIII", 3, 0x60400010, 0x607A0020, 0x60600008)
    assert read(slave.objects, 0x1018, 1, False, PRE_OP) == struct.pack("<I", 0x0E2A)
    assert abort_of(write, slave.objects, 0x6064, 0, False, PRE_OP, bytes(4)) == 0x06010002
    write(slave.objects, 0x607A, 0, False, PRE_OP, struct.pack("<i", -5))
    assert slave.objects[0x607A, 0].value == -5


MISTAKES = {
    "no such product": (described(0x99), ".product: description"),
    "no such file": ("esi: none.xml", ".esi: description"),
    "several devices": (f"esi: {VENDOR}", ".esi: description"),
    "a behaviour that is none": (described(DRIVE, "behaviour: toaster"), ".behaviour: choice"),
    "a module that is none": (described(DRIVE, "behaviour: 'no.such:Thing'"), ".behaviour: behaviour"),
    "an option that it has not": (
        described(TWO, "behaviour: 'tests.virtual.behaviours:Echo', options: {loss: 3}"),
        ".options.loss: unknown_option",
    ),
    "modules where there are no places": (described(DRIVE, "modules: [3]"), ".modules: description"),
    "no image": ("sii: segment.yaml", ".sii: description"),
    "two descriptions": ("esi: a.xml, sii: b.bin", ": one_of_keys found=esi and sii"),
    "a product of a model": ("model: diewu-io, product: 3", ".product: key_of_esi"),
}  # fmt: skip


@pytest.mark.parametrize(("entry", "expected"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_in_a_description_is_named_with_file_line_and_key(tmp_path: Path, entry: str, expected: str) -> None:
    config = tmp_path / "segment.yaml"
    config.write_text(f"slaves:\n- model: diewu-io\n- {{{entry}}}\n")
    assert_finds(lambda: check_segment(config), f"3 slaves[1]{expected}")
