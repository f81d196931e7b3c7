"""SDO services as lists of (sent, received) bytes, from the CoE header on (ETG.1000.6, 5.6.2); mailbox of 32 bytes."""

from __future__ import annotations

import threading
from collections.abc import Callable

import pytest

from rtcp.fieldbus import BusError, SdoAborted
from rtcp.fieldbus.describe import read_entry
from rtcp.fieldbus.mailbox import SdoClient

EMERGENCY = bytes.fromhex("0010 1186 21 0102030405")


class Script:
    """A slave that expects a list of requests and answers them; None: it stays silent."""

    room = 26
    patience_s = 0.0

    def __init__(self, *exchanges: tuple[str, str | None], first: bytes | None = None) -> None:
        self.exchanges = [(bytes.fromhex(a), None if b is None else bytes.fromhex(b)) for a, b in exchanges]
        self.waiting = [first] if first else []
        self.silent = False

    def receive(self) -> bytes | None:
        if not self.waiting and self.silent:
            self.silent = False
            raise BusError("no answer in time")
        return self.waiting.pop() if self.waiting else None

    def send(self, content: bytes) -> bool:
        sent, answer = self.exchanges.pop(0)
        assert content == sent
        self.silent = answer is None
        if answer is not None:
            self.waiting.append(answer)
        return True


@pytest.fixture
def other() -> list[tuple[bytes, int]]:
    return []


ClientOf = Callable[[Script | None], SdoClient]


@pytest.fixture
def client_of(other: list[tuple[bytes, int]]) -> ClientOf:
    def make(script: Script | None) -> SdoClient:
        return SdoClient(script, 3, "drive2", threading.Lock(), lambda *message: other.append(message))  # type: ignore[arg-type]

    return make


READ = "0020 40 4160 00 00000000"
WRITE = "0020 2b 4060 00 0f000000"


@pytest.mark.parametrize(
    ("answer", "value"),
    [
        ("0030 4f 4160 00 37000000", "37"),
        ("0030 4b 4160 00 37020000", "3702"),
        ("0030 43 4160 00 37020102", "37020102"),
        ("0030 42 4160 00 37020102", "37020102"),
        ("0030 41 4160 00 06000000 010203040506", "010203040506"),
    ],
)
def test_an_object_is_read_expedited_or_in_one_message(client_of: ClientOf, answer: str, value: str) -> None:
    assert client_of(Script((READ, answer))).read(0x6041, 0).hex() == value


def test_a_long_object_is_read_in_segments(client_of: ClientOf) -> None:
    script = Script(
        ("0020 40 0810 00 00000000", "0030 41 0810 00 18000000 000102030405060708090a0b0c0d0e0f"),
        ("0020 60 0000 00 00000000", "0030 00 10111213141516"),
        ("0020 70 0000 00 00000000", "0030 1d 17000000000000"),
    )
    assert client_of(script).read(0x1008, 0) == bytes(range(24))


def test_a_segment_that_is_repeated_is_not_taken_twice(client_of: ClientOf) -> None:
    repeated = [
        ("0020 40 0810 00 00000000", "0030 41 0810 00 18000000 000102030405060708090a0b0c0d0e0f"),
        ("0020 60 0000 00 00000000", "0030 10 10111213141516"),
    ]
    with pytest.raises(BusError, match="repeated a segment"):
        client_of(Script(*repeated, *repeated)).read(0x1008, 0)


@pytest.mark.parametrize(
    ("data", "request_bytes"),
    [
        ("0f", "0020 2f 4060 00 0f000000"),
        ("0f00", WRITE),
        ("0f0102", "0020 27 4060 00 0f010200"),
        ("0f010203", "0020 23 4060 00 0f010203"),
        ("0f01020304", "0020 21 4060 00 05000000 0f01020304"),
    ],
)
def test_an_object_is_written_expedited_or_in_one_message(client_of: ClientOf, data: str, request_bytes: str) -> None:
    client_of(Script((request_bytes, "0030 60 4060 00 00000000"))).write(0x6040, 0, bytes.fromhex(data))


def test_a_long_object_is_written_in_segments(client_of: ClientOf) -> None:
    script = Script(
        ("0020 21 0020 01 2a000000" + bytes(range(16)).hex(), "0030 60 0020 01 00000000"),
        ("0020 00" + bytes(range(16, 39)).hex(), "0030 20 0000 00 00000000"),
        ("0020 19 27282900000000", "0030 30 0000 00 00000000"),
    )
    client_of(script).write(0x2000, 1, bytes(range(42)))
    assert script.exchanges == []


@pytest.mark.parametrize("service", ["0020", "0030"])
def test_an_abort_is_told_in_words_as_request_or_as_response(client_of: ClientOf, service: str) -> None:
    with pytest.raises(SdoAborted) as refused:
        client_of(Script((WRITE, f"{service} 80 4060 00 31000906"))).write(0x6040, 0, b"\x0f\x00")
    assert refused.value.code == 0x06090031
    assert str(refused.value) == (
        "slave 3 (drive2) refused the write of 0f 00 to 0x6040:0: abort code 0x06090031, value too high"
    )


def test_a_silent_slave_is_asked_once_more(client_of: ClientOf) -> None:
    assert client_of(Script((READ, None), (READ, "0030 4b 4160 00 37020000"))).read(0x6041, 0) == b"\x37\x02"


def test_messages_that_get_lost_are_sent_again_for_as_long_as_the_port_is_patient(client_of: ClientOf) -> None:
    lost = [(READ, None)] * 6
    script = Script(*lost, (READ, "0030 4b 4160 00 37020000"))
    script.patience_s = 5.0
    assert client_of(script).read(0x6041, 0) == b"\x37\x02"


def test_an_abort_is_not_asked_for_again_however_patient_the_port_is(client_of: ClientOf) -> None:
    script = Script((WRITE, "0020 80 4060 00 31000906"))
    script.patience_s = 5.0
    with pytest.raises(SdoAborted):
        client_of(script).write(0x6040, 0, b"\x0f\x00")


def test_a_slave_that_stays_silent_is_told(client_of: ClientOf) -> None:
    with pytest.raises(BusError, match=r"slave 3 \(drive2\), read of 0x6041:0: no answer in time"):
        client_of(Script((READ, None), (READ, None))).read(0x6041, 0)


def test_an_answer_for_another_object_is_not_taken(client_of: ClientOf) -> None:
    wrong = "0030 4b 4060 00 37020000"
    with pytest.raises(BusError, match="something else"):
        client_of(Script((READ, wrong), (READ, wrong))).read(0x6041, 0)


def test_an_emergency_before_the_answer_is_passed_on(client_of: ClientOf, other: list[tuple[bytes, int]]) -> None:
    script = Script((READ, "0030 4b 4160 00 37020000"), first=EMERGENCY)
    assert client_of(script).read(0x6041, 0) == b"\x37\x02"
    assert other == [(EMERGENCY, 3)]


def test_a_slave_without_mailbox_is_told_to_have_none(client_of: ClientOf) -> None:
    with pytest.raises(BusError, match="no CoE mailbox"):
        client_of(None).read(0x6041, 0)


def test_a_gap_in_a_record_is_no_entry(client_of: ClientOf) -> None:
    script = Script(("0080 05 00 0000 321c 07 00", "0080 06 00 0000 321c 07 00 0000 0000 0000"))
    assert read_entry(client_of(script), 0x1C32, 7) is None
