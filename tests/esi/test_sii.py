"""SII images: written for SOEM and IgH, read from real slaves, and their mistakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.esi.model import Coe, DcMode, Device, EsiError, FmmuUse, Mailbox, Pdo, PdoEntry, Source, SyncManagerType
from rtcp.esi.reader import find_device, read_esi
from rtcp.esi.sii import check_sii, crc, read_sii, write_sii
from rtcp.esi.types import of_bits

FILES = Path(__file__).parent / "files"


@pytest.fixture(scope="module")
def drive() -> Device:
    return find_device(read_esi(FILES / "drive.xml"), product=0x402)


@pytest.fixture(scope="module")
def outputs() -> Device:
    return find_device(read_esi(FILES / "terminals.xml"), name="DO-2")


def categories(image: bytes) -> list[tuple[int, bytes]]:
    """Number and data of each category, by their definition."""
    parts = []
    position = 128
    while (number := int.from_bytes(image[position : position + 2], "little")) != 0xFFFF:
        length = 2 * int.from_bytes(image[position + 2 : position + 4], "little")
        parts.append((number, image[position + 4 : position + 4 + length]))
        position += 4 + length
    return parts


def end_mark(image: bytes) -> int:
    return 128 + sum(4 + len(data) for _, data in categories(image))


def without_lost(device: Device) -> Device:
    """The device without what an SII image cannot express."""
    mailbox = device.mailbox
    if mailbox is not None and mailbox.coe is not None:
        mailbox = replace(mailbox, coe=replace(mailbox.coe, segmented=False))
    return replace(
        device,
        source=Source.SII,
        origin="image",
        vendor_name="",
        sync_managers=tuple(replace(sync, minimum=None, maximum=None) for sync in device.sync_managers),
        fmmus=(*device.fmmus, *[FmmuUse.UNUSED] * (len(device.fmmus) % 2)),
        rx_pdos=tuple(replace(pdo, excludes=frozenset()) for pdo in device.rx_pdos),
        tx_pdos=tuple(replace(pdo, excludes=frozenset()) for pdo in device.tx_pdos),
        mailbox=mailbox,
        objects=(),
        init_commands=(),
        profile=None,
        channel_profiles=(),
        unit_symbols={},
        config_data=device.config_data.ljust(14, b"\0"),
    )


@pytest.mark.parametrize("name", ["drive", "outputs"])
def test_what_is_written_is_read_again(request: pytest.FixtureRequest, name: str) -> None:
    device: Device = request.getfixturevalue(name)
    image = write_sii(device)
    assert read_sii(image, "image") == without_lost(device)
    assert check_sii(image) == ()
    assert len(image) == device.eeprom_bytes


TEXTS = st.text(st.characters(blacklist_categories=["Cs", "Cc"]), max_size=20)
ENTRIES = st.builds(
    lambda index, sub_index, bits, name: PdoEntry(index, sub_index, bits, name, of_bits(bits).name if index else ""),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFF),
    st.integers(1, 64),
    TEXTS,
)
PDOS = st.builds(
    Pdo,
    index=st.integers(0, 0xFFFF),
    name=TEXTS,
    entries=st.lists(ENTRIES, max_size=12).map(tuple),
    sync_manager=st.none() | st.integers(0, 15),
    fixed=st.booleans(),
    mandatory=st.booleans(),
    virtual=st.booleans(),
)
MODES = st.builds(
    DcMode,
    name=TEXTS,
    assign_activate=st.integers(0, 0xFFFF),
    description=TEXTS,
    sync0_cycle=st.integers(0, (1 << 31) - 1),
    sync0_factor=st.integers(-32768, 32767),
    sync0_shift=st.integers(-(1 << 31), (1 << 31) - 1),
    sync1_factor=st.integers(-32768, 32767),
    sync1_shift=st.integers(-(1 << 31), (1 << 31) - 1),
)


@given(
    st.lists(PDOS, max_size=4).map(tuple), st.lists(PDOS, max_size=4).map(tuple), st.lists(MODES, max_size=3).map(tuple)
)
def test_pdos_and_modes_of_any_device_are_read_as_they_were_written(
    rx_pdos: tuple[Pdo, ...], tx_pdos: tuple[Pdo, ...], modes: tuple[DcMode, ...]
) -> None:
    device = find_device(read_esi(FILES / "terminals.xml"), name="DO-2")
    information = read_sii(write_sii(replace(device, eeprom_bytes=0, rx_pdos=rx_pdos, tx_pdos=tx_pdos, dc_modes=modes)))
    assert (information.rx_pdos, information.tx_pdos, information.dc_modes) == (rx_pdos, tx_pdos, modes)


def test_the_categories_stand_in_the_order_that_masters_need_each_once(drive: Device) -> None:
    numbers = categories(write_sii(drive))
    assert [number for number, _ in numbers] == [10, 30, 40, 41, 50, 51, 60]
    sizes = {number: len(data) for number, data in numbers}
    assert (sizes[30], sizes[40], sizes[41], sizes[60]) == (32, 4, 32, 48)
    assert numbers[0][1][:8] == b"\x10\x06SD-402"  # 16 texts, the first is the type: SOEM's name


def test_the_fixed_part_has_config_data_crc_identity_mailboxes_and_size(drive: Device) -> None:
    image = write_sii(drive, alias=0x1234)
    assert image[:14] == bytes.fromhex("080c00000000000034120000 0000".replace(" ", ""))
    assert image[14] == crc(image[:14])
    assert image[16:28] == bytes.fromhex("510e0000 02040000 01000200".replace(" ", ""))
    assert image[40:58] == bytes.fromhex("0010000200120002 0010000100120001 0c00".replace(" ", ""))
    assert image[124:128] == b"\x0f\0\x01\0"  # 2048 bytes, version 1
    assert read_sii(image).station_alias == 0x1234


def test_the_crc_is_that_of_a_real_slave() -> None:
    image = (FILES / "el2004.bin").read_bytes()
    assert crc(image[:14]) == image[14] == 0xD8


def test_the_eeprom_of_a_real_terminal_is_read() -> None:
    terminal = read_sii((FILES / "el2004.bin").read_bytes())
    assert (terminal.type, terminal.name) == ("EL2004", "EL2004 4K. Dig. Ausgang 24V, 0.5A")
    assert (terminal.identity.vendor_id, terminal.identity.product_code) == (2, 0x07D43052)
    assert (terminal.physics, terminal.mailbox, terminal.dc_modes) == ("KK", None, ())
    (sync,) = terminal.sync_managers
    assert (sync.start, sync.control, sync.type, sync.op_only) == (0x0F00, 0x44, SyncManagerType.OUTPUTS, True)
    assert [(pdo.index, pdo.name, pdo.sync_manager, pdo.bits) for pdo in terminal.rx_pdos] == [
        (0x1600 + number, f"Channel {number + 1}", 0, 1) for number in range(4)
    ]
    assert terminal.rx_pdos[2].entries == (PdoEntry(0x7020, 1, 1, "Output", "BOOL"),)
    assert terminal.unread == {"category 43": 1}
    assert check_sii((FILES / "el2004.bin").read_bytes()) == ()


def test_the_eeprom_of_a_real_terminal_is_written_byte_for_byte_but_for_its_own_categories() -> None:
    image = (FILES / "el2004.bin").read_bytes()
    written = write_sii(read_sii(image))
    assert written[:128] == image[:128]
    real, ours = dict(categories(image)), dict(categories(written))
    assert {number: ours[number] for number in (40, 41)} == {number: real[number] for number in (40, 41)}
    # Real images have the physical ports twice, also in the older format; texts and their numbers are equal.
    assert ours[10] == real[10].replace(b"\xff", b"\0")
    assert (ours[30][:4], ours[30][5:]) == (real[30][:4], real[30][5:])
    assert ours[51] == real[51]


def test_the_eeprom_of_a_real_drive_is_read() -> None:
    drive = read_sii((FILES / "akd.bin").read_bytes())
    assert (drive.type, drive.name, drive.group) == ("AKD", "AKD EtherCAT Drive (CoE)", "Drive")
    assert drive.mailbox == Mailbox(
        Coe(pdo_assignment=True, pdo_configuration=True, ds402_channels=1), foe=True, eoe=True, data_link_layer=True
    )
    assert [(sync.start, sync.length) for sync in drive.sync_managers] == [
        (0x1800, 1024),
        (0x1C00, 1024),
        (0x1100, 0),
        (0x1140, 0),
    ]
    assert [mode.assign_activate for mode in drive.dc_modes] == [0x0300, 0]


def test_a_description_and_the_image_that_its_maker_compiled_of_it_agree() -> None:
    image = (FILES / "Orbita2d.bin").read_bytes()
    (described,) = read_esi(FILES / "Orbita2d.xml").devices
    theirs, ours = read_sii(image), read_sii(write_sii(described))
    assert ours.config_data == theirs.config_data
    assert ours.identity.product_code == theirs.identity.product_code
    assert theirs.identity.vendor_id == 0  # the compiler did not understand 0xF3F
    assert [(sync.start, sync.length, sync.control) for sync in ours.sync_managers] == [
        (sync.start, sync.length, sync.control) for sync in theirs.sync_managers
    ]
    assert [[(entry.sub_index, entry.bits) for entry in pdo.entries] for pdo in (*ours.rx_pdos, *ours.tx_pdos)] == [
        [(entry.sub_index, entry.bits) for entry in pdo.entries] for pdo in (*theirs.rx_pdos, *theirs.tx_pdos)
    ]
    assert check_sii(image) == (
        "Category 50 occurs 2 times: SOEM reads the first only.",
        "Category 60 occurs 2 times: SOEM reads the first only.",
    )


def test_an_image_that_does_not_fit_leaves_out_its_pdos_where_coe_has_them(drive: Device) -> None:
    small = replace(drive, eeprom_bytes=512)
    image = write_sii(small)
    assert len(image) == 512
    assert [number for number, _ in categories(image)] == [10, 30, 40, 41, 60]
    assert check_sii(image) == ()


def test_an_image_that_does_not_fit_without_coe_leaves_out_the_names_of_entries_and_then_grows(outputs: Device) -> None:
    entries = tuple(PdoEntry(0x7000, number, 1, f"Output of channel {number}", "BOOL") for number in range(1, 33))
    wide = replace(outputs, rx_pdos=(Pdo(0x1600, "Outputs", entries, 0),))
    image = write_sii(replace(wide, eeprom_bytes=640))
    assert len(image) == 640
    assert [entry.name for entry in read_sii(image).rx_pdos[0].entries] == [""] * 32
    grown = write_sii(replace(wide, eeprom_bytes=256))
    assert len(grown) == 512
    assert read_sii(grown).rx_pdos[0].bits == 32


def test_an_entry_longer_than_a_byte_tells_is_several(outputs: Device) -> None:
    long = replace(outputs, rx_pdos=(Pdo(0x1600, "", (PdoEntry(0x7000, 1, 600),), 0),))
    (pdo,) = read_sii(write_sii(long)).rx_pdos
    assert [entry.bits for entry in pdo.entries] == [248, 248, 104]


def test_a_text_beyond_the_255th_has_no_number_and_a_pdo_of_more_entries_is_refused(outputs: Device) -> None:
    pdos = tuple(
        Pdo(0x1600 + number, "", tuple(PdoEntry(0x7000, 1, 8, f"{number} {i}") for i in range(200)), 0)
        for number in range(2)
    )
    wide = replace(outputs, rx_pdos=pdos, eeprom_bytes=0)
    names = [entry.name for pdo in read_sii(write_sii(wide)).rx_pdos for entry in pdo.entries]
    assert names[:2] == ["0 0", "0 1"]
    assert names[-1] == ""
    with pytest.raises(EsiError, match="PDO 0x1600: 256 entries; an SII image holds at most 255"):
        write_sii(replace(outputs, rx_pdos=(Pdo(0x1600, "", (PdoEntry(0, 0, 8),) * 256, 0),)))


def test_several_categories_of_a_number_are_read_as_one(drive: Device) -> None:
    image = write_sii(drive)
    end = end_mark(image)
    doubled = image[:end] + b"\x3c\0\x0c\0" + bytes(22) + b"\0\0" + image[end:]
    assert read_sii(doubled).dc_modes == (*read_sii(image).dc_modes, DcMode("", 0, sync0_factor=0))


def test_what_is_wrong_in_an_image_is_said_in_sentences(drive: Device) -> None:
    image = bytearray(write_sii(drive))
    assert check_sii(bytes(image[:100])) == ("100 bytes; the fixed part of an SII image alone has 128.",)
    with pytest.raises(EsiError, match="100 bytes"):
        read_sii(bytes(image[:100]))
    image[0] ^= 1
    assert check_sii(bytes(image)) == (
        f"The CRC of the first seven words is 0x{image[14]:02X}, not 0x{crc(bytes(image[:14])):02X}.",
    )
    image[0] ^= 1
    end = end_mark(bytes(image))
    cut = bytes(image[:end])
    assert check_sii(cut) == ("The end mark 0xFFFF is missing: IgH drops all categories.",)
    assert "Category 60 is longer than the image." in check_sii(cut[:-2])
    general = image.index(b"\x1e\0\x10\0", 128)
    assert check_sii(bytes(image[:general] + image[general + 36 :])) == (
        "Category 30 (general) is missing: SOEM uses no complete access, IgH no names.",
    )
    sync = image.index(b"\x29\0\x10\0", 128)
    moved = image[:sync] + image[sync + 36 : end] + image[sync : sync + 36] + image[end:]
    assert check_sii(bytes(moved)) == ("Category 41 (sync managers) stands behind the PDOs: IgH cannot assign them.",)
    large = bytes(image[:end]) + b"\0\x08\0\x08" + bytes(4096) + b"\xff\xff"
    assert [sentence.split(":")[0] for sentence in check_sii(large)] == [
        "It has 4636 bytes of categories",
        "It needs 4636 bytes, and gives its size as 2048.",
    ]
