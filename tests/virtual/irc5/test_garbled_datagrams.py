"""Garbled datagrams are counted and dropped, and never move a joint out of its limits."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from tests.virtual.irc5.wire import PERIOD, Pc, pc, sensor

JOINTS = st.lists(st.floats(), min_size=0, max_size=8)
NEAR = st.lists(st.floats(-100.0, 60.0), min_size=6, max_size=6)
NOT_USED = ("garbled", "foreign", "unused")


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """A valid message with some bytes changed, cut or added."""
    datagram = bytearray(sensor(draw(st.integers(0, 1 << 31)), draw(NEAR), draw(NEAR)))
    for at, value in draw(st.lists(st.tuples(st.integers(0, len(datagram) - 1), st.integers(0, 255)), max_size=4)):
        datagram[at] = value
    return bytes(datagram[: draw(st.integers(0, len(datagram)))]) + draw(st.binary(max_size=4))


SENSORS = st.builds(sensor, st.integers(0, 1 << 32), st.none() | JOINTS, st.none() | JOINTS, st.integers(0, 4))
ANYTHING = st.binary(max_size=300) | damaged() | SENSORS


def within_limits(robot: Pc, before: list[float]) -> bool:
    unit = robot.unit
    steps = zip(unit.planned, before, unit.speed_limits, unit.ranges, strict=True)
    return all(
        low <= now <= high and abs(now - then) <= limit * PERIOD * (1 + 1e-9) for now, then, limit, (low, high) in steps
    )


@given(st.lists(ANYTHING, max_size=40))
def test_every_datagram_is_counted_once_and_limits_hold(datagrams: list[bytes]) -> None:
    robot = pc()
    for datagram in datagrams:
        before = list(robot.unit.planned)
        assert robot.cycle(None, None, datagram) is not None
        assert within_limits(robot, before)
    counts = robot.unit.counts
    assert counts["used"] + sum(counts[kind] for kind in NOT_USED) == len(datagrams)


@given(st.binary(max_size=300))
def test_what_is_no_reference_moves_nothing(datagram: bytes) -> None:
    robot = pc()
    robot.cycle(None, None, datagram)
    robot.wait(0.1)
    if not robot.unit.counts["used"]:
        assert robot.unit.actual == (0.0,) * 6


@given(st.lists(ANYTHING, max_size=10))
def test_garbage_does_not_keep_a_session_alive(datagrams: list[bytes]) -> None:
    robot = pc(loop=False)
    for datagram in datagrams:
        robot.cycle(None, None, datagram)
    for _ in range(60):
        robot.cycle(None, None, b"\xff")
    assert robot.read().mci != "running"
