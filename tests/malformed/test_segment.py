"""The segment on mutated frames: no exception, no growth, and a sane master still starts it."""

from __future__ import annotations

import gc
from random import Random

import pytest

from rtcp.virtual.distributed_clock import SyncGenerator
from rtcp.virtual.protocol import DatagramCommand
from tests.malformed.corpus import frames
from tests.malformed.line import OP, SAFE_OP, Line
from tests.malformed.mutate import MUTATIONS, mutated, shape
from tests.malformed.mutated_frames import run
from tests.virtual.frames import Datagram, build, parse

SHARE = 6_000
"""Frames, of the million of `benchmarks/mutations.py`."""
MOST_OBJECTS = 20_000


def test_the_corpus_holds_all_that_a_master_does() -> None:
    kinds = {(datagram.command, datagram.offset) for frame in frames() for datagram in parse(frame)}
    assert {
        (DatagramCommand.BRD, 0x0000),
        (DatagramCommand.APWR, 0x0010),
        (DatagramCommand.FPWR, 0x0120),
        (DatagramCommand.FPWR, 0x0800),
    } <= kinds
    assert {
        (DatagramCommand.FPWR, 0x1000),
        (DatagramCommand.FPRD, 0x1080),
        (DatagramCommand.FRMW, 0x0910),
        (DatagramCommand.BWR, 0x0300),
    } <= kinds
    assert any(command in (DatagramCommand.LRW, DatagramCommand.LRD, DatagramCommand.LWR) for command, _ in kinds)
    assert len({shape(frame) for frame in frames()}) == len(frames())


@pytest.mark.parametrize("mutation", MUTATIONS, ids=lambda mutation: mutation.__name__)
def test_every_mutation_changes_frames(mutation: object) -> None:
    random = Random(1)
    changed = [mutated(frame, random, [mutation]) != frame for frame in frames()]  # type: ignore[list-item]
    assert sum(changed) > 0.2 * len(changed)


def test_a_segment_survives_mutated_frames_in_all_states_and_is_led_to_op_afterwards() -> None:
    outcome = run(SHARE, 1)
    assert outcome.failures == []
    assert outcome.frames == SHARE
    assert outcome.starts == SHARE // 500 + 1
    assert outcome.kinds["answered"] > 0.5 * SHARE
    assert outcome.kinds["not answered"] > 0.1 * SHARE
    assert outcome.objects < MOST_OBJECTS


def test_nothing_is_kept_for_every_address_that_a_master_makes_up() -> None:
    line = Line()
    line.start(SAFE_OP)

    def sweep(first: int) -> int:
        for number in range(first, first + 2000):
            half = number & 0xFFFF
            line.give(build(Datagram(DatagramCommand.LRW, 0, half, number % 7, bytes(1 + number % 50)),
                            Datagram(DatagramCommand.FPRD, 0, half, 0x0130, bytes(2)),
                            Datagram(DatagramCommand.FRMW, 0, half, 0x0910, bytes(4)),
                            Datagram(DatagramCommand.ARMW, 0, half, 0x0910, bytes(4))), 1000)  # fmt: skip
        gc.collect()
        return len(gc.get_objects())

    before = sweep(0x2000)
    assert sweep(0x4000) - before < 5000


def test_a_sync0_of_a_nanosecond_does_not_keep_the_segment_from_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line()
    line.start(OP)
    for slave in range(1, 7):
        now = int.from_bytes(line.read(slave, 0x0910, 8), "little")
        line.write(slave, 0x0981, b"\x00")
        line.write(slave, 0x0990, (now + 1_000_000).to_bytes(8, "little"))
        line.write(slave, 0x09A0, (1).to_bytes(4, "little"))
        line.write(slave, 0x0981, b"\x03")
    fired = []
    fire = SyncGenerator.fire

    def counted(generator: SyncGenerator) -> None:
        fired.append(generator)
        fire(generator)

    monkeypatch.setattr(SyncGenerator, "fire", counted)
    line.pass_time(10_000_000)
    assert line.segment.slaves[1].esc.dc is not None
    assert line.segment.slaves[1].esc.dc.sync0.pulses > 8_000_000
    assert len(fired) < 30_000
    monkeypatch.undo()
    line.start(OP)


def test_only_a_datagram_that_is_whole_moves_a_target() -> None:
    line = Line()
    line.start(OP)
    before = line.targets()
    whole = build(Datagram(DatagramCommand.LRW, 0, 0, 0, b"\x11" * 92 + bytes(96)))
    # One byte short of what the datagram says; a frame header that ends in the middle; another ethertype.
    for wrong in (whole[:-1], whole[:14] + b"\x40\x10" + whole[16:], whole[:12] + b"\x88\xa5" + whole[14:]):
        line.give(wrong)
        assert line.targets() == before
    line.give(whole)
    assert line.targets() == [b"\x11" * 2, *[b"\x11" * 15] * 6]
