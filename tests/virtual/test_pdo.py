import struct

import pytest

from rtcp.virtual.coe import read, write
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary
from rtcp.virtual.pdo import PdoImage, SyncManagerLayout, define_pdo_objects
from tests.virtual.conftest import abort_of

PREOP, SAFEOP, OP = 2, 4, 8
RX_MAP, TX_MAP, RX_ASSIGN, TX_ASSIGN = 0x1600, 0x1A00, 0x1C12, 0x1C13
CONTROLWORD, TARGET, MODE = 0x60400010, 0x607A0020, 0x60600008
OUT, IN = Access.RW | Access.RXPDO, Access.RO | Access.TXPDO


def dictionary(*, fixed: bool = False) -> ObjectDictionary:
    objects = ObjectDictionary()
    objects.variable(0x6040, "Controlword", DataType.UNSIGNED16, access=OUT)
    objects.variable(0x607A, "Target position", DataType.INTEGER32, access=OUT)
    objects.variable(0x6060, "Modes of operation", DataType.INTEGER8, access=OUT)
    objects.variable(0x6041, "Statusword", DataType.UNSIGNED16, access=IN)
    objects.variable(0x60C0, "Not for process data", DataType.UNSIGNED16, access=Access.RW)
    objects.variable(0x2001, "Float", DataType.REAL32, access=OUT | IN)
    objects.variable(0x2002, "Bytes", DataType.OCTET_STRING, b"\x01\x02\x03", access=OUT | IN)
    objects.record(
        0x7000,
        "Outputs",
        [Entry(0x7000, n, f"Output {n}", DataType.BOOLEAN, 0, OUT | IN) for n in range(1, 5)],
    )
    objects.variable(0x7010, "Signed nibble", DataType.INTEGER8, access=OUT | IN).bit_length = 4
    objects.variable(0x2F00, "Long", DataType.OCTET_STRING, bytes(31), access=OUT)
    define_pdo_objects(
        objects,
        rx={RX_MAP: [(0x6040, 0, 16), (0x607A, 0, 32), (0x6060, 0, 8)], 0x1601: [(0x6060, 0, 8)]},
        tx={TX_MAP: [(0x6041, 0, 16)]},
        assign_rx=[RX_MAP],
        assign_tx=[TX_MAP],
        fixed=fixed,
    )
    return objects


def put(objects: ObjectDictionary, index: int, subindex: int, value: int, size: int, state: int = PREOP) -> None:
    write(objects, index, subindex, False, state, value.to_bytes(size, "little"))


def map_anew(objects: ObjectDictionary, index: int, mappings: list[int]) -> None:
    put(objects, index, 0, 0, 1)
    for subindex, mapping in enumerate(mappings, 1):
        put(objects, index, subindex, mapping, 4)
    put(objects, index, 0, len(mappings), 1)


def test_the_default_layout_has_the_mailboxes_and_buffers_where_masters_expect_them() -> None:
    registers = [(sm.start, sm.length, sm.control, int(sm.type)) for sm in SyncManagerLayout()]
    assert registers == [(0x1000, 128, 0x26, 1), (0x1080, 128, 0x22, 2), (0x1100, 0, 0x64, 3), (0x1400, 0, 0x20, 4)]


def test_outputs_arrive_in_their_entries() -> None:
    objects = dictionary()
    image = PdoImage.from_assignment(objects, RX_ASSIGN)
    image.unpack(memoryview(bytes.fromhex("0f00 60799ffe 08")))
    assert (image.bit_length, image.byte_length) == (56, 7)
    assert [entry.value for entry in image.entries] == [0x000F, -23103136, 8]


def test_inputs_are_written_at_their_offset_and_nothing_beside_them() -> None:
    objects = dictionary()
    objects[0x6041, 0].value = 0x1237
    target = bytearray(b"\xee" * 6)
    PdoImage.from_assignment(objects, TX_ASSIGN).pack(memoryview(target), 2)
    assert target.hex() == "eeee3712eeee"


