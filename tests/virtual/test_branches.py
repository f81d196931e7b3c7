"""Branches of the cable: the order of frames, delays, ports, faults, and a real master on them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config.segment import load_segment
from rtcp.virtual.faults.slaves import CableFault, Corrupt, PowerFault
from rtcp.virtual.protocol import DatagramCommand
from rtcp.virtual.segment import Segment, check_segment, make_segment
from tests.findings import assert_finds
from tests.virtual.conftest import Master, described
from tests.virtual.frames import Datagram, build, parse
from tests.virtual.line import MS, begin
from tests.virtual.test_described import DRIVE, OUTPUTS

JUNCTION, WITHOUT_PORT_1 = 0x13, 0x14
#  1 -port 3- 2 -port 1- 3
#  |port 1
#  4 -port 3- 5
#  |port 2
#  6, and 7 at port 2 of 1
TREE = (
    described(JUNCTION, "name: root"),
    described(DRIVE, "after: root, port: 3"),
    described(JUNCTION),
    described(JUNCTION, "after: root, name: second, delay_ns: 5000"),
    described(DRIVE, "after: second, port: 3"),
    described(DRIVE, "after: second, port: 2"),
    described(DRIVE, "after: 1, port: 2, delay_ns: 12000"),
)
DELAYS = [0, 840, 1680, 5000, 5840, 7520, 12000]


def tree(folder: Path, *entries: str) -> Segment:
    config = folder / "tree.yaml"
    config.write_text("slaves:\n" + "".join(f"- {{{entry}}}\n" for entry in entries or TREE))
    return make_segment(load_segment(config), 0)


def reached(segment: Segment) -> list[int]:
    return [segment.slaves.index(slave) + 1 for slave in segment.topology.reached]


def ask(segment: Segment, command: int, address: int, offset: int, data: bytes) -> Datagram:
    frame = bytearray(build(Datagram(command, 0, address, offset, data)))
    assert segment.process(frame, len(frame), MS)
    segment.settle(MS)
    return next(parse(frame))


def ports(segment: Segment, number: int) -> str:
    """Return the ports of a slave with a link, by register 0x0110."""
    status = segment.slaves[number - 1].esc.get(0x0110, 2)
    return "".join(str(port) for port in range(4) if status >> 4 + port & 1 and status >> 9 + 2 * port & 1)


def test_frames_go_to_port_3_then_1_then_2_and_every_slave_has_its_links_and_its_delay(tmp_path: Path) -> None:
    segment = tree(tmp_path)
    assert reached(segment) == [1, 2, 3, 4, 5, 6, 7]
    assert [slave.delay for slave in segment.slaves] == DELAYS
    assert [ports(segment, n) for n in range(1, 8)] == ["0123", "01", "0", "023", "0", "0", "0"]
    assert ask(segment, DatagramCommand.BRD, 0, 0x0130, bytes(2)).counter == 7
    # Position 5: the sixth slave in the order of frames.
    assert ask(segment, DatagramCommand.APRD, -5 & 0xFFFF, 0x0910, bytes(8)).counter == 1


def test_where_no_port_is_given_a_slave_hangs_at_the_lowest_that_there_is(tmp_path: Path) -> None:
    segment = tree(tmp_path, described(WITHOUT_PORT_1), described(DRIVE))
    assert [ports(segment, n) for n in (1, 2)] == ["02", "0"]
    assert segment.slaves[0].esc.memory[0x0007] == 0b11_11_00_11


def test_ports_latch_when_the_frame_comes_back_from_each_branch(tmp_path: Path) -> None:
    segment = tree(tmp_path)
    ask(segment, DatagramCommand.BWR, 0, 0x0900, bytes(4))
    esc = segment.slaves[0].esc
    first_port = esc.get(0x0900, 4)
    # Port 3: through slaves 2 and 3 and back. Port 1 follows port 3.
    assert esc.get(0x090C, 4) - first_port == 2 * 1680
    assert esc.get(0x0904, 4) - first_port == 7520 + 840 + (5000 - 3360)
    assert esc.get(0x0908, 4) - first_port == 12000 + (12000 - (esc.get(0x0904, 4) - first_port))


def test_soem_works_out_the_delays_of_a_tree(master: Master) -> None:
    result = master(*TREE)
    assert (result["slaves"], result["state"]) == (7, 8)
    assert result["delays"] == pytest.approx(DELAYS, abs=1)


def test_a_cut_cable_takes_its_branch_away_and_frames_come_earlier_to_those_behind(tmp_path: Path) -> None:
    segment = tree(tmp_path)
    fault = begin(segment, CableFault(after=1, port=3), MS)
    assert reached(segment) == [1, 4, 5, 6, 7]
    assert ports(segment, 1) == "012"
    assert segment.slaves[3].delay == 5000 - 3360
    fault(2 * MS)
    assert reached(segment) == [1, 2, 3, 4, 5, 6, 7]
    assert [slave.delay for slave in segment.slaves] == DELAYS
    begin(segment, PowerFault(slave=4), MS)
    assert reached(segment) == [1, 2, 3, 7]


def test_a_damaged_frame_is_counted_at_the_ports_that_it_comes_to(tmp_path: Path) -> None:
    segment = tree(tmp_path)
    begin(segment, Corrupt(after=4, port=3, way="back", burst=1), MS)
    frame = bytearray(build(Datagram(DatagramCommand.BRD, 0, 0, 0x0130, bytes(2))))
    assert not segment.process(frame, len(frame), MS)
    second, root, behind = (segment.slaves[n].esc for n in (3, 0, 5))
    assert second.memory[0x0300 + 2 * 3] == 1
    assert root.memory[0x0308 + 1] == 1
    assert behind.memory[0x0308] == segment.slaves[6].esc.memory[0x0308] == 1
    assert segment.slaves[4].esc.memory[0x0300:0x0310] == bytes(16)


MISTAKES = {
    "the order of frames": (
        (described(JUNCTION), described(DRIVE), described(DRIVE, "after: 1, port: 3")), "slaves[2].after: order",
    ),
    "a port that is not there": ((described(OUTPUTS), described(DRIVE, "port: 3")), "slaves[1].port: no_port"),
    "a port twice": (
        (described(JUNCTION), described(DRIVE), described(DRIVE, "after: 1")), "slaves[2].port: port_taken",
    ),
    "a later slave": (
        (described(JUNCTION), described(DRIVE, "after: 3"), described(DRIVE)), "slaves[1].after: no_slave_before",
    ),
    "a delay that is too short for its branch": (
        (described(JUNCTION), described(DRIVE, "port: 3, delay_ns: 800"), described(DRIVE, "after: 1, delay_ns: 1599")),
        "slaves[2].delay_ns: delay_falls",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("entries", "expected"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_in_a_tree_is_named(tmp_path: Path, entries: tuple[str, ...], expected: str) -> None:
    config = tmp_path / "segment.yaml"
    config.write_text("slaves:\n" + "".join(f"- {{{entry}}}\n" for entry in entries))
    assert_finds(lambda: check_segment(config), expected)
