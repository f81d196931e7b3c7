"""What is read from a capture: whole exchanges, answers that came too late, limits that change meanwhile."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.states import State
from rtcp.motion.limits import Values
from rtcp.testing.simulation import Frame
from tests.e2e.wire import DRIVE, HEAD, LEAVES, LRW, frame
from tests.sessions.oracle import commander_of, configuration, with_start
from tests.sessions.wire_capture import BARRIER_INDEX, EXPECTED_WKC, NOP, Change, exchanges, wider
from tests.sessions.wire_session import check

PERIOD_US = 2000
PERIOD_S = PERIOD_US * 1e-6
START = [0.5, 0.3, 0.9, 0.2, 0.4, 0.1]
MIDDLE = 0.55
"""Of the capture: the arm is moving there."""


class Capture:
    """A file of frames as `tests/e2e/wire.py` writes one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._data = b""
        self._index = 0

    def _add(self, now_ns: int, leaves: bool, got: bytes) -> None:
        self._data += HEAD.pack(now_ns, len(got) | (LEAVES if leaves else 0)) + got
        self.path.write_bytes(self._data)

    def sends(self, seen: Frame) -> bytes:
        """The master's frame, on its way out; returns it."""
        self._index = (self._index + 1) % 16
        got = frame(LRW, self._index, 0, 0, b"".join((*seen.sent, *seen.received)))
        self._add(seen.now_ns, False, got)
        return got

    def answers(self, seen: Frame, sent: bytes) -> None:
        """What the segment makes of it."""
        image = b"".join((*seen.sent, *seen.received))
        counter = struct.pack("<H", EXPECTED_WKC)
        self._add(seen.now_ns + 1000, True, sent[:26] + image + counter + sent[28 + len(image) :])

    def barrier(self, now_ns: int) -> None:
        """The numbered frame after an answer that did not come in time."""
        self._add(now_ns, False, frame(NOP, BARRIER_INDEX, 0, 0, bytes(8)))


@pytest.fixture(scope="module")
def moving() -> list[Frame]:
    """Every frame of an arm that is enabled and moves."""
    commander = commander_of(with_start(configuration(), PERIOD_US, "csp"), 1, START)
    found: list[Frame] = []
    checked = commander.simulation.on_frame
    assert checked is not None

    def see(seen: Frame) -> None:
        found.append(seen)
        checked(seen)

    commander.simulation.on_frame = see
    commander.enable()
    commander.simulation.bring_to(State.HOLDING, 2.0)
    commander.wait(50)
    commander.send(MoveJoints(tuple(q + 0.3 for q in START), 0.4, True))
    commander.wait(200)
    commander.close()
    assert commander.checker.violations == []
    return found[-300:]


def written(path: Path, seen: Iterable[Frame]) -> Path:
    capture = Capture(path)
    for one in seen:
        capture.answers(one, capture.sends(one))
    return path


def spoilt(seen: Frame, joint: int, change: Callable[[int], int]) -> Frame:
    sent = [*seen.sent]
    control, position, velocity, torque, mode = DRIVE.unpack(sent[joint])
    sent[joint] = DRIVE.pack(control, change(position), velocity, torque, mode)
    return seen._replace(sent=tuple(sent))


def test_a_capture_is_read_as_the_exchanges_that_were_written(moving: list[Frame], tmp_path: Path) -> None:
    read = [*exchanges(written(tmp_path / "capture", moving))]
    assert [(one.sent, one.received, one.wkc) for one in read] == [(one.sent, one.received, 21) for one in moving]


def test_a_sound_capture_has_no_violation(moving: list[Frame], tmp_path: Path) -> None:
    found, failures = check(written(tmp_path / "capture", moving), PERIOD_S)
    assert failures == []
    assert found.obeyed > 250
    assert found.largest_step > 0.5


def test_one_target_that_is_changed_in_the_file_is_found_with_the_actions_before_it(
    moving: list[Frame], tmp_path: Path
) -> None:
    at = round(MIDDLE * len(moving))
    changed = [*moving[:at], spoilt(moving[at], 3, lambda counts: counts + 12), *moving[at + 1 :]]
    actions = [(moving[at].now_ns - 1, "the action before"), (moving[at].now_ns + 1, "the action after")]
    _, failures = check(written(tmp_path / "capture", changed), PERIOD_S, actions=actions)
    assert "joint 3: step 0.0016," in failures[0][0]
    assert "the action before" in failures[0][1]


@pytest.mark.parametrize("barred", [True, False])
def test_a_target_is_repeated_only_after_an_answer_that_came_too_late(
    moving: list[Frame], tmp_path: Path, barred: bool
) -> None:
    capture = Capture(tmp_path / "capture")
    at = round(MIDDLE * len(moving))
    for number, one in enumerate(moving):
        capture.answers(one, capture.sends(one))
        if number == at:
            if barred:
                capture.barrier(one.now_ns + 2000)
            capture.answers(one, capture.sends(one))
    _, failures = check(capture.path, PERIOD_S)
    assert bool(failures) is not barred


def test_a_frame_that_is_never_answered_is_an_exchange_without_an_answer(moving: list[Frame], tmp_path: Path) -> None:
    capture = Capture(tmp_path / "capture")
    for number, one in enumerate(moving[:50]):
        sent = capture.sends(one)
        if number not in (20, 21):
            capture.answers(one, sent)
    assert [number for number, one in enumerate(exchanges(capture.path)) if one.wkc < 0] == [20, 21]


@pytest.mark.parametrize(("asked", "done", "found"), [(0.0, 0.1, True), (0.1, 1.0, False), (0.9, 1.0, False)])
def test_limits_count_from_when_they_are_surely_in_force(
    moving: list[Frame], tmp_path: Path, asked: float, done: float, found: bool
) -> None:
    first, last = moving[0].now_ns, moving[-1].now_ns
    widest = Values.configured(configuration())
    slow = replace(widest, velocity=tuple(0.2 * v for v in widest.velocity))
    change = Change(round(first + asked * (last - first)), round(first + done * (last - first)), slow)
    _, failures = check(written(tmp_path / "capture", moving), PERIOD_S, [change])
    assert bool(failures) is found


def test_the_wider_of_two_limits_allows_what_either_does() -> None:
    a = Values.configured(configuration())
    b = replace(
        a,
        low=tuple(q / 2 for q in a.low),
        velocity=tuple(v / 2 for v in a.velocity),
        box=(-0.5, -0.5, -0.2, 0.5, 0.5, 1.0),
        keep_out=tuple((x - 0.1, y, z, u, v, w + 0.1) for x, y, z, u, v, w in a.keep_out),
    )
    assert wider(a, b) == wider(b, a) == a
