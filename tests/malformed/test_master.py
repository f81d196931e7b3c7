"""The master on mutated answers: SOEM over a real socket, our own parsers behind theirs."""

from __future__ import annotations

import threading
from random import Random
from typing import Any

import pytest

from rtcp.fieldbus import BusError
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.scan import name_of, read_mailbox
from tests.malformed import mutated_answers
from tests.malformed.cable import answerer, master, report_of
from tests.malformed.line import Line


def test_process_data_are_exchanged_on_through_mutated_answers_and_are_right_again_after_them() -> None:
    with answerer(1) as pid:
        report = report_of(master(pid, "exchange", 1500))
    assert report["mutated"] > 600
    assert sum(report["counters"].values()) == 1500
    # Lost, judged by the working counter, or good: all three come.
    assert min(report["counters"].values()) > 5
    assert report["recovered"]


def test_services_beside_the_cycle_end_in_an_answer_or_a_sentence() -> None:
    with answerer(1) as pid:
        report = report_of(master(pid, "services", 70))
    assert report["mutated"] > 30
    assert bytes.fromhex(report["name"]).startswith(b"Cubemars")


def test_scans_and_configurations_on_mutated_answers_end_in_a_sentence_and_a_sane_scan_follows() -> None:
    with answerer(3) as pid:
        report = report_of(master(pid, "scans", 1))
    assert sum(report["ends"].values()) == 1
    assert report["slaves"] == 7


def test_the_masters_own_parsers_end_in_an_answer_or_a_sentence_and_work_on() -> None:
    outcome = mutated_answers.run(800, 4)
    assert outcome.failures == []
    assert outcome.frames >= 800
    assert outcome.kinds["done"] > 40
    assert outcome.kinds["refused"] > 40
    assert outcome.kinds["emergencies"] > 1
    assert outcome.objects < 20_000


class Eeprom:
    """The methods of a slave in pysoem."""

    def __init__(self, words: dict[int, bytes], name: bytes = b"") -> None:
        self._words = words
        self._name = name

    def eeprom_read(self, word: int, timeout: int) -> bytes:
        return self._words[word]

    @property
    def name(self) -> str:
        return self._name.decode("utf8")


def test_a_mailbox_that_no_frame_can_carry_is_not_used() -> None:
    def usable(receive: int, send: int) -> bool:
        words = {
            0x18: b"\x00\x10" + receive.to_bytes(2, "little"),
            0x1A: b"\x80\x10" + send.to_bytes(2, "little"),
            0x1C: b"\x04\x00\x00\x00",
        }
        mailbox = read_mailbox(Eeprom(words), lambda: ())
        return mailbox is not None and mailbox.has_coe

    assert usable(128, 128)
    assert usable(128, 0)
    assert usable(1486, 16)
    assert not any((usable(0, 128), usable(3, 128), usable(128, 5), usable(65535, 128), usable(128, 1487)))


def test_a_name_in_the_eeprom_that_is_no_utf_8_is_taken_for_latin_1() -> None:
    assert name_of(Eeprom({}, b"Drehgeber")) == "Drehgeber"
    assert name_of(Eeprom({}, "Höhe".encode("latin-1"))) == "Höhe"
    assert name_of(Eeprom({}, b"\xff\xfe\x80")) == "ÿþ\x80"


class Babbler:
    """A slave that answers an upload with its first message and segments with its last, or has one `endless`ly."""

    room = 122
    patience_s = 0.0

    def __init__(self, line: Line, endless: bool, messages: list[str]) -> None:
        self._line = line
        self._endless = endless
        self._messages = [bytes.fromhex(message) for message in messages]
        self._next = -1
        self._waits = False
        self.received = 0

    def send(self, content: bytes) -> bool:
        # An upload is asked for by 0x40, each of its segments by 0x60 or 0x70.
        self._next = 0 if content[2] == 0x40 else len(self._messages) - 1
        self._waits = True
        return True

    def receive(self) -> bytes | None:
        self.received += 1
        self._line.pass_time(100_000)
        waits, self._waits = self._waits or self._endless, False
        return self._messages[self._next] if waits else None


EMERGENCY = "00 10 11 86 01 00 00 00 00 00"
ENDLESS = {
    "emergencies": (True, [EMERGENCY], "its mailbox does not get empty"),
    "emergencies for an answer": (False, [EMERGENCY], "no answer in time"),
    "an object of 4 GiB": (False, ["00 30 41 08 10 00 ff ff ff ff"], "announces 4294967295 bytes; at most 65536 are"),
    "segments without data": (
        False, ["00 30 41 08 10 00 00 01 00 00", "00 30 0e 00 00 00 00 00 00 00"], "a segment without data",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("endless", "messages", "sentence"), ENDLESS.values(), ids=ENDLESS.keys())
def test_a_slave_that_never_comes_to_an_end_ends_in_a_sentence(
    endless: bool, messages: list[str], sentence: str
) -> None:
    line = Line()
    with mutated_answers.looped(line, Random(1)):
        box: Any = Babbler(line, endless, messages)
        client = SdoClient(box, 2, "drive1", threading.Lock(), lambda message, position: None)
        with pytest.raises(BusError, match=sentence):
            client.read(0x1008, 0)
    assert box.received < 40_000
