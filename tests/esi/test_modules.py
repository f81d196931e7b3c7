"""Modules in the slots of a device: a drive of two axes, and one with a brake in the place of an axis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.esi.model import Device, DeviceFile, EsiError
from rtcp.esi.modules import allowed, assemble, defaults, places
from rtcp.esi.reader import read_esi

FILES = Path(__file__).parent / "files"
CSP, OFF, BRAKE = 0x100, 0x200, 0x300


@pytest.fixture(scope="module")
def file() -> DeviceFile:
    return read_esi(FILES / "axes.xml")


@pytest.fixture(scope="module")
def drive(file: DeviceFile) -> Device:
    return file.devices[0]


def test_a_slot_allows_its_idents_and_the_modules_of_its_classes(file: DeviceFile, drive: Device) -> None:
    assert [[module.ident for module in allowed(slot, file.modules)] for slot in places(drive)] == [
        [CSP, OFF],
        [CSP, BRAKE],
    ]
    assert defaults(drive) == {0: CSP}
    optional = replace(drive, slots=(replace(drive.slots[0], minimum=0, maximum=4),))
    assert defaults(optional) == {0: CSP}


def test_indices_that_depend_on_the_slot_grow_with_it_and_fixed_ones_do_not(file: DeviceFile, drive: Device) -> None:
    both = assemble(drive, file.modules, {1: CSP})
    assert [pdo.index for pdo in both.rx_pdos] == [0x1610, 0x1600]  # 0x1610 took the place of the device's own
    assert [pdo.index for pdo in both.tx_pdos] == [0x1A00, 0x1A10]
    assert [[entry.index for entry in pdo.entries] for pdo in both.rx_pdos] == [
        [0x6840, 0, 0x687A],
        [0x6040, 0, 0x607A],
    ]
    assert both.rx_pdos[0].excludes == {0x1611}
    assert [item.index for item in both.objects] == [0x2100, 0x6060, 0x6860]
    assert both.modules == ((0, CSP), (1, CSP))


def test_start_up_commands_are_those_of_the_modules_and_the_list_of_their_idents(
    file: DeviceFile, drive: Device
) -> None:
    commands = assemble(drive, file.modules, {1: CSP}).init_commands
    assert [(command.index, command.sub_index, command.data) for command in commands] == [
        (0x6060, 0, b"\x08"),
        (0x6860, 0, b"\x08"),
        (0xF030, 0, b"\0"),
        (0xF030, 1, b"\0\x01\0\0"),
        (0xF030, 2, b"\0\x01\0\0"),
        (0xF030, 0, b"\x02"),
    ]


def test_a_place_can_be_left_empty(file: DeviceFile, drive: Device) -> None:
    empty = assemble(drive, file.modules, {0: None})
    assert (empty.rx_pdos, empty.modules, empty.init_commands) == (drive.rx_pdos, (), ())


def test_a_module_that_is_not_allowed_is_refused_with_those_that_are(file: DeviceFile, drive: Device) -> None:
    with pytest.raises(
        EsiError,
        match=r"no module 0x300 for place 0 \(Axis 1\) of Two-axis drive; allowed: 0x100 Cyclic position, 0x200 No ",
    ):
        assemble(drive, file.modules, {0: BRAKE})
    with pytest.raises(EsiError, match="Two-axis drive has no place 2; it has 2, from 0"):
        assemble(drive, file.modules, {2: CSP})


def test_a_pdo_that_is_there_already_is_refused(file: DeviceFile, drive: Device) -> None:
    with pytest.raises(
        EsiError, match=r"Brake at place 1 of Two-axis drive: the PDO 0x1A00 \(Brake\) is there already"
    ):
        assemble(drive, file.modules, {1: BRAKE})
    assert [pdo.index for pdo in assemble(drive, file.modules, {0: OFF, 1: BRAKE}).tx_pdos] == [0x1A00]


def test_an_index_does_not_grow_beyond_its_range(file: DeviceFile, drive: Device) -> None:
    wide = replace(drive, slots=tuple(replace(slot, index_increment=0xF000) for slot in drive.slots))
    with pytest.raises(EsiError, match="the index 0x6040 would grow to 0x15040"):
        assemble(wide, file.modules, {1: CSP})


def test_a_real_drive_of_two_axes_gets_its_second_0x800_higher() -> None:
    file = read_esi(FILES / "ECAT_CIA402.xml")
    (drive,) = file.devices
    assert (drive.rx_pdos, drive.tx_pdos) == ((), ())
    both = assemble(drive, file.modules, {1: 0x319800})
    assert [pdo.index for pdo in (*both.rx_pdos, *both.tx_pdos)] == [0x1602, 0x1612, 0x1A02, 0x1A12]
    assert [entry.index for entry in both.rx_pdos[1].entries if entry.index] == [
        entry.index + 0x800 for entry in both.rx_pdos[0].entries if entry.index
    ]
    assert {0x6040, 0x6840} <= {item.index for item in both.objects}
