import struct

import pytest

from rtcp.virtual.coe import SdoInformation
from rtcp.virtual.objects import Access, DataType, Entry, ObjectCode, ObjectDictionary


def dictionary() -> ObjectDictionary:
    objects = ObjectDictionary()
    objects.variable(0x1000, "Device type", DataType.UNSIGNED32, 0x00020192)
    objects.record(0x1018, "Identity", [Entry(0x1018, 1, "Vendor", DataType.UNSIGNED32, 0xB5C)])
    objects.record(0x1600, "RxPDO 1", [Entry(0x1600, 1, "Place", DataType.UNSIGNED32, 0x60400010, Access.RW_PREOP)])
    objects.variable(0x6040, "Controlword", DataType.UNSIGNED16, access=Access.RW | Access.RXPDO)
    objects.variable(0x6041, "Statusword", DataType.UNSIGNED16, access=Access.RO | Access.TXPDO)
    objects.variable(0x607B, "Limited", DataType.INTEGER16, 0, Access.RW, minimum=-2, maximum=513)
    objects.record(
        0x7000, "Bits", [Entry(0x7000, n, f"Bit {n}", DataType.BOOLEAN, 0) for n in (1, 2)], code=ObjectCode.ARRAY
    )
    objects.record(0x8000, "Own record", [Entry(0x8000, 3, "Third", DataType.REAL32, 0.0)])
    return objects


# Operation code, reserved, fragments left, data (ETG.1000.6, 5.6.3); 07 is the error reply with its abort code.
CONVERSATIONS = {
    "numbers of the five lists": ("01 00 0000 0000", "02 00 0000 0000 0800 0100 0100 0000 0000"),
    "all objects": ("01 00 0000 0100", "02 00 0000 0100 0010 1810 0016 4060 4160 7b60 0070 0080"),
    "objects for RxPDOs": ("01 00 0000 0200", "02 00 0000 0200 4060"),
    "objects for TxPDOs": ("01 00 0000 0300", "02 00 0000 0300 4160"),
    "objects for replacement": ("01 00 0000 0400", "02 00 0000 0400"),
    "start-up parameters": ("01 00 0000 0500", "02 00 0000 0500"),
    "a list that there is not": ("01 00 0000 0600", "07 00 0000 30000906"),
    "a variable": ("03 00 0000 4060", "04 00 0000 4060 0600 00 07" + b"Controlword".hex()),
    "an array": ("03 00 0000 0070", "04 00 0000 0070 0100 02 08" + b"Bits".hex()),
    "the identity": ("03 00 0000 1810", "04 00 0000 1810 2300 01 09" + b"Identity".hex()),
    "a PDO mapping": ("03 00 0000 0016", "04 00 0000 0016 2100 01 09" + b"RxPDO 1".hex()),
    "a record of the maker's": ("03 00 0000 0080", "04 00 0000 0080 0000 03 09" + b"Own record".hex()),
    "an object that there is not": ("03 00 0000 ff7f", "07 00 0000 00000206"),
    "an output": ("05 00 0000 4060 00 07", "06 00 0000 4060 00 07 0600 1000 7f00" + b"Controlword".hex()),
    "an input": ("05 00 0000 4160 00 07", "06 00 0000 4160 00 07 0600 1000 8700" + b"Statusword".hex()),
    "an entry of PRE-OP": ("05 00 0000 0016 01 07", "06 00 0000 0016 01 07 0700 2000 0f00" + b"Place".hex()),
    "a bit": ("05 00 0000 0070 02 07", "06 00 0000 0070 02 07 0100 0100 0700" + b"Bit 2".hex()),
    "subindex 0": ("05 00 0000 0070 00 07", "06 00 0000 0070 00 07 0500 0800 0700" + b"Number of entries".hex()),
    "limits where there are some": (
        "05 00 0000 7b60 00 7f",
        "06 00 0000 7b60 00 67 0300 1000 3f00 feff 0102" + b"Limited".hex(),
    ),
    "an upper limit alone": ("05 00 0000 7b60 00 40", "06 00 0000 7b60 00 40 0300 1000 3f00 0102" + b"Limited".hex()),
    "no limits where there are none": (
        "05 00 0000 4060 00 60",
        "06 00 0000 4060 00 00 0600 1000 7f00" + b"Controlword".hex(),
    ),
    "a gap in a record": ("05 00 0000 0080 01 07", "06 00 0000 0080 01 07 0000 0000 0000"),
    "a subindex beyond the last one": ("05 00 0000 0080 04 07", "07 00 0000 11000906"),
    "a cut entry request": ("05 00 0000 0080 01", "07 00 0000 10000706"),
    "an unknown operation": ("0a 00 0000 0080", "07 00 0000 01000405"),
    "a response as a request": ("02 00 0000 0100", "07 00 0000 01000405"),
}


@pytest.mark.parametrize(("sent", "received"), CONVERSATIONS.values(), ids=CONVERSATIONS.keys())
def test_sdo_information_conversation(sent: str, received: str) -> None:
    answer = SdoInformation(dictionary(), 128).answer(bytes.fromhex(sent))
    assert answer == [bytes.fromhex(received)]


@pytest.mark.parametrize("send_size", [16, 17, 23, 24, 64, 128])
def test_soem_puts_a_fragmented_list_together(send_size: int) -> None:
    objects = ObjectDictionary()
    for index in range(0x2000, 0x2000 + 101):
        objects.variable(index, "Number", DataType.UNSIGNED8)
    fragments = SdoInformation(objects, send_size).answer(bytes.fromhex("01 00 0000 0100"))
    indices: list[int] = []
    for position, fragment in enumerate(fragments):
        operation, _, left = struct.unpack_from("<BBH", fragment)
        assert left == len(fragments) - 1 - position
        assert operation == (0x82 if left else 0x02)
        assert len(fragment) + 8 <= send_size
        # SOEM takes whole indices from each fragment, after the list type in the first.
        data = fragment[4:] if position else fragment[6:]
        assert len(data) % 2 == 0
        indices += struct.unpack(f"<{len(data) // 2}H", data)
    assert indices == list(range(0x2000, 0x2000 + 101))


def test_a_long_name_is_sent_in_fragments() -> None:
    objects = ObjectDictionary()
    objects.variable(0x2000, "A name that is longer than the mailbox", DataType.UNSIGNED8)
    fragments = SdoInformation(objects, 32).answer(bytes.fromhex("03 00 0000 0020"))
    assert len(fragments) > 1
    assert b"".join(fragment[4:] for fragment in fragments)[6:] == b"A name that is longer than the mailbox"
