import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.virtual.coe import SdoServer, emergency_message
from rtcp.virtual.device import Emergency
from rtcp.virtual.objects import Access, DataType, Entry, ObjectCode, ObjectDictionary, SdoAbort, Value

PREOP, SAFEOP, OP = 2, 4, 8


def refuse_13(_: Entry, value: Value) -> None:
    if value == 13:
        raise SdoAbort(0x08000020)


def dictionary() -> ObjectDictionary:
    objects = ObjectDictionary()
    objects.variable(0x1000, "Device type", DataType.UNSIGNED32, 0x00020192)
    objects.variable(0x1008, "Name", DataType.VISIBLE_STRING, b"Virtual drive")
    objects.variable(0x1009, "Empty", DataType.VISIBLE_STRING, b"")
    objects.variable(0x2000, "Limited", DataType.INTEGER16, 5, Access.RW, minimum=-10, maximum=100, on_write=refuse_13)
    objects.variable(0x2001, "Write only", DataType.UNSIGNED8, 7, Access.WO)
    objects.variable(0x2002, "In PRE-OP", DataType.UNSIGNED8, 7, Access.RW_PREOP)
    objects.variable(0x2003, "Text", DataType.OCTET_STRING, bytes(60), Access.RW)
    objects.variable(0x2004, "Flag", DataType.BOOLEAN, 0, Access.RW)
    objects.variable(0x2005, "Wide", DataType.INTEGER64, -2, Access.RW)
    objects.variable(0x2006, "Real", DataType.REAL32, 0.5, Access.RW)
    objects.variable(0x2007, "Read in OP", DataType.UNSIGNED8, 9, Access.READ_OP)
    objects.record(
        0x3000,
        "Record",
        [
            Entry(0x3000, 1, "Word", DataType.UNSIGNED16, 0x1234, Access.RW, maximum=0x8000),
            Entry(0x3000, 2, "Fixed", DataType.UNSIGNED8, 0x56),
            Entry(0x3000, 3, "Secret", DataType.UNSIGNED8, 0x99, Access.WO),
            Entry(0x3000, 4, "Long", DataType.INTEGER32, -1, Access.RW),
        ],
    )
    objects.record(
        0x3001,
        "Bits",
        [Entry(0x3001, n, f"Bit {n}", DataType.BOOLEAN, n & 1, Access.RW) for n in range(1, 11)],
        code=ObjectCode.ARRAY,
    )
    objects.record(0x3002, "Read only", [Entry(0x3002, 1, "One", DataType.UNSIGNED32, 0x01020304)])
    objects.record(
        0x3003, "Secrets", [Entry(0x3003, 1, "One", DataType.UNSIGNED8, 1, Access.WO)], count_access=Access.WO
    )
    objects.record(0x3004, "None yet", [])
    return objects


