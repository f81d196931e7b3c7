"""Frames lost, late, twice, out of order, garbled, and noise: in simulated instants."""

from __future__ import annotations

from typing import Literal

import pytest

from rtcp.virtual.faults.fault import FOR_EVER, FrameFault, Frames
from rtcp.virtual.faults.frames import MAKERS, Delay, Duplicate, Garble, Loss, Noise, Reorder
from rtcp.virtual.faults.registry import ActiveFault, Planned
from tests.virtual.line import MS, Line, TinyDevice


class Cable:
    """A cable with faults, and the frames that the master received from it."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.frames = Frames(self.received.append)
        self._segment = Line([TinyDevice()]).segment

    def begin(self, fault: FrameFault, t: int = 0) -> ActiveFault:
        return ActiveFault(Planned(fault), self._segment, self.frames, t)

    def send(self, *numbers: int, t: int = 0) -> list[int]:
        """Send frames; return those that reached the segment."""
        reached = []
        for number in numbers:
            if self.frames.arrives():
                reached.append(number)
                self.frames.answers(bytes((number,)) * 8, t)
        return reached

    def numbers(self) -> list[int]:
        numbers = [frame[0] for frame in self.received]
        self.received.clear()
        return numbers


@pytest.fixture
def cable() -> Cable:
    return Cable()


def differing_bits(frame: bytes, number: int) -> int:
    return sum((a ^ number).bit_count() for a in frame)


def test_frames_are_lost_at_their_rate_half_of_them_before_the_segment(cable: Cable) -> None:
    undo = cable.begin(Loss(rate=0.25))
    reached = sum(len(cable.send(number % 256)) for number in range(2000))
    assert 2000 - len(cable.received) == pytest.approx(500, rel=0.1)
    assert undo.counts == {"lost_before": 2000 - reached, "lost_behind": reached - len(cable.received)}
    assert 2000 - reached == pytest.approx(250, rel=0.15)


def test_the_same_seed_loses_the_same_frames_and_another_seed_others() -> None:
    def lost(seed: int) -> list[int]:
        cable = Cable()
        cable.begin(Loss(rate=0.5, seed=seed))
        cable.send(*range(100))
        return cable.numbers()

    assert lost(3) == lost(3) != lost(4)


def test_what_one_fault_strikes_does_not_depend_on_another(cable: Cable) -> None:
    alone = Cable()
    alone.begin(Loss(rate=0.5, seed=1))
    alone.send(*range(100))
    cable.begin(Loss(rate=0.5, seed=9))
    cable.begin(Loss(rate=0.5, seed=1))
    cable.send(*range(100))
    assert set(cable.numbers()) < set(alone.numbers())


def test_a_burst_strikes_the_next_frames_and_no_more(cable: Cable) -> None:
    undo = cable.begin(Loss(burst=3))
    cable.send(1, 2)
    assert not undo.over
    cable.send(3, 4, 5)
    assert cable.numbers() == [4, 5]
    assert undo.over
    assert sum(undo.counts.values()) == 3
    assert not cable.frames.active


def test_late_answers_come_when_they_are_due_and_several_are_under_way(cable: Cable) -> None:
    undo = cable.begin(Delay(ms=3, burst=2))
    cable.send(1, t=0)
    cable.send(2, t=MS)
    cable.send(3, t=2 * MS)
    assert cable.numbers() == [3]
    assert cable.frames.due == 3 * MS
    cable.frames.tick(3 * MS - 1)
    assert cable.numbers() == []
    cable.frames.tick(3 * MS)
    assert cable.numbers() == [1]
    cable.frames.tick(cable.frames.due)
    assert cable.numbers() == [2]
    assert (undo.counts, cable.frames.due, cable.frames.active) == ({"delayed": 2}, FOR_EVER, False)


def test_answers_under_way_when_the_delay_is_cleared_still_arrive(cable: Cable) -> None:
    cable.begin(Delay(ms=3, rate=1.0))(0)
    undo = cable.begin(Delay(ms=3, rate=1.0))
    cable.send(1)
    undo(MS)
    cable.send(2, t=MS)
    cable.frames.tick(3 * MS)
    assert cable.numbers() == [2, 1]


def test_answers_come_twice(cable: Cable) -> None:
    cable.begin(Duplicate(burst=1))
    cable.send(1, 2)
    assert cable.numbers() == [1, 1, 2]


def test_an_answer_comes_after_the_one_that_follows_it(cable: Cable) -> None:
    undo = cable.begin(Reorder(rate=1.0))
    cable.send(1, 2, 3)
    assert cable.numbers() == [2, 1]
    undo(0)
    assert cable.numbers() == [3], "what it kept comes when it is cleared"


def test_a_burst_of_one_is_not_over_before_the_answer_that_it_keeps_has_come(cable: Cable) -> None:
    undo = cable.begin(Reorder(burst=1))
    cable.send(1)
    assert not undo.over
    cable.send(2, 3)
    assert cable.numbers() == [2, 1, 3]
    assert undo.over


@pytest.mark.parametrize(("bits", "turned"), [(1, 1), (5, 5), (1000, 64)])
def test_as_many_bits_are_turned_over_as_asked_for_and_as_there_are(cable: Cable, bits: int, turned: int) -> None:
    cable.begin(Garble(bits=bits, rate=1.0))
    cable.send(7)
    assert [differing_bits(frame, 7) for frame in cable.received] == [turned]


def test_faults_of_several_kinds_meet_an_answer_in_the_order_of_the_cable(cable: Cable) -> None:
    cable.begin(Delay(ms=1, rate=1.0))
    cable.begin(Duplicate(rate=1.0))
    cable.begin(Garble(rate=1.0))
    cable.send(7)
    assert cable.received == []
    cable.frames.tick(MS)
    assert [differing_bits(frame, 7) for frame in cable.received] == [1, 1]
    assert cable.received[0] == cable.received[1], "garbled first, then doubled, then late"


def test_noise_comes_at_its_rate_whether_frames_pass_or_not(cable: Cable) -> None:
    undo = cable.begin(Noise(rate_hz=1000), t=0)
    assert not cable.frames.active
    for _ in range(50):
        cable.frames.tick(cable.frames.due)
    assert undo.counts == {"sent": 50}
    assert cable.frames.due == 51 * MS
    undo(0)
    assert cable.frames.due == FOR_EVER


def test_noise_that_is_late_by_a_stop_of_the_process_is_left_out(cable: Cable) -> None:
    cable.begin(Noise(rate_hz=1000), t=0)
    cable.frames.tick(10_000 * MS)
    assert len(cable.received) == 1
    cable.frames.tick(10_010 * MS)
    assert len(cable.received) == 11


@pytest.mark.parametrize(
    ("protocol", "ethertypes"),
    [("arp", {0x0806}), ("ip", {0x0800}), ("lldp", {0x88CC}), ("ethercat", {0x88A4}), ("other_master", {0x88A4}),
     ("any", {0x0806, 0x0800, 0x88CC, 0x88A4})],
)  # fmt: skip
def test_noise_is_of_the_protocol_asked_for_and_fits_the_cable(
    cable: Cable, protocol: Literal["arp", "ip", "lldp", "ethercat"], ethertypes: set[int]
) -> None:
    cable.begin(Noise(rate_hz=1000, protocol=protocol), t=0)
    for _ in range(200):
        cable.frames.tick(cable.frames.due)
    assert {int.from_bytes(frame[12:14], "big") for frame in cable.received} == ethertypes
    assert all(60 <= len(frame) <= 1514 for frame in cable.received)


def test_the_header_of_an_ip_packet_has_its_checksum(cable: Cable) -> None:
    cable.begin(Noise(rate_hz=1000, protocol="ip"), t=0)
    cable.frames.tick(cable.frames.due)
    header = cable.received[0][14:34]
    total = sum(int.from_bytes(header[n : n + 2], "big") for n in range(0, 20, 2))
    assert (total & 0xFFFF) + (total >> 16) == 0xFFFF


def test_the_same_seed_makes_the_same_noise() -> None:
    def noise(seed: int) -> list[bytes]:
        cable = Cable()
        cable.begin(Noise(rate_hz=1000, seed=seed), t=0)
        for _ in range(20):
            cable.frames.tick(cable.frames.due)
        return cable.received

    assert noise(1) == noise(1) != noise(2)
    assert set(MAKERS) == {"arp", "ip", "lldp", "ethercat", "other_master", "other_soem"}
