"""Answers to single datagrams: an old or foreign frame at the port's socket is not the answer."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

import pytest

from rtcp.fieldbus import registers
from rtcp.fieldbus.errors import BusError
from rtcp.fieldbus.registers import (
    FIRST_INDEX,
    PATIENT_TRIES,
    TRIES,
    Answer,
    DatagramCommand,
    RegisterPort,
    build_frame,
)

STATUS = bytes((8, 0, 0, 0, 0, 0))


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RegisterPort, socket.socket]]:
    """A port and the other end of its wire."""
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    monkeypatch.setattr(registers, "open_socket", lambda *arguments: near)
    yield RegisterPort("lan"), far
    near.close()
    far.close()


def answer(command: DatagramCommand, station: int, address: int, data: bytes) -> bytes:
    frame = bytearray(build_frame(command, FIRST_INDEX, station, address, data))
    frame[26 + len(data) : 28 + len(data)] = b"\x01\0"
    return bytes(frame)


@pytest.mark.parametrize(
    "late",
    [
        answer(DatagramCommand.FPRD, 0x1003, 0x0130, STATUS),
        answer(DatagramCommand.FPRD, 0x1005, 0x0300, STATUS),
        answer(DatagramCommand.FPRD, 0x1005, 0x0130, STATUS + b"\0\0"),
        answer(DatagramCommand.FPWR, 0x1005, 0x0130, STATUS),
        answer(DatagramCommand.FPRD, 0x1005, 0x0130, STATUS)[:30],
    ],
    ids=["another slave's", "another register's", "longer", "another command's", "cut"],
)
def test_an_old_answer_with_the_same_index_is_not_taken_for_the_one_awaited(
    ends: tuple[RegisterPort, socket.socket], late: bytes
) -> None:
    port, wire = ends
    wire.send(late)
    wire.send(answer(DatagramCommand.FPRD, 0x1005, 0x0130, b"\x12" + STATUS[1:]))
    assert port.exchange(DatagramCommand.FPRD, 0x1005, 0x0130, bytes(6), tries=1) == Answer(b"\x12" + STATUS[1:], 1)


@pytest.mark.parametrize(
    "command", [DatagramCommand.BRD, DatagramCommand.APRD, DatagramCommand.APWR, DatagramCommand.BWR]
)
def test_a_position_that_the_slaves_have_counted_up_is_no_other_answer(
    ends: tuple[RegisterPort, socket.socket], command: DatagramCommand
) -> None:
    port, wire = ends
    wire.send(answer(command, 5, 0x0130, STATUS))
    assert port.exchange(command, 0xFFFE, 0x0130, bytes(6), tries=1).wkc == 1


def test_an_interrupt_and_a_circulated_frame_are_no_other_answer(ends: tuple[RegisterPort, socket.socket]) -> None:
    port, wire = ends
    frame = bytearray(answer(DatagramCommand.FPRD, 0x1005, 0x0130, STATUS))
    frame[23] |= 0x40
    frame[24:26] = b"\x04\0"
    wire.send(frame)
    assert port.read(0x1005, 0x0130, 6, tries=1) == STATUS


@pytest.mark.parametrize(("tries", "heard"), [(TRIES, False), (PATIENT_TRIES, True)])
def test_a_datagram_is_sent_as_often_as_the_port_is_patient(
    ends: tuple[RegisterPort, socket.socket], tries: int, heard: bool
) -> None:
    port, wire = ends
    port.tries = tries

    def answers_the_tenth() -> None:
        for _ in range(10):
            frame = bytearray(wire.recv(1518))
        frame[26:34] = STATUS + b"\x01\0"
        wire.send(frame)

    slave = threading.Thread(target=answers_the_tenth, daemon=True)
    slave.start()
    assert port.read(0x1005, 0x0130, 6) == (STATUS if heard else None)


def test_what_a_slave_does_not_take_is_told(ends: tuple[RegisterPort, socket.socket]) -> None:
    port, wire = ends
    wire.send(build_frame(DatagramCommand.FPWR, FIRST_INDEX, 0x1005, 0x09A0, bytes(8)))
    with pytest.raises(BusError, match=r"slave 5 \(drive4\) did not take what was written to register 0x09A0"):
        port.put(0x1005, 0x09A0, bytes(8), "slave 5 (drive4)")
