import struct

import pytest

from rtcp.esi.sii import crc
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.objects import Access, DataType, ObjectDictionary
from rtcp.virtual.pdo import SyncManagerLayout, define_pdo_objects
from rtcp.virtual.protocol import MailboxType
from rtcp.virtual.sii import build_sii

STRINGS, GENERAL, FMMU, SYNC_MANAGER, TXPDO, RXPDO, DC = 10, 30, 40, 41, 50, 51, 60
PdoMap = dict[int, list[tuple[int, int, int]]]
RX: PdoMap = {0x1600: [(0x6040, 0, 16), (0, 0, 8), (0x607A, 0, 32)], 0x1601: [(0x607A, 0, 32)]}
TX: PdoMap = {0x1A00: [(0x6041, 0, 16)]}


class Drive(DeviceModel):
    vendor_id, product_code, revision = 0xB5C, 0x40201, 0x10000
    name, group, order_code = "Cubemars ORH70", "Drives", "ORH70-E"

    def define(self, objects: ObjectDictionary) -> None:
        objects.variable(0x6040, "Controlword", DataType.UNSIGNED16, access=Access.RW | Access.RXPDO)
        objects.variable(0x607A, "Target position", DataType.INTEGER32, access=Access.RW | Access.RXPDO)
        objects.variable(0x6041, "Statusword", DataType.UNSIGNED16, access=Access.RO | Access.TXPDO)


def drive(rx: PdoMap = RX, tx: PdoMap = TX, *, supports_dc: bool = True, fixed: bool = False) -> Drive:
    device = Drive(serial=77)
    device.supports_dc = supports_dc
    define_pdo_objects(device.objects, rx, tx, list(rx)[:1], list(tx)[:1], fixed)
    return device


def image(device: Drive | None = None, alias: int = 0) -> bytes:
    return build_sii(device or drive(), SyncManagerLayout(), alias)


def word(sii: bytes, address: int) -> int:
    return struct.unpack_from("<H", sii, 2 * address)[0]


def double(sii: bytes, address: int) -> int:
    return struct.unpack_from("<I", sii, 2 * address)[0]


def find(sii: bytes, wanted: int) -> bytes | None:
    """Walk the categories as ecx_siifind does; return the content of the wanted one."""
    at = 0x40
    while word(sii, at) not in (wanted, 0xFFFF):
        at += 2 + word(sii, at + 1)
    if word(sii, at) == 0xFFFF:
        return None
    return sii[2 * at + 4 : 2 * at + 4 + 2 * word(sii, at + 1)]


def string(sii: bytes, number: int) -> str:
    """Return a string as ecx_siistring does."""
    strings = find(sii, STRINGS)
    assert 1 <= number <= strings[0]
    at = 1
    for _ in range(number - 1):
        at += 1 + strings[at]
    return strings[at + 1 : at + 1 + strings[at]].decode()


def test_the_identity_stands_where_masters_read_it() -> None:
    sii = image()
    assert [double(sii, at) for at in (0x08, 0x0A, 0x0C, 0x0E)] == [0xB5C, 0x40201, 0x10000, 77]


def test_the_alias_stands_in_word_4_under_the_checksum() -> None:
    sii = image(alias=0x1234)
    assert word(sii, 4) == 0x1234
    assert word(sii, 7) == crc(sii[:14]) != word(image(), 7)


def test_the_mailboxes_are_the_standard_ones_and_there_is_no_bootstrap() -> None:
    sii = image()
    assert [word(sii, at) for at in range(0x14, 0x18)] == [0, 0, 0, 0]
    assert [word(sii, at) for at in range(0x18, 0x1C)] == [0x1000, 128, 0x1080, 128]
    assert word(sii, 0x1C) == 0x0004


def test_size_and_version_describe_the_image() -> None:
    sii = image()
    assert len(sii) == (word(sii, 0x3E) + 1) * 128
    assert word(sii, 0x3F) == 1


def test_a_longer_image_has_the_next_size_and_says_so() -> None:
    device = drive()
    for number in range(100):
        device.objects.variable(
            0x2000 + number, f"Number {number} " + "x" * 30, DataType.UNSIGNED8, access=Access.RO | Access.TXPDO
        )
    tx = {0x1A00 + n: [(0x2000 + 10 * n + m, 0, 8) for m in range(10)] for n in range(10)}
    define_pdo_objects(device.objects, RX, tx, [0x1600], [0x1A00], True)
    sii = image(device)
    assert len(sii) == 8192 == (word(sii, 0x3E) + 1) * 128
    assert find(sii, DC) is not None


