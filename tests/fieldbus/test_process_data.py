"""The exchange of process data, cycle by cycle: lost answers, the barrier frame, images of a few bits.

SOEM's part is a list of answers here; `test_bus.py` and `test_any_slave.py` do the same with SOEM and its slaves.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest

from rtcp.fieldbus.image import Place, Places
from rtcp.fieldbus.process_data import FrameBarrier, ReferenceFrame, SmallImages, SoemProcessData
from rtcp.fieldbus.registers import DatagramCommand

pytestmark = pytest.mark.interpreted  # `Barrier` takes the place of a compiled class

EXPECTED = 6
LOST = -1


class Slave:
    """A slave of pysoem's: bytes that the master reads and writes."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.input, self.output = bytes(inputs), bytes(outputs)


class Master:
    """Answers with the working counters of a list; each answer brings inputs that count the answers."""

    expected_wkc = EXPECTED

    def __init__(self, slaves: list[Slave], answers: list[int]) -> None:
        self._slaves, self._answers = slaves, iter(answers)
        self.dc_time = 0
        self.waits: list[int] = []
        self.sent: list[list[bytes]] = []

    def send_processdata(self) -> None:
        self.sent.append([slave.output for slave in self._slaves])

    def receive_processdata(self, timeout_us: int) -> int:
        self.waits.append(timeout_us)
        wkc = next(self._answers)
        self.dc_time += 1000
        for slave in self._slaves:
            slave.input = bytes([len(self.waits)]) * len(slave.input)
        return wkc


class Barrier(FrameBarrier):
    """Comes back or not, as the test says."""

    def __init__(self) -> None:
        self.comes_back = True
        self.waits_ns: list[int] = []

    def pass_through(self, timeout_ns: int) -> bool:
        self.waits_ns.append(timeout_ns)
        return self.comes_back


class Line:
    """The exchange over a master that gives these answers, and the socket that SOEM's frames come from."""

    def __init__(self, answers: list[int], size: int = 4) -> None:
        self.slaves = [Slave(size, 2), Slave(0, size)]
        self.master, self.barrier = Master(self.slaves, answers), Barrier()
        self.far, self._near = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._near.setblocking(False)
        places = [Places(Place(0, 16), Place(0, 8 * size)), Places(Place(16, 8 * size), Place(0, 0))]
        self.data = SoemProcessData(
            self.master, self.slaves, places, self._near.fileno(), self.barrier, receive_us=300, barrier_us=70
        )

    def cycle(self) -> int:
        self.data.send()
        return self.data.receive()

    def close(self) -> None:
        self.far.close()
        self._near.close()


@pytest.fixture
def lines() -> Iterator[list[Line]]:
    made: list[Line] = []
    yield made
    for line in made:
        line.close()


def test_the_first_cycle_and_the_one_after_a_lost_answer_wait_for_the_barrier(lines: list[Line]) -> None:
    lines.append(line := Line([EXPECTED, LOST, EXPECTED, EXPECTED]))
    waits = []
    for _ in range(4):
        line.cycle()
        waits.append(len(line.barrier.waits_ns))
    assert waits == [1, 1, 2, 2]
    assert set(line.barrier.waits_ns) == {70_000}
    assert line.data.missed == 1


def test_answers_that_came_late_are_dropped_and_counted(lines: list[Line]) -> None:
    lines.append(line := Line([EXPECTED, LOST, EXPECTED]))
    line.cycle()
    line.cycle()
    line.far.send(b"late")
    line.far.send(b"later")
    assert line.cycle() == EXPECTED
    assert line.data.stale == 2


def test_a_lost_answer_leaves_inputs_and_clock(lines: list[Line]) -> None:
    lines.append(line := Line([EXPECTED, LOST, EXPECTED]))
    line.cycle()
    before = line.data.input(0), line.data.dc_time
    assert before == (b"\x01" * 4, 1000)
    assert line.cycle() == LOST
    assert (line.data.input(0), line.data.dc_time) == before
    line.cycle()
    assert (line.data.input(0), line.data.dc_time) == (b"\x03" * 4, 3000)
    assert line.data.input(1) == b""


def test_without_the_barrier_outputs_are_sent_and_answers_are_ignored_until_it_comes_back(lines: list[Line]) -> None:
    lines.append(line := Line([EXPECTED] * 4))
    line.barrier.comes_back = False
    line.data.set_output(0, b"ab")
    assert line.cycle() == LOST
    line.far.send(b"late")
    assert line.cycle() == LOST
    assert line.master.sent[-1] == [b"ab", bytes(4)]
    assert line.master.waits == [0, 0]
    assert (line.data.missed, line.data.stale, line.data.input(0)) == (2, 1, bytes(4))
    line.barrier.comes_back = True
    assert line.cycle() == EXPECTED
    assert line.master.waits[-1] == 300
    assert line.data.input(0) == b"\x03" * 4
    line.cycle()
    assert len(line.barrier.waits_ns) == 3


