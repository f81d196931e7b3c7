"""Jogs of the shipped arm on the in-process bus: the first one moves, and what slows one is reported."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import pytest

from kinematics.forward import forward
from kinematics.jacobian import singularity_distances
from rtcp.config import default_config, load
from rtcp.gateway.status_snapshot import StatusSnapshot
from rtcp.ipc.commands import Jog
from rtcp.ipc.session import Processes, Session
from rtcp.ipc.states import JogFrame, State
from rtcp.testing.simulation import Simulation
from tests.samples import some

CONFIG = load(default_config())
CONFIG = replace(CONFIG, cycle=replace(CONFIG.cycle, period_us=2000.0))
assert CONFIG.arm is not None
ARM = CONFIG.arm


class Jogged(Simulation):
    """The arm, holding; `jog` sends jogs as a held stick does."""

    def __init__(self, positions: Sequence[float] | None = None) -> None:
        super().__init__(CONFIG, seed=3, positions=positions, follow_clock=False)
        self.hold()

    @property
    def q(self) -> list[float]:
        return list(self.loop.arm.state.commanded)

    def jog(self, seconds: float, at: int, speed: float, frame: JogFrame = JogFrame.BASE) -> None:
        velocity = tuple(speed if axis == at else 0.0 for axis in range(6))
        for _ in range(round(seconds / 0.1)):
            answer = self.send(Jog(velocity, frame, 0.2))
            assert answer.refusal is None, answer
            self.run(0.1)

    @property
    def limits(self) -> dict[str, str]:
        """The status's `limited_by`."""
        snapshot = StatusSnapshot(self.observer, Session(CONFIG, "virtual", "ecat0", 0, 0), {})
        return snapshot.status(Processes(), None)["limited_by"]


@pytest.fixture
def shipped() -> Iterator[Jogged]:
    """The arm as its segment's file has it."""
    with Jogged() as simulation:
        yield simulation


def test_the_virtual_arm_starts_bent_away_from_all_singularities_and_within_its_limits(shipped: Jogged) -> None:
    shoulder, *angles = singularity_distances(ARM, shipped.q)[:3]
    assert (shoulder or 0.0) > 0.3
    assert all((angle or 0.0) > 0.5 for angle in angles)
    for position, joint in zip(shipped.q, CONFIG.joints, strict=True):
        assert joint.position.min + 0.3 < position < joint.position.max - 0.3
    assert shipped.loop.arm.trajectory_guard.nearest_box(shipped.q)[0] > 0.1  # the shoulder beside the chair


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("at", range(3))
def test_the_first_jog_of_the_shipped_arm_moves_the_tool_as_far_as_it_was_asked_to(at: int, sign: float) -> None:
    with Jogged() as arm:
        before = forward(ARM, arm.q).position
        arm.jog(1.5, at, 0.1 * sign)
        moved = [after - then for after, then in zip(forward(ARM, arm.q).position, before, strict=True)]
        assert moved[at] * sign > 0.13
        assert sum(abs(distance) for axis, distance in enumerate(moved) if axis != at) < 1e-4


@pytest.mark.parametrize(
    ("start", "at", "speed", "frame", "name", "sentence"),
    [
        # the wrist centre comes over axis 1
        ((0.0, 0.3, 1.57, 0.0, 1.3, 0.0), 0, 0.1, JogFrame.BASE, "shoulder",
         r"the shoulder is 0\.03\d m from its singularity, limit 0\.03 m \(cartesian\.singularity\.shoulder in .*\)"),
        ((0.0, 0.3, 0.6, 0.0, 0.5, 0.0), 2, 0.1, JogFrame.BASE, "elbow",
         r"the elbow is 0\.08\d rad from its singularity, limit 0\.08 rad \(cartesian\.singularity\.elbow in .*\)"),
        ((0.0, -0.5, 1.8, 0.0, 0.3, 0.0), 4, -0.3, JogFrame.BASE, "wrist",
         r"the wrist is 0\.08\d rad from its singularity, limit 0\.08 rad \(cartesian\.singularity\.wrist in .*\)"),
        ((0.0,) * 6, 2, 0.1, JogFrame.BASE, "elbow", r"the elbow is 0\.000 rad from its singularity, .*"),
        ((0.0, -0.5, 2.2, 0.0, 1.2, 0.0), 0, 0.1, JogFrame.BASE, "joint3 range",
         r"joint3 is 0\.00\d\d rad from the end of its range, 2\.4 rad \(joints\[2\]\.position in .*\)"),
        ((0.0, -0.5, 1.8, 0.0, 1.8, 0.0), 4, 0.2, JogFrame.JOINTS, "joint5 range",
         r"joint5 is 0\.\d+ rad from the end of its range, 2 rad \(joints\[4\]\.position in assistive_arm\.yaml\)"),
        ((0.0, -0.5, 1.8, 0.0, 0.13, 0.0), 1, 0.25, JogFrame.BASE, "joint4 speed",
         r"joint4 moves at its speed limit, 0\.5 rad/s \(joints\[3\]\.velocity in assistive_arm\.yaml\)"),
        ((0.0, -1.0, 1.8, 0.0, 1.2, 0.0), 2, -0.25, JogFrame.BASE, "box",
         r"the arm is 0\.\d+ m from the box that the tool stays in \(cartesian\.box in assistive_arm\.yaml\)"),
    ],
)  # fmt: skip
def test_whatever_slows_or_holds_a_jog_is_said_with_its_distance_and_its_limit(
    start: Sequence[float], at: int, speed: float, frame: JogFrame, name: str, sentence: str
) -> None:
    with Jogged(start) as arm:
        for _ in range(60):
            arm.jog(0.1, at, speed, frame)
            if name in arm.limits:
                break
        arm.jog(2.0 if "speed" not in name else 0.0, at, speed, frame)
        limits = arm.limits
    assert re.match(sentence, limits.get(name, "")), limits


def test_a_jog_that_reaches_its_speed_and_one_that_ends_say_nothing(shipped: Jogged) -> None:
    for at, frame in some(product(range(6), JogFrame), 4):
        shipped.jog(0.8, at, 0.1, frame)
        assert shipped.limits == {}
        shipped.bring_to(State.HOLDING)
        assert shipped.limits == {}
        shipped.jog(0.8, at, -0.1, frame)
        shipped.bring_to(State.HOLDING)