def test_all_of_the_image_after_the_end_is_erased() -> None:
    sii = image()
    end = sii.rindex(find(sii, DC)) + 48
    assert set(sii[end:]) == {0xFF}


def test_string_one_is_the_name() -> None:
    assert string(image(), 1) == "Cubemars ORH70"


def test_the_general_category_names_group_order_name_and_coe_services() -> None:
    sii = image()
    general = find(sii, GENERAL)
    assert len(general) == 32
    assert [string(sii, general[at]) for at in (0, 2, 3)] == ["Drives", "ORH70-E", "Cubemars ORH70"]
    # SOEM: CoE details at 5 of the content, flags (bit 1 blocks LRW) at 11, Ebus current at 12.
    assert (general[5], general[11], general[12:14]) == (0x3F, 0, b"\0\0")
    assert general[16:18] == b"\x11\x00"


def test_a_device_with_fixed_process_data_does_not_claim_to_configure_it() -> None:
    assert find(image(drive(fixed=True)), GENERAL)[5] == 0x33


def test_the_fmmus_are_for_outputs_inputs_and_the_mailbox_state() -> None:
    assert find(image(), FMMU) == b"\x01\x02\x03\xff"


def test_the_sync_managers_have_the_lengths_of_the_assigned_pdos() -> None:
    assert [struct.unpack_from("<HHBBBB", find(image(), SYNC_MANAGER), 8 * n) for n in range(4)] == [
        (0x1000, 128, 0x26, 0, 1, 1),
        (0x1080, 128, 0x22, 0, 1, 2),
        (0x1100, 7, 0x64, 0, 1, 3),
        (0x1400, 2, 0x20, 0, 1, 4),
    ]


def bits_of_sync_managers(content: bytes) -> dict[int, int]:
    """Sum up the bits of each sync manager as ecx_siiPDO does."""
    bits: dict[int, int] = {}
    at = 0
    while at < len(content):
        entries, sync_manager = content[at + 2], content[at + 3]
        at += 8
        bits[sync_manager] = bits.get(sync_manager, 0) + sum(content[at + 8 * n + 5] for n in range(entries))
        at += 8 * entries
    assert at == len(content)
    return bits


def test_soem_counts_the_bits_of_the_pdos() -> None:
    sii = image()
    assert bits_of_sync_managers(find(sii, RXPDO)) == {2: 56, 0xFF: 32}
    assert bits_of_sync_managers(find(sii, TXPDO)) == {3: 16}


def test_a_pdo_names_its_entries_with_type_and_bits() -> None:
    sii = image()
    content = find(sii, RXPDO)
    assert struct.unpack_from("<HBB", content) == (0x1600, 3, 2)
    assert string(sii, content[5]) == "RxPDO mapping 1"
    entries = [struct.unpack_from("<HBBBBH", content, 8 + 8 * n) for n in range(3)]
    assert [(index, subindex, kind, bits) for index, subindex, _, kind, bits, _ in entries] == [
        (0x6040, 0, 0x06, 16),
        (0, 0, 0, 8),
        (0x607A, 0, 0x04, 32),
    ]
    assert string(sii, entries[0][2]) == "Controlword"


@pytest.mark.parametrize(("rx", "tx", "absent"), [({}, TX, RXPDO), (RX, {}, TXPDO)])
def test_a_direction_without_pdos_has_no_category(rx: PdoMap, tx: PdoMap, absent: int) -> None:
    # ecx_siiPDO would take one PDO from an empty category.
    sii = image(drive(rx, tx))
    assert find(sii, absent) is None
    assert len(find(sii, SYNC_MANAGER)) == 32


def test_distributed_clocks_are_offered_with_sync0_and_without() -> None:
    sii = image()
    content = find(sii, DC)
    modes = [struct.unpack_from("<3LhHhBB", content, 24 * n) for n in range(len(content) // 24)]
    assert [(mode[4], string(sii, mode[6])) for mode in modes] == [(0x0300, "DC Synchron"), (0, "SM Synchron")]


def test_a_device_without_a_clock_offers_none() -> None:
    assert find(image(drive(supports_dc=False)), DC) is None


def test_the_protocols_that_a_model_adds_are_listed() -> None:
    device = drive()
    device.mailbox_protocols[MailboxType.FOE] = lambda message, room: ()
    sii = image(device)
    assert word(sii, 0x1C) == 0x04 | 0x08
    general = find(sii, GENERAL)
    assert tuple(general[5:8]) == (find(image(), GENERAL)[5], 1, 0)