def test_an_answer_that_comes_while_the_barrier_is_awaited_is_dropped_at_the_receive(lines: list[Line]) -> None:
    lines.append(line := Line([EXPECTED]))
    line.barrier.comes_back = False
    line.data.send()
    line.far.send(b"late")
    line.data.receive()
    assert line.data.stale == 1


@pytest.mark.parametrize(("size", "barriers"), [(4, 1), (732, 1), (733, 2)])
def test_a_wrong_counter_is_doubtful_where_the_image_takes_several_frames(
    lines: list[Line], size: int, barriers: int
) -> None:
    # One of the frames may have been lost and come late. 2 x 732 + 2 bytes are the most of one frame.
    lines.append(line := Line([EXPECTED - 1, EXPECTED, EXPECTED], size))
    for _ in range(3):
        line.cycle()
    assert len(line.barrier.waits_ns) == barriers


def test_outputs_of_another_length_are_ignored(lines: list[Line]) -> None:
    lines.append(line := Line([EXPECTED] * 2))
    line.data.set_output(0, b"ab")
    line.data.set_output(0, b"abc")
    line.data.set_output(1, b"")
    line.cycle()
    assert line.master.sent == [[b"ab", bytes(4)]]


@pytest.fixture
def segment(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[FrameBarrier, socket.socket]]:
    """A frame barrier, and the socket of the slaves that its frames come to."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    monkeypatch.setattr("rtcp.fieldbus.process_data.open_socket", lambda *_: near)
    barrier = FrameBarrier("ecat0")
    far.setblocking(False)
    yield barrier, far
    barrier.close()
    far.close()


def back(number: int) -> bytes:
    """The barrier frame of this number as it comes back: Ethernet, the frame's header, that of a NOP, the number."""
    return bytes(26) + number.to_bytes(8, "little") + bytes(26)


def test_a_barrier_frame_passes_once_its_own_number_is_back(segment: tuple[FrameBarrier, socket.socket]) -> None:
    barrier, slaves = segment
    slaves.send(back(1))
    assert barrier.pass_through(0)
    sent = slaves.recv(1518)
    assert (sent[12:14], sent[16:17], sent[26:34]) == (b"\x88\xa4", b"\0", (1).to_bytes(8, "little"))
    for number in (1, 2 << 8, 2):  # frames from before it are read and skipped
        slaves.send(back(number))
    assert barrier.pass_through(0)
    assert slaves.recv(1518)[26:34] == (2).to_bytes(8, "little")


def test_a_barrier_frame_that_is_not_back_in_time_does_not_pass(segment: tuple[FrameBarrier, socket.socket]) -> None:
    barrier, slaves = segment
    began = time.monotonic_ns()
    assert not barrier.pass_through(2_000_000)
    assert time.monotonic_ns() - began >= 2_000_000
    slaves.send(back(1))
    assert not barrier.pass_through(0)
    slaves.close()
    assert not barrier.pass_through(60_000_000_000)  # cannot be sent: no wait


def test_the_reference_clocks_time_is_that_of_the_last_frame_and_stays_where_it_does_not_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    monkeypatch.setattr("rtcp.fieldbus.process_data.open_socket", lambda *_: near)
    frame = ReferenceFrame("ecat0", 0x1002)

    def answer(sent: bytes, time_ns: int, wkc: int) -> None:
        far.send(sent[:26] + time_ns.to_bytes(8, "little") + wkc.to_bytes(2, "little") + sent[36:])

    frame.send()
    first = far.recv(1518)
    assert (first[16], first[18:22]) == (DatagramCommand.FRMW, bytes.fromhex("0210 1009"))
    answer(first, 7_000_000_000, 3)
    assert frame.time_of_answer() == 7_000_000_000
    frame.send()
    second = far.recv(1518)
    # The other clocks get the last time, also where the reference is away.
    assert second[26:34] == (7_000_000_000).to_bytes(8, "little")
    answer(second, 7_000_000_000, 0)
    assert frame.time_of_answer() == 7_000_000_000
    frame.send()
    third = far.recv(1518)
    answer(third, 7_002_000_000, 3)
    answer(second, 7_001_000_000, 3)
    assert frame.time_of_answer() == 7_002_000_000
    frame.close()
    far.close()


def test_images_of_a_few_bits_share_bytes_and_keep_their_own_bits() -> None:
    memory = bytearray(b"\xff" * 6)
    # 3 and 7 bits in bytes 0 and 1 with a neighbour's 6 bits behind them; 2 bits in byte 4, which is a run of its own.
    outputs = [(0, Place(0, 3)), (2, Place(3, 7)), (1, Place(32, 2))]
    inputs = [(0, Place(16, 1)), (1, Place(17, 4)), (2, Place(21, 7))]
    images = SmallImages(memoryview(memory), outputs, inputs)
    images.write([b"\xfd", b"\x02", b"\xd5"])
    assert memory == bytes([0b10101_101, 0b10, 0xFF, 0xFF, 0b10, 0xFF])
    memory[2:4] = bytes([0b110_0110_1, 0b1010])
    received = [b"", b"", b"", b"kept"]
    images.read(received)
    assert received == [b"\x01", b"\x06", b"\x56", b"kept"]
