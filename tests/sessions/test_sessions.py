"""Random sessions, some of them fixed and some that hypothesis makes up: no frame breaks a limit whatever is done."""

from __future__ import annotations

import os
from random import Random

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rtcp.ipc.commands import Command, Disable, Halt, MoveJoints, Reset, SetControlMode, SetDriveMode, Shutdown
from rtcp.ipc.states import ControlMode, DriveMode, State
from tests.sessions.deeds import Deeds
from tests.sessions.driver import (
    FAULTS,
    KINDS,
    NONSENSE,
    PERIODS_US,
    STICK,
    Driver,
    bounds_of,
    configuration,
    is_free,
    random_command,
    with_start,
)
from tests.sessions.play import MOTIONS, Outcome, play

SLOW = "RTCP_SLOW" in os.environ
"""Whether every session is played (`RTCP_SLOW=1`); else a few."""
SESSIONS, BATCH = (100, 20) if SLOW else (4, 2)
EXAMPLES = 60 if SLOW else 3


@pytest.mark.timeout(900)
@pytest.mark.parametrize("first", range(1, SESSIONS + 1, BATCH))
def test_no_frame_of_a_random_session_breaks_a_limit(first: int) -> None:
    failures = [failure for seed in range(first, first + BATCH) for failure in play(seed).failures]
    assert failures == []


@pytest.mark.skipif(not SLOW, reason="30 sessions: with RTCP_SLOW=1")
@pytest.mark.timeout(900)
def test_the_sessions_visit_every_state_and_give_every_command() -> None:
    total = Outcome()
    for seed in range(1000, 1030):
        total.add(play(seed))
    assert total.failures == []
    assert set(State.__members__) - set(total.states) <= {"OFF", "HOMING"}
    given = set(total.taken) | set(total.refused)
    assert {command.name for command in KINDS} - given <= {"set_zero", "home"}


def test_a_session_is_the_same_each_time_it_is_played() -> None:
    assert play(77) == play(77)


FREE = [
    (-0.8, 0.3, 0.9, 0.2, 0.4, 0.1),
    (2.4, -0.5, 1.2, -0.6, -0.9, 1.5),
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    (1.5, 0.6, 0.5, 2.0, 1.0, -2.0),
]
"""Places to begin at that are outside every keep-out box."""
DEEDS = (
    "trajectory",
    "invade",
    "line",
    "stream",
    "jog",
    "velocity",
    "torque",
    "stick",
    "toggle",
    "emergency",
    "limits",
)
AXES = st.integers(0, 5)
ANGLES = st.floats(-3.2, 3.2) | st.sampled_from(NONSENSE)
TARGETS = st.lists(ANGLES, min_size=6, max_size=6)
SPEEDS = st.floats(0.01, 0.5) | st.sampled_from(NONSENSE)


class AnySession(RuleBasedStateMachine):
    """Whatever a commander and a bad day can do, in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.driver: Driver | None = None

    @initialize(
        place=st.sampled_from(FREE), period=st.sampled_from(PERIODS_US), mode=st.sampled_from(("csp", "csv", "cst")),
        motion=st.sampled_from(MOTIONS),
    )  # fmt: skip
    def begin(self, place: tuple[float, ...], period: int, mode: str, motion: str) -> None:
        self.period_s = period * 1e-6
        self.driver = Driver(with_start(configuration(), period, mode, motion), 1, place)

    @property
    def it(self) -> Driver:
        assert self.driver is not None
        return self.driver

    @rule()
    def enable(self) -> None:
        self.it.enable()

    @rule(goal=TARGETS, speed=SPEEDS, synchronized=st.booleans())
    def move(self, goal: list[float], speed: float, synchronized: bool) -> None:
        self.it.send(MoveJoints(tuple(goal), speed, synchronized))

    @rule(by=st.lists(st.floats(-0.3, 0.3), min_size=6, max_size=6))
    def move_a_little(self, by: list[float]) -> None:
        target = tuple(q + d for q, d in zip(self.it.commanded, by, strict=True))
        self.it.send(MoveJoints(target, 0.5, True))

    @rule(name=st.sampled_from(DEEDS), seed=st.integers(0, 10_000))
    def do(self, name: str, seed: int) -> None:
        """Something longer: a plan, a stream, a hand on the stick."""
        getattr(Deeds(self.it, Random(seed), self.period_s), name)()

    @rule(mode=st.sampled_from(ControlMode))
    def change_the_control_mode(self, mode: ControlMode) -> None:
        self.it.send(SetControlMode(mode))

    @rule(command=st.sampled_from([Halt(), Disable(), Reset()]))
    def stop(self, command: Command) -> None:
        self.it.send(command)

    @rule(mode=st.sampled_from(DriveMode))
    def change_the_drive_mode(self, mode: DriveMode) -> None:
        self.it.send(SetDriveMode(mode))

    @rule(seed=st.integers(0, 10_000))
    def send_any_command(self, seed: int) -> None:
        command = random_command(Random(seed))
        if not isinstance(command, Shutdown):
            self.it.send(command)

    @rule(kind=st.integers(0, 40) | st.sampled_from([kind.number for kind in KINDS]), numbers=st.lists(ANGLES))
    def send_any_bytes(self, kind: int, numbers: list[float]) -> None:
        if kind != Shutdown.number:
            self.it.send_raw(kind, numbers)

    @rule(axis=AXES, code=st.sampled_from(FAULTS))
    def break_a_drive(self, axis: int, code: int) -> None:
        self.it.fault(axis, code)

    @rule(cycles=st.integers(1, 60), heard=st.booleans())
    def lose_frames(self, cycles: int, heard: bool) -> None:
        self.it.lose(cycles, heard)

    @rule(position=st.integers(1, 7))
    def drop_a_slave(self, position: int) -> None:
        self.it.drop(position)

    @rule(cycles=st.integers(1, 700))
    def leave_it_alone(self, cycles: int) -> None:
        self.it.fall_silent()
        self.it.wait(cycles)
        self.it.acquire()

    @rule(axis=AXES, torque=st.floats(-15.0, 15.0), cycles=st.integers(1, 200))
    def push(self, axis: int, torque: float, cycles: int) -> None:
        self.it.push(axis, torque)
        self.it.wait(cycles)
        self.it.push(axis, 0.0)

    @rule(byte=st.sampled_from(STICK) | st.integers(0, 255))
    def hold_the_stick(self, byte: int) -> None:
        self.it.stick(byte)

    @rule(pressed=st.booleans())
    def press_the_emergency_stop(self, pressed: bool) -> None:
        self.it.press(pressed)

    @rule(cycles=st.integers(1, 400))
    def wait(self, cycles: int) -> None:
        self.it.wait(cycles)

    @invariant()
    def no_frame_breaks_a_limit(self) -> None:
        if self.driver is not None:
            self.driver.wait(3)
            assert self.driver.violations == [], "\n".join(self.driver.log[-20:])

    def teardown(self) -> None:
        if self.driver is not None:
            self.driver.close()


TestAnySession = AnySession.TestCase
TestAnySession.settings = settings(
    max_examples=EXAMPLES, stateful_step_count=30, suppress_health_check=[HealthCheck.too_slow], deadline=None
)


def test_the_places_to_begin_at_are_free() -> None:
    bounds = bounds_of(configuration())
    assert [place for place in FREE if not is_free(bounds, place)] == []