# Each conversation: what the client sends and what it receives (None: nothing), without mailbox and CoE header.
# The first byte is the command, then index and subindex, then data (ETG.1000.6, 5.6.2).
CONVERSATIONS = {
    "expedited upload of four bytes": [("40 0010 00 00000000", "43 0010 00 92010200")],
    "expedited upload of one byte": [("40 0220 00 00000000", "4f 0220 00 07000000")],
    "expedited upload of two bytes": [("40 0020 00 00000000", "4b 0020 00 05000000")],
    "upload of a real": [("40 0620 00 00000000", "43 0620 00 0000003f")],
    "normal upload": [("40 0520 00 00000000", "41 0520 00 08000000 feffffffffffffff")],
    "normal upload of an empty string": [("40 0910 00 00000000", "41 0910 00 00000000")],
    "expedited download": [
        ("2b 0020 00 07000000", "60 0020 00 00000000"),
        ("40 0020 00 00000000", "4b 0020 00 07000000"),
    ],
    "expedited download of a negative value": [
        ("2b 0020 00 f6ff0000", "60 0020 00 00000000"),
        ("40 0020 00 00000000", "4b 0020 00 f6ff0000"),
    ],
    "normal download of two bytes": [
        ("21 0020 00 02000000 0900", "60 0020 00 00000000"),
        ("40 0020 00 00000000", "4b 0020 00 09000000"),
    ],
    "normal download of eight bytes": [
        ("21 0520 00 08000000 0102030405060708", "60 0520 00 00000000"),
        ("40 0520 00 00000000", "41 0520 00 08000000 0102030405060708"),
    ],
    "shorter string than there is room for": [
        ("21 0320 00 03000000 616263", "60 0320 00 00000000"),
        ("40 0320 00 00000000", "47 0320 00 61626300"),
    ],
    "segmented download whose last segment is short": [
        ("21 0320 00 0a000000", "60 0320 00 00000000"),
        ("00 31323334353637", "20 00000000000000"),
        ("19 38393000000000", "30 00000000000000"),
        ("40 0320 00 00000000", "41 0320 00 0a000000 31323334353637383930"),
    ],
    "segmented download of fourteen bytes, seven and seven": [
        ("21 0320 00 0e000000", "60 0320 00 00000000"),
        ("00 31323334353637", "20 00000000000000"),
        ("11 38393031323334", "30 00000000000000"),
    ],
    "complete upload from subindex 0, what may not be read as zero": [
        ("50 0030 00 00000000", "51 0030 00 0a000000 0400 3412 56 00 ffffffff")
    ],
    "complete upload from subindex 1": [("50 0030 01 00000000", "51 0030 01 08000000 3412 56 00 ffffffff")],
    "complete upload of bits": [("50 0130 00 00000000", "53 0130 00 0a005501")],
    "complete upload of four bytes": [("50 0230 01 00000000", "53 0230 01 04030201")],
    "complete upload of a record without entries": [("50 0430 00 00000000", "5b 0430 00 00000000")],
    "complete upload of a variable": [("50 0010 00 00000000", "53 0010 00 92010200")],
    "complete download passes over read-only entries": [
        ("31 0030 00 0a000000 0400 0100 ff 02 03000000", "70 0030 00 00000000"),
        ("50 0030 00 00000000", "51 0030 00 0a000000 0400 0100 56 00 03000000"),
    ],
    "complete download from subindex 1": [
        ("31 0030 01 08000000 0100 ff 02 03000000", "70 0030 01 00000000"),
        ("40 0030 04 00000000", "43 0030 04 03000000"),
    ],
    "complete expedited download of bits": [
        ("33 0130 00 0a00aa02", "70 0130 00 00000000"),
        ("50 0130 00 00000000", "53 0130 00 0a00aa02"),
    ],
    "read of a write-only object": [("40 0120 00 00000000", "80 0120 00 01000106")],
    "complete read of nothing readable": [("50 0330 00 00000000", "80 0330 00 01000106")],
    "write of a read-only object": [("23 0010 00 01000000", "80 0010 00 02000106")],
    "complete write of nothing writable": [("31 0230 01 04000000 01020304", "80 0230 01 02000106")],
    "object absent": [("40 ff7f 00 00000000", "80 ff7f 00 00000206")],
    "subindex absent": [("40 0030 05 00000000", "80 0030 05 11000906")],
    "write of an absent object": [("2f ff7f 00 01000000", "80 ff7f 00 00000206")],
    "value too high": [("2b 0020 00 65000000", "80 0020 00 31000906")],
    "value too low": [("2b 0020 00 f5ff0000", "80 0020 00 32000906")],
    "flag that is neither 0 nor 1": [("2f 0420 00 02000000", "80 0420 00 31000906")],
    "the object's own refusal, which keeps the value": [
        ("2b 0020 00 0d000000", "80 0020 00 20000008"),
        ("40 0020 00 00000000", "4b 0020 00 05000000"),
    ],
    "too many bytes": [("23 0020 00 01000000", "80 0020 00 12000706")],
    "too few bytes": [("2f 0020 00 01000000", "80 0020 00 13000706")],
    "too many bytes announced": [("21 0320 00 3d000000", "80 0320 00 12000706")],
    "more bytes sent than announced": [("21 0020 00 02000000 010203", "80 0020 00 10000706")],
    "complete download too long": [("31 0030 01 09000000 0100 ff 02 03000000 00", "80 0030 01 12000706")],
    "complete download too short": [("31 0030 01 07000000 0100 ff 02 030000", "80 0030 01 13000706")],
    "complete download without a count": [("3f 0030 00 04000000", "80 0030 00 13000706")],
    "complete access from subindex 2": [("50 0030 02 00000000", "80 0030 02 00000106")],
    "complete download all or nothing: too high a value after a good one": [
        ("31 0030 00 0a000000 0400 0180 00 00 07000000", "80 0030 00 31000906"),
        ("50 0030 01 00000000", "51 0030 01 08000000 3412 56 00 ffffffff"),
    ],
    "segments longer than announced": [
        ("21 0320 00 08000000", "60 0320 00 00000000"),
        ("00 31323334353637", "20 00000000000000"),
        ("11 31323334353637", "80 0320 00 12000706"),
    ],
    "segments shorter than announced": [
        ("21 0320 00 08000000", "60 0320 00 00000000"),
        ("01 31323334353637", "80 0320 00 13000706"),
    ],
    "toggle bit not changed ends the transfer": [
        ("21 0320 00 15000000", "60 0320 00 00000000"),
        ("00 31323334353637", "20 00000000000000"),
        ("00 31323334353637", "80 0320 00 00000305"),
        ("10 31323334353637", "80 3132 33 01000405"),
    ],
    "download segment without a transfer": [("00 01020304050607", "80 0102 03 01000405")],
    "upload segment without a transfer": [("60 0020 00 00000000", "80 0020 00 01000405")],
    "unknown command specifier": [("a0 0020 00 00000000", "80 0020 00 01000405")],
    "client's abort is not answered and ends the transfer": [
        ("21 0320 00 15000000", "60 0320 00 00000000"),
        ("80 0320 00 00000405", None),
        ("00 31323334353637", "80 3132 33 01000405"),
    ],
    "new request ends the transfer under way": [
        ("21 0320 00 15000000", "60 0320 00 00000000"),
        ("40 0020 00 00000000", "4b 0020 00 05000000"),
        ("00 31323334353637", "80 3132 33 01000405"),
    ],
}