def test_two_assigned_pdos_follow_each_other() -> None:
    objects = dictionary()
    put(objects, RX_ASSIGN, 0, 0, 1)
    put(objects, RX_ASSIGN, 1, 0x1601, 2)
    put(objects, RX_ASSIGN, 2, RX_MAP, 2)
    put(objects, RX_ASSIGN, 0, 2, 1)
    image = PdoImage.from_assignment(objects, RX_ASSIGN)
    assert [hex(entry.index) for entry in image.entries] == ["0x6060", "0x6040", "0x607a", "0x6060"]


def test_a_gap_is_passed_over_and_packed_as_zero() -> None:
    objects = dictionary()
    map_anew(objects, RX_MAP, [MODE, 0x00000008, CONTROLWORD])
    image = PdoImage.from_assignment(objects, RX_ASSIGN)
    image.unpack(bytes.fromhex("08 ff 0600"))
    assert (objects[0x6060, 0].value, objects[0x6040, 0].value) == (8, 6)
    target = bytearray(b"\xee" * 4)
    image.pack(target)
    assert target.hex() == "08000600"


def test_bits_and_a_signed_nibble_keep_their_places() -> None:
    objects = dictionary()
    map_anew(objects, RX_MAP, [0x70000101, 0x70000201, 0x00000002, 0x70100004, 0x70000301, CONTROLWORD])
    image = PdoImage.from_assignment(objects, RX_ASSIGN)
    assert (image.bit_length, image.byte_length) == (25, 4)
    bits = 0b1 << 1 | 0b1101 << 4 | 1 << 8 | 0xABCD << 9
    image.unpack(b"\xee" + bits.to_bytes(4, "little") + b"\xee", 1)
    assert [entry.value for entry in image.entries] == [0, 1, -3, 1, 0xABCD]
    target = bytearray(b"\xee" * 6)
    image.pack(target, 1)
    assert bytes(target) == b"\xee" + bits.to_bytes(4, "little") + b"\xee"


@pytest.mark.parametrize("with_bit", [False, True])
def test_floats_and_octet_strings_are_mapped_too(with_bit: bool) -> None:
    objects = dictionary()
    map_anew(objects, RX_MAP, [0x20010020, 0x20020018] + [0x70000101] * with_bit)
    image = PdoImage.from_assignment(objects, RX_ASSIGN)
    wire = struct.pack("<f", -1.5) + b"abc" + b"\x01" * with_bit
    image.unpack(wire)
    assert (objects[0x2001, 0].value, objects[0x2002, 0].value) == (-1.5, b"abc")
    target = bytearray(len(wire))
    image.pack(target)
    assert target == wire


def test_an_assignment_without_pdos_has_an_empty_image() -> None:
    objects = dictionary()
    put(objects, RX_ASSIGN, 0, 0, 1)
    image = PdoImage.from_assignment(objects, RX_ASSIGN)
    image.unpack(b"")
    assert (image.bit_length, image.entries) == (0, ())


def test_an_image_longer_than_its_buffer_is_refused_with_both_lengths() -> None:
    objects = dictionary()
    long = [0x2F0000F8] * 9
    for subindex, mapping in enumerate(long, 1):
        objects[RX_MAP, subindex].value = mapping
    objects[RX_MAP, 0].value = len(long)
    with pytest.raises(ValueError, match="0x1C12 take 279 bytes, allowed are 256"):
        PdoImage.from_assignment(objects, RX_ASSIGN)


def test_a_new_mapping_changes_the_next_image_and_not_the_present_one() -> None:
    objects = dictionary()
    before = PdoImage.from_assignment(objects, RX_ASSIGN)
    map_anew(objects, RX_MAP, [MODE])
    assert (before.byte_length, PdoImage.from_assignment(objects, RX_ASSIGN).byte_length) == (7, 1)


