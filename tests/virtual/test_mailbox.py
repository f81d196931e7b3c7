from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rtcp.virtual.device import Emergency
from rtcp.virtual.mailbox import MAX_WAITING, Mailbox
from rtcp.virtual.objects import Access, DataType, Entry, ObjectDictionary
from rtcp.virtual.pdo import define_pdo_objects
from rtcp.virtual.protocol import MailboxType

PREOP = 2
UPLOAD = "0a00 0000 00 {counter}3 0020 40 0010 00 00000000"
UPLOADED = "0a00 0000 00 {counter}3 0030 43 0010 00 92010200"


def dictionary() -> ObjectDictionary:
    objects = ObjectDictionary()
    objects.variable(0x1000, "Device type", DataType.UNSIGNED32, 0x00020192)
    objects.variable(0x2000, "Value", DataType.INTEGER16, 0, Access.RW | Access.RXPDO, minimum=-5)
    objects.variable(0x2001, "Text", DataType.OCTET_STRING, bytes(200), Access.RW)
    objects.variable(0x2002, "Real", DataType.REAL64, 0.0, Access.RW)
    objects.record(0x3000, "Record", [Entry(0x3000, 1, "Bit", DataType.BOOLEAN, 0, Access.RW)])
    define_pdo_objects(objects, {0x1600: [(0x2000, 0, 16)]}, {}, [0x1600], [], False)
    return objects


def mailbox(*emergencies: Emergency, size: int = 128) -> Mailbox:
    return Mailbox(dictionary(), deque(emergencies), size, size)


def message(text: str, counter: int = 0) -> bytes:
    return bytes.fromhex(text.format(counter=counter))


def buffer(text: str, counter: int = 0) -> bytes:
    return message(text, counter).ljust(128, b"\0")


def drain(box: Mailbox) -> list[bytes]:
    messages = []
    while box.pending():
        content = box.next_message()
        assert content is not None
        messages.append(content)
    return messages


# Header: length, address, channel and priority, type and counter (ETG.1000.4, table 29).
# Error reply: type 0, command 0x0001, detail (table 30).
REFUSED = {
    "syntax: a cut header": ("0a00 0000 00", "0400 0000 00 10 0100 0100"),
    "syntax: no bytes at all": ("", "0400 0000 00 10 0100 0100"),
    "unsupported protocol: EoE": ("0400 0000 00 02 00000000", "0400 0000 00 10 0100 0200"),
    "unsupported protocol: a zeroed buffer": ("0000 0000 00 00 00000000", "0400 0000 00 10 0100 0200"),
    "invalid channel": ("0a00 0000 01 03 0020 40 0010 00 00000000", "0400 0000 00 10 0100 0300"),
    "service not supported: TxPDO remote request": ("0200 0000 00 03 0060", "0400 0000 00 10 0100 0400"),
    "service not supported: an SDO response": (
        "0a00 0000 00 03 0030 43 0010 00 00000000",
        "0400 0000 00 10 0100 0400",
    ),
    "invalid header: service 0": ("0200 0000 00 03 0000", "0400 0000 00 10 0100 0500"),
    "invalid header: service 9": ("0200 0000 00 03 0090", "0400 0000 00 10 0100 0500"),
    "too short for a CoE header": ("0100 0000 00 03 00", "0400 0000 00 10 0100 0600"),
    "too short for an SDO": ("0900 0000 00 03 0020 40 0010 00 000000", "0400 0000 00 10 0100 0600"),
    "too short for SDO information": ("0600 0000 00 03 0080 01 00 0000", "0400 0000 00 10 0100 0600"),
    "a length beyond the data": ("0b00 0000 00 03 0020 40 0010 00 00000000", "0400 0000 00 10 0100 0800"),
    "the sender's address is kept": ("0400 ea03 00 02 00000000", "0400 ea03 00 10 0100 0200"),
}


@pytest.mark.parametrize(("sent", "received"), REFUSED.values(), ids=REFUSED.keys())
def test_a_malformed_message_is_answered_with_its_error(sent: str, received: str) -> None:
    box = mailbox()
    box.receive(message(sent), PREOP)
    assert drain(box) == [message(received)]


def test_the_priority_of_a_message_is_no_part_of_its_channel() -> None:
    box = mailbox()
    box.receive(message("0a00 0000 c0 13 0020 40 0010 00 00000000"), PREOP)
    assert drain(box) == [message(UPLOADED, 1)]


def test_a_repeated_request_is_answered_once() -> None:
    box = mailbox()
    box.receive(buffer(UPLOAD, 3), PREOP)
    box.receive(buffer(UPLOAD, 3), PREOP)
    assert len(drain(box)) == 1


def test_the_slave_counts_its_own_messages_from_one_to_seven() -> None:
    box = mailbox()
    for n in range(8):
        box.receive(buffer(UPLOAD, n % 7 + 1), PREOP)
    assert [sent[5] >> 4 for sent in drain(box)] == [1, 2, 3, 4, 5, 6, 7, 1]