@pytest.mark.parametrize("conversation", CONVERSATIONS.values(), ids=CONVERSATIONS.keys())
def test_sdo_conversation(conversation: list[tuple[str, str | None]]) -> None:
    server = SdoServer(dictionary(), 128)
    for sent, received in conversation:
        expected = None if received is None else bytes.fromhex(received)
        assert server.answer(bytes.fromhex(sent), PREOP) == expected


# With a send mailbox of 24 bytes: 8 bytes in the normal answer, 15 a segment.
SMALL_MAILBOX = {
    "segmented upload": [
        ("40 0810 00 00000000", "41 0810 00 0d000000 5669727475616c20"),
        ("60 0810 00 00000000", "05 6472697665 0000"),
    ],
    "upload toggle bit not changed": [
        ("40 0320 00 00000000", "41 0320 00 3c000000 0000000000000000"),
        ("60 0320 00 00000000", "00" + "00" * 15),
        ("60 0320 00 00000000", "80 0320 00 00000305"),
        ("70 0320 00 00000000", "80 0320 00 01000405"),
    ],
    "upload aborted by the client": [
        ("40 0320 00 00000000", "41 0320 00 3c000000 0000000000000000"),
        ("80 0320 00 00000405", None),
        ("60 0320 00 00000000", "80 0320 00 01000405"),
    ],
}


@pytest.mark.parametrize("conversation", SMALL_MAILBOX.values(), ids=SMALL_MAILBOX.keys())
def test_sdo_conversation_through_a_small_mailbox(conversation: list[tuple[str, str | None]]) -> None:
    server = SdoServer(dictionary(), 24)
    for sent, received in conversation:
        expected = None if received is None else bytes.fromhex(received)
        assert server.answer(bytes.fromhex(sent), PREOP) == expected


@pytest.mark.parametrize("state", [PREOP, SAFEOP, OP])
def test_rights_follow_the_al_state(state: int) -> None:
    server = SdoServer(dictionary(), 128)
    written = server.answer(bytes.fromhex("2f 0220 00 01000000"), state)
    read = server.answer(bytes.fromhex("40 0720 00 00000000"), state)
    refused = "22000008"
    assert (written[4:].hex() == refused) == (state != PREOP)
    assert (read[4:].hex() == refused) == (state != OP)


@pytest.mark.parametrize("state", [0, 1, 3])
def test_nothing_is_read_or_written_where_there_is_no_mailbox(state: int) -> None:
    server = SdoServer(dictionary(), 128)
    for request in ("40 0020 00 00000000", "2b 0020 00 01000000", "50 0030 00 00000000", "33 0130 00 0a00aa02"):
        assert server.answer(bytes.fromhex(request), state)[4:].hex() == "22000008"