REFUSED = [
    ("an entry while subindex 0 counts entries", RX_MAP, [(1, MODE, 4)], 0x06010003),
    ("an assigned pdo while subindex 0 counts pdos", RX_ASSIGN, [(1, RX_MAP, 2)], 0x06010003),
    ("an object that does not exist", RX_MAP, [(0, 0, 1), (1, 0x7FFF0010, 4)], 0x06020000),
    ("a subindex that does not exist", RX_MAP, [(0, 0, 1), (1, 0x60400110, 4)], 0x06090011),
    ("an object that is not for process data", RX_MAP, [(0, 0, 1), (1, 0x60C00010, 4)], 0x06040041),
    ("an input in an output pdo", RX_MAP, [(0, 0, 1), (1, 0x60410010, 4)], 0x06040041),
    ("an output in an input pdo", TX_MAP, [(0, 0, 1), (1, CONTROLWORD, 4)], 0x06040041),
    ("fewer bits than the object has", RX_MAP, [(0, 0, 1), (1, 0x60400008, 4)], 0x06040042),
    ("a count beyond the places", RX_MAP, [(0, 0, 1), (0, 17, 1)], 0x06090031),
    ("a count over an empty place", RX_MAP, [(0, 0, 1), (0, 4, 1)], 0x06020000),
    ("a pdo that does not exist", RX_ASSIGN, [(0, 0, 1), (1, 0x1605, 2)], 0x06020000),
    ("a pdo of the other direction", RX_ASSIGN, [(0, 0, 1), (1, TX_MAP, 2)], 0x06040041),
    (
        "more bytes than the buffer has",
        RX_MAP,
        [(0, 0, 1), *((n, 0x2F0000F8, 4) for n in range(1, 10)), (0, 9, 1)],
        0x06040042,
    ),
]


@pytest.mark.parametrize(("index", "writes", "code"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED])
def test_the_last_of_these_writes_is_refused(index: int, writes: list[tuple[int, int, int]], code: int) -> None:
    objects = dictionary()
    for subindex, value, size in writes[:-1]:
        put(objects, index, subindex, value, size)
    subindex, value, size = writes[-1]
    assert abort_of(put, objects, index, subindex, value, size) == code


@pytest.mark.parametrize("state", [SAFEOP, OP])
@pytest.mark.parametrize("index", [RX_MAP, TX_MAP, RX_ASSIGN, TX_ASSIGN])
def test_mapping_and_assignment_change_only_in_preop(index: int, state: int) -> None:
    assert abort_of(put, dictionary(), index, 0, 0, 1, state) == 0x08000022


@pytest.mark.parametrize("index", [RX_MAP, TX_MAP, RX_ASSIGN, TX_ASSIGN])
@pytest.mark.parametrize("complete", [False, True])
def test_fixed_process_data_cannot_be_written(index: int, complete: bool) -> None:
    objects = dictionary(fixed=True)
    data = bytes(2) if complete else bytes(1)
    assert abort_of(write, objects, index, 0, complete, PREOP, data) == 0x06010002


def test_complete_access_maps_anew_in_one_write() -> None:
    objects = dictionary()
    write(objects, RX_MAP, 0, True, PREOP, struct.pack("<BxII", 2, MODE, CONTROLWORD))
    write(objects, RX_ASSIGN, 0, True, PREOP, struct.pack("<BxH", 1, RX_MAP))
    assert PdoImage.from_assignment(objects, RX_ASSIGN).bit_length == 24


def test_a_refused_complete_access_leaves_the_mapping_as_it_was() -> None:
    objects = dictionary()
    before = read(objects, RX_MAP, 0, True, PREOP)
    wrong = struct.pack("<BxII", 2, MODE, 0x7FFF0010)
    assert abort_of(write, objects, RX_MAP, 0, True, PREOP, wrong) == 0x06020000
    assert read(objects, RX_MAP, 0, True, PREOP) == before


def test_soem_finds_the_types_of_the_sync_managers() -> None:
    # ec_SMcommtypet: count, one byte unused, one byte a sync manager.
    assert read(dictionary(), 0x1C00, 0, True, PREOP).hex() == "040001020304"


def test_soem_reads_assignment_and_mapping_by_complete_access() -> None:
    # ec_PDOassignt and ec_PDOdesct: count, one byte unused, indices or mappings.
    objects = dictionary()
    assert read(objects, RX_ASSIGN, 0, True, PREOP) == struct.pack("<BxH", 1, RX_MAP)
    assert read(objects, RX_MAP, 0, True, PREOP) == struct.pack("<BxIII", 3, CONTROLWORD, TARGET, MODE)