def test_answers_come_in_the_order_of_their_requests() -> None:
    box = mailbox()
    box.receive(buffer("0a00 0000 00 13 0020 4f 0010 00 00000000"), PREOP)
    box.receive(buffer("0a00 0000 00 23 0020 40 ff7f 00 00000000"), PREOP)
    assert [sent[8] for sent in drain(box)] == [0x43, 0x80]


def test_an_emergency_follows_the_answer_of_the_write_that_caused_it() -> None:
    emergencies: deque[Emergency] = deque()
    objects = dictionary()
    objects.variable(
        0x2003, "Test", DataType.INTEGER16, 0, Access.RW,
        on_write=lambda entry, value: emergencies.append(Emergency(0x8611, 0x21)),
    )  # fmt: skip
    box = Mailbox(objects, emergencies, 128, 128)
    box.receive(buffer("0a00 0000 00 13 0020 2b 0320 00 01000000"), PREOP)
    assert [sent[7] >> 4 for sent in drain(box)] == [3, 1], "CoE services: SDO response, emergency"


def test_emergencies_that_wait_go_first_and_in_their_order() -> None:
    box = mailbox(Emergency(0x8611, 0x21, b"\x01\x02\x03\x04\x05"), Emergency(0x0000, 0))
    box.receive(buffer(UPLOAD, 1), PREOP)
    assert drain(box) == [
        message("0a00 0000 00 13 0010 1186 21 0102030405"),
        message("0a00 0000 00 23 0010 0000 00 0000000000"),
        message(UPLOADED, 3),
    ]


def test_sdo_information_comes_as_several_messages() -> None:
    box = mailbox(size=24)
    box.receive(message("0800 0000 00 13 0080 01 00 0000 0100"), PREOP)
    sent = drain(box)
    assert [bytes(part[6:12]).hex() for part in sent] == ["008082000100", "008002000000"]
    assert all(len(part) <= 24 and len(part) == 6 + part[0] for part in sent)


def test_a_master_that_never_reads_exhausts_no_memory() -> None:
    box = mailbox()
    for _ in range(10 * MAX_WAITING):
        box.receive(buffer(UPLOAD), PREOP)
    sent = drain(box)
    assert len(sent) == MAX_WAITING + 1
    assert sent[-1][6:].hex() == "01000700"
    box.receive(buffer(UPLOAD), PREOP)
    assert drain(box)[0][6:] == message(UPLOADED)[6:]


def test_a_message_longer_than_the_receive_mailbox_is_refused() -> None:
    box = Mailbox(dictionary(), deque(), 16, 16)
    box.receive(message("0b00 0000 00 03 0020 21 0120 00 01000000 31"), PREOP)
    assert drain(box)[0][6:].hex() == "01000800"


@pytest.mark.parametrize(
    ("receive", "send", "named"), [(15, 16, "receive mailbox has 15"), (16, 8, "send mailbox has 8")]
)
def test_a_mailbox_too_small_for_an_sdo_is_refused(receive: int, send: int, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        Mailbox(dictionary(), deque(), receive, send)


def test_a_protocol_that_a_model_adds_is_answered_and_an_answer_without_room_is_refused() -> None:
    answers = [b"ab", bytes(123)]
    box = Mailbox(dictionary(), deque(), 128, 128, protocols={MailboxType.VOE: lambda content, room: answers})
    box.receive(message("0200 0000 00 0f 0102"), PREOP)
    assert drain(box) == [message("0200 0000 00 1f 6162"), message("0400 0000 00 20 0100 0800")]


INDICES = st.sampled_from([0x1000, 0x1600, 0x1C12, 0x2000, 0x2001, 0x2002, 0x3000, 0x7FFF])


@st.composite
def almost_right(draw: st.DrawFn) -> bytes:
    """A mailbox message whose headers are mostly those of a CoE service."""
    service = draw(st.sampled_from([2, 2, 2, 8, 8, 0, 5]))
    head = bytes((0, service << 4)) + draw(st.binary(min_size=1, max_size=1))
    content = head + draw(INDICES).to_bytes(2, "little") + draw(st.binary(max_size=60))
    length = draw(st.sampled_from([len(content), len(content), 0, 10, 0xFFFF]))
    kind = draw(st.integers(0, 7)) << 4 | draw(st.sampled_from([3, 3, 3, 0, 15]))
    return length.to_bytes(2, "little") + bytes((0, 0, 0, kind)) + content


@settings(max_examples=300)
@given(
    messages=st.lists(st.one_of(st.binary(max_size=140), almost_right()), max_size=12),
    state=st.integers(0, 255),
    size=st.integers(16, 140),
)
def test_no_message_breaks_the_mailbox(messages: list[bytes], state: int, size: int) -> None:
    box = mailbox(size=size)
    for sent in messages:
        box.receive(sent, state)
        for answer in drain(box):
            assert len(answer) == 6 + int.from_bytes(answer[:2], "little") <= size
    box.receive(message(UPLOAD), PREOP)
    (answer,) = drain(box)
    assert answer[6:] == message(UPLOADED)[6:]