def test_the_error_flag_of_the_al_state_changes_no_right() -> None:
    assert SdoServer(dictionary(), 128).answer(bytes.fromhex("2f 0220 00 01000000"), 0x12)[0] == 0x60


def test_a_value_becomes_visible_only_after_the_last_segment() -> None:
    objects = dictionary()
    server = SdoServer(objects, 128)
    server.answer(bytes.fromhex("21 0320 00 08000000"), PREOP)
    server.answer(bytes.fromhex("00 31323334353637"), PREOP)
    assert objects[0x2003, 0].value == bytes(60)
    server.answer(bytes.fromhex("1d 38000000000000"), PREOP)
    assert objects[0x2003, 0].value == b"12345678"


def test_a_write_hook_sees_the_old_value_stored() -> None:
    objects = ObjectDictionary()
    seen = []
    objects.variable(
        0x2000, "Watched", DataType.UNSIGNED8, 1, Access.RW, on_write=lambda entry, new: seen.append((entry.value, new))
    )
    SdoServer(objects, 128).answer(bytes.fromhex("2f 0020 00 02000000"), PREOP)
    assert seen == [(1, 2)]


def test_an_emergency_is_error_code_register_and_five_bytes() -> None:
    # CoE service 1 (ETG.1000.6, 5.6.4): 0x8611 following error, register 0x21.
    assert emergency_message(Emergency(0x8611, 0x21, b"\x01\x02")).hex() == "0010" + "1186" + "21" + "0102000000"


class Client:
    """Uploads and downloads as SOEM does, with its rules for sizes."""

    def __init__(self, server: SdoServer, receive_size: int) -> None:
        self.server = server
        self.receive_size = receive_size

    def ask(self, request: bytes) -> bytes:
        answer = self.server.answer(request, PREOP)
        assert len(answer) >= 8
        return answer

    def download(self, index: int, data: bytes, *, complete: bool = False) -> None:
        first = self.receive_size - 16
        head = struct.pack("<BHBI", 0x31 if complete else 0x21, index, 0, len(data))
        assert self.ask(head + data[:first])[0] & 0xE0 == 0x60
        data, toggle, more = data[first:], 0, len(data) > first
        while more:
            part, data = data[: first + 7], data[first + 7 :]
            more = bool(data)
            command = toggle | (0 if more else 1)
            if not more and len(part) < 7:
                command |= (7 - len(part)) << 1
            assert self.ask(bytes((command,)) + part.ljust(7, b"\0"))[0] == 0x20 | toggle
            toggle ^= 0x10

    def upload(self, index: int, send_size: int) -> bytes:
        answer = self.ask(struct.pack("<BHBI", 0x40, index, 0, 0))
        if answer[0] & 2:
            return answer[4 : 8 - (answer[0] >> 2 & 3)]
        (size,) = struct.unpack_from("<I", answer, 4)
        data, toggle, last = answer[8:], 0, len(answer) - 8 >= size
        while not last:
            answer = self.ask(struct.pack("<BHBI", 0x60 | toggle, index, 0, 0))
            assert len(answer) + 8 <= send_size
            assert answer[0] & 0xF0 == toggle
            last = bool(answer[0] & 1)
            part = answer[1:]
            data += part[: 7 - (answer[0] >> 1 & 7)] if last and len(part) == 7 else part
            toggle ^= 0x10
        assert len(data) == size
        return data


@given(data=st.binary(max_size=300), receive_size=st.integers(16, 140), send_size=st.integers(16, 140))
def test_what_is_written_is_read_back_through_mailboxes_of_any_size(
    data: bytes, receive_size: int, send_size: int
) -> None:
    objects = ObjectDictionary()
    objects.variable(0x2000, "Blob", DataType.OCTET_STRING, bytes(300), Access.RW)
    client = Client(SdoServer(objects, send_size), receive_size)
    client.download(0x2000, data)
    assert client.upload(0x2000, send_size) == data


@given(receive_size=st.integers(16, 40), value=st.integers(0, 0x8000))
def test_a_record_is_written_whole_through_mailboxes_of_any_size(receive_size: int, value: int) -> None:
    objects = dictionary()
    Client(SdoServer(objects, 128), receive_size).download(
        0x3000, struct.pack("<BxHBBi", 4, value, 0, 1, -value), complete=True
    )
    assert (objects[0x3000, 1].value, objects[0x3000, 4].value) == (value, -value)
