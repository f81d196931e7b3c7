"""The completed dictionary: of a drive whose file has some objects, and of a terminal whose file has none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.esi.dictionary import complete, default_assignment
from rtcp.esi.model import Device, DictionaryObject, InitCommand, ObjectCode, ObjectEntry, PdoEntry
from rtcp.esi.modules import assemble
from rtcp.esi.reader import find_device, read_esi

FILES = Path(__file__).parent / "files"


@pytest.fixture(scope="module")
def drive() -> Device:
    return find_device(read_esi(FILES / "drive.xml"), product=0x402)


def objects(device: Device) -> dict[int, DictionaryObject]:
    objects = {item.index: item for item in complete(device).objects}
    assert list(objects) == sorted(objects)
    return objects


def numbers(item: DictionaryObject) -> list[int]:
    return [int.from_bytes(entry.default or b"", "little") for entry in item.entries]


def test_the_default_assignment_is_that_of_the_pdos(drive: Device) -> None:
    assert {number: [pdo.index for pdo in pdos] for number, pdos in default_assignment(drive).items()} == {
        2: [0x1600],
        3: [0x1A00],
    }


def test_pdos_are_assigned_in_the_order_of_their_sync_managers_and_those_of_no_process_data_are_not(
    drive: Device,
) -> None:
    pdo = replace(drive.tx_pdos[0], excludes=frozenset())
    device = replace(
        drive,
        tx_pdos=(
            replace(pdo, index=0x1A01, sync_manager=5),
            replace(pdo, index=0x1A02, sync_manager=3),
            replace(pdo, index=0x1A03, sync_manager=None),
            replace(pdo, index=0x1A04, sync_manager=3, virtual=True),
        ),
    )
    assert [pdo.index for pdo in device.assigned(outputs=False)] == [0x1A02, 0x1A01]
    assert {number: len(pdos) for number, pdos in default_assignment(device).items()} == {2: 1, 3: 1, 5: 1}


def test_identity_and_sync_managers_have_objects(drive: Device) -> None:
    dictionary = objects(drive)
    assert numbers(dictionary[0x1000]) == [0x00020192]
    assert numbers(dictionary[0x1018]) == [4, 0xE51, 0x402, 0x20001, 0]
    assert numbers(dictionary[0x1C00]) == [4, 1, 2, 3, 4]
    assert numbers(dictionary[0x1C12]) == [1, 0x1600, 0]
    assert numbers(dictionary[0x1C13]) == [1, 0x1A00]
    assert [entry.writable for entry in dictionary[0x1C12].entries] == [True] * 3
    assert dictionary[0x1C12].entries[1].write_states == "P"
    assert [number for number in dictionary if 0x1C10 <= number < 0x1C20] == [0x1C10, 0x1C11, 0x1C12, 0x1C13]


def test_pdos_have_mapping_objects_writable_where_the_device_lets_them_be_configured(drive: Device) -> None:
    dictionary = objects(drive)
    assert numbers(dictionary[0x1600])[:5] == [3, 0x60400010, 0x607A0020, 0x60600008, 0]
    assert len(dictionary[0x1600].entries) == 33
    assert numbers(dictionary[0x1A00]) == [5, 0x60410010, 0x60640020, 0x20100118, 0x20100203, 0x00000005]
    assert (dictionary[0x1600].entries[1].writable, dictionary[0x1A00].entries[1].writable) == (True, False)


def test_mapped_objects_that_the_file_lacks_are_made_with_their_types_and_rights(drive: Device) -> None:
    dictionary = objects(drive)
    assert dictionary[0x607A].code is ObjectCode.VARIABLE
    (target,) = dictionary[0x607A].entries
    assert (target.name, target.type, target.bits, target.writable, target.rx_mappable) == (
        "Target position", "DINT", 32, True, True,
    )  # fmt: skip
    encoder = dictionary[0x2010]
    assert [(entry.sub_index, entry.type, entry.bits, entry.writable) for entry in encoder.entries] == [
        (0, "USINT", 8, False),
        (1, "INT24", 24, False),
        (2, "BIT3", 3, False),
    ]
    assert numbers(encoder)[0] == 2


def test_what_the_file_writes_at_the_start_is_there_and_takes_the_value(drive: Device) -> None:
    locked = DictionaryObject(0x2200, "Locked", ObjectCode.VARIABLE, (ObjectEntry(0, "Locked", "INT", 16),))
    commands = (InitCommand(("PS",), 0xF810, 2, bytes(4)), InitCommand(("PS",), 0x2200, 0, bytes(2)))
    dictionary = objects(replace(drive, objects=(*drive.objects, locked), init_commands=commands))
    made = dictionary[0xF810].entries
    assert [(entry.sub_index, entry.bits, entry.writable) for entry in made] == [(0, 8, False), (2, 32, True)]
    assert numbers(dictionary[0xF810]) == [2, 0]
    assert [(entry.name, entry.type, entry.writable) for entry in dictionary[0x2200].entries] == [
        ("Locked", "INT", True)
    ]


def test_objects_of_the_file_keep_their_values_and_a_count_is_filled_in(drive: Device) -> None:
    dictionary = objects(drive)
    assert numbers(dictionary[0x607D]) == [2, 0x80000000, 0x7FFFFFFF]
    assert dictionary[0x1008].entries[0].default == b"SD-402"
    assert numbers(dictionary[0x2000])[0] == 3


def test_an_object_of_the_file_that_a_pdo_maps_is_mappable_and_gets_the_subindexes_that_it_lacks(
    drive: Device,
) -> None:
    first = ObjectEntry(1, "Encoder of the file", "UDINT", 32, writable=True)
    given = DictionaryObject(0x2010, "Encoder", ObjectCode.RECORD, (ObjectEntry(0, "Count", "USINT", 8), first))
    pdo = replace(drive.tx_pdos[0], entries=(PdoEntry(0x2010, 1, 32), PdoEntry(0x2010, 4, 8), PdoEntry(0x2020, 3, 8)))
    dictionary = objects(replace(drive, objects=(given,), tx_pdos=(pdo,)))
    assert [(entry.sub_index, entry.name, entry.tx_mappable) for entry in dictionary[0x2010].entries] == [
        (0, "Count", False),
        (1, "Encoder of the file", True),
        (4, "", True),
    ]
    assert dictionary[0x2010].entries[1].writable
    assert (numbers(dictionary[0x2010])[0], numbers(dictionary[0x2020])[0]) == (4, 3)


def test_where_a_files_dictionary_contradicts_its_pdos_the_pdos_are_right(drive: Device) -> None:
    names = (
        ObjectEntry(0, "Number", "USINT", 8, default=b"\x01"),
        ObjectEntry(1, "First", "UINT", 16, default=b"\1\x17"),
    )
    wrong = DictionaryObject(0x1C12, "RxPDO assign", ObjectCode.ARRAY, names)
    item = objects(replace(drive, objects=(wrong,)))[0x1C12]
    assert (item.name, item.entries[1].name, numbers(item)[:2]) == ("RxPDO assign", "First", [1, 0x1600])
    assert not item.entries[1].writable  # rights are the file's


def test_a_terminal_without_a_dictionary_has_the_objects_of_its_pdos() -> None:
    outputs = find_device(read_esi(FILES / "terminals.xml"), name="DO-2")
    dictionary = objects(outputs)
    assert {0x7000, 0x7010, 0x1600, 0x1601, 0x1C10} <= set(dictionary)
    assert dictionary[0x7000].entries[1].type == "BOOL"
    latch = find_device(read_esi(FILES / "terminals.xml"), name="DI-L")
    assert 0x10 not in objects(latch)  # a telegram of another profile has no object


def test_modules_are_in_the_lists_of_configured_and_detected_ones() -> None:
    file = read_esi(FILES / "axes.xml")
    dictionary = objects(assemble(file.devices[0], file.modules, {1: 0x100}))
    assert numbers(dictionary[0xF050]) == [2, 0x100, 0x100]
    assert numbers(dictionary[0xF030])[:4] == [2, 0x100, 0x100, 0]
    assert dictionary[0xF030].entries[1].writable
