"""True time and distance to standstill of every joint by each stop reaction, within the configured bounds.

The shipped arm on the in-process bus; `pytest -s` prints what was measured.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.ipc.commands import Jog, MoveJoints, SetDriveMode
from rtcp.ipc.states import DriveMode, JogFrame, State
from rtcp.ipc.stop_reactions import Bound, StopReaction, bounds, tool_bounds, watchdog_bounds
from rtcp.testing.simulation import NAME, Frame, Simulation

CONFIG = load(default_config())
CONFIG = replace(CONFIG, bus=replace(CONFIG.bus, interface=NAME))
"""The shipped arm on a bus where no limit is widened."""
PERIOD_S = CONFIG.cycle.period_us * 1e-6
COUNTS = 10000
UPRIGHT_LESS = [-0.3] * 6
"""Start of the moves, rad: all joints reach full speed near the upright pose, away from all boxes."""
BENT = [0.0, -0.3, 1.2, 0.0, 0.9, 0.0]
JOG_SPEED = 0.2
"""m/s"""
STANDS_RAD_S = 0.01
"""A joint below this speed counts as standing."""
SAFE_OP, AL_WATCHDOG = 4, 0x001B
OUTPUTS = struct.Struct("<Hiiib")
ENABLE_OPERATION, QUICK_STOP = 0x0F, 0x02
SITUATIONS = ("holding", "moving", "jogging")


class Measured:
    """A stop, from the cycle of its cause on: the true motion of every joint, and the outputs sent."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self._slots = [
            next(slot for slot, slave in enumerate(simulation.config.slaves) if slave.name == joint.slave)
            for joint in simulation.config.joints
        ]
        self.begun_ns = simulation.now_ns
        self._began = [model.mechanics.position for model in simulation.models]
        self.time_s = 0.0
        self.distances = [0.0] * len(self._began)
        self.sent: list[list[tuple[int, ...]]] = []
        self.before = self._outputs(simulation.data.outputs)
        simulation.on_frame = self._see

    def _outputs(self, sent: Sequence[bytes]) -> list[tuple[int, ...]]:
        return [OUTPUTS.unpack(sent[slot]) for slot in self._slots]

    def _see(self, frame: Frame) -> None:
        models = self.simulation.models
        if any(abs(model.mechanics.velocity) > STANDS_RAD_S for model in models):
            self.time_s = (frame.now_ns - self.begun_ns) * 1e-9
        now = [abs(model.mechanics.position - began) for model, began in zip(models, self._began, strict=True)]
        self.distances = [max(pair) for pair in zip(self.distances, now, strict=True)]
        self.sent.append(self._outputs(frame.sent))

    @property
    def longest_step(self) -> list[int]:
        """For each joint the largest difference, in counts, of two consecutive targets that its drive obeys."""
        rows = [self.before, *self.sent]
        return [
            max(
                (
                    abs(after[axis][1] - earlier[axis][1])
                    for earlier, after in pairwise(rows)
                    if {earlier[axis][0], after[axis][0]} <= {ENABLE_OPERATION, QUICK_STOP}
                ),
                default=0,
            )
            for axis in range(len(self._began))
        ]

    def within(self, what: str, limits: Sequence[Bound]) -> None:
        """Assert the bounds of all joints, and print time and distance."""
        longest_s = max(bound.time_s for bound in limits)
        print(f"\n{what}: stands after {1000 * self.time_s:.1f} ms (at most {1000 * longest_s:.1f})", end="")
        assert self.time_s <= longest_s
        self.not_beyond(what, limits)

    def not_beyond(self, what: str, limits: Sequence[Bound]) -> None:
        """Assert the bounds of distances and of steps of targets; the joints may still move."""
        most = max(bound.way_rad for bound in limits)
        print(f"\n{what}: longest distance {max(self.distances):.4f} rad (at most {most:.4f})", end="")
        assert [distance <= bound.way_rad for distance, bound in zip(self.distances, limits, strict=True)] == [
            True
        ] * len(limits)
        steps = [joint.velocity * PERIOD_S * COUNTS + 1 for joint in CONFIG.joints]
        assert [step <= most for step, most in zip(self.longest_step, steps, strict=True)] == [True] * len(steps)


@pytest.fixture
def arm() -> Iterator[Callable[..., Simulation]]:
    """Bring an arm with these stop reactions into a situation."""
    made: list[Simulation] = []

    def bring(situation: str, mode: int = 8, **stops: str) -> Simulation:
        config: ArmConfig = replace(CONFIG, stops=replace(CONFIG.stops, **stops))  # type: ignore[arg-type]
        positions = BENT if situation == "jogging" else UPRIGHT_LESS
        simulation = Simulation(config, seed=5, positions=positions, follow_clock=False)
        made.append(simulation)
        simulation.hold()
        simulation.do(SetDriveMode(DriveMode(mode)))
        assert simulation.until(lambda: not simulation.loop.machine.changing_mode, 1.0)
        simulation.run(0.1)
        if situation == "moving":
            simulation.do(MoveJoints((0.3,) * 6, 0.5, synchronized=False))
            simulation.run(0.55)
            assert min(simulation.loop.arm.state.commanded_velocity) == pytest.approx(0.5, abs=1e-6)
        elif situation == "jogging":
            for _ in range(2):
                simulation.do(Jog((0.0, 0.0, -JOG_SPEED, 0.0, 0.0, 0.0), JogFrame.BASE, 0.5))
                simulation.run(0.4)
            assert max(map(abs, simulation.loop.arm.state.commanded_velocity)) > 0.15
        return simulation

    yield bring
    for simulation in made:
        simulation.close()


def lose_the_box(simulation: Simulation) -> None:
    simulation.bus.drop(1, SAFE_OP, AL_WATCHDOG)
    # The service thread detects it later; the bound counts from the cycle that learns of it.
    simulation.service.lost_slave = 1


def brakes(simulation: Simulation) -> list[float]:
    """Least deceleration of each joint by its closed brake, against its load, rad/s2."""
    joints = [model.mechanics for model in simulation.models]
    return [(joint.holding_torque + joint.coulomb - abs(joint.external_torque)) / joint.inertia for joint in joints]


# -- hold -----------------------------------------------------------------------------------------------------------


HELD = [
    *((situation, 8, heard) for situation in SITUATIONS for heard in (True, False)),
    *((situation, mode, True) for situation in ("holding", "moving") for mode in (9, 10)),
]


@pytest.mark.parametrize(("situation", "mode", "heard"), HELD)
def test_held_cycles_send_no_new_target_and_carry_no_joint_farther_than_its_speed_times_their_time(
    arm: Callable[..., Simulation], situation: str, mode: int, heard: bool
) -> None:
    simulation = arm(situation, mode)
    measured = Measured(simulation)
    cycles = CONFIG.bus.lost_cycles - 1
    simulation.data.lose(cycles, heard)
    simulation.run(cycles * PERIOD_S)
    assert all(row == measured.before for row in measured.sent)
    assert simulation.state is (State.HOLDING if situation == "holding" else State.MOVING)
    limits = bounds(CONFIG, StopReaction.HOLD)
    if mode == 10:
        # A held torque goes on accelerating: a tenth more is allowed.
        limits = tuple(bound._replace(way_rad=1.1 * bound.way_rad) for bound in limits)
    measured.not_beyond(f"hold in mode {mode}, {situation}", limits)


@pytest.mark.parametrize("situation", SITUATIONS)
@pytest.mark.parametrize("heard", [True, False], ids=["the answer is lost", "nothing is heard"])
def test_frames_that_stay_away_end_in_a_quick_stop_or_by_the_drives_watchdog(
    arm: Callable[..., Simulation], situation: str, heard: bool
) -> None:
    simulation = arm(situation)
    measured = Measured(simulation)
    simulation.data.lose(100_000, heard)
    simulation.run(0.6)
    assert simulation.state is State.FAULT
    limits: Sequence[Bound] = watchdog_bounds(CONFIG)
    if heard:
        hold, stop = bounds(CONFIG, StopReaction.HOLD), bounds(CONFIG, StopReaction.QUICK_STOP)
        limits = [Bound(a.time_s + b.time_s, a.way_rad + b.way_rad) for a, b in zip(hold, stop, strict=True)]
    else:
        assert not any(model.powered for model in simulation.models)
    measured.within(f"frames lost, {situation}", limits)


# -- controlled stop, quick stop, torque off ------------------------------------------------------------------------


@pytest.mark.parametrize("situation", ["moving", "jogging"])
@pytest.mark.parametrize(
    "reaction",
    [StopReaction.CONTROLLED_STOP, StopReaction.QUICK_STOP, StopReaction.TORQUE_OFF],
    ids=lambda reaction: reaction.words,
)
def test_a_motion_whose_commander_is_lost_stands_within_the_bound_of_the_reaction(
    arm: Callable[..., Simulation], situation: str, reaction: StopReaction
) -> None:
    simulation = arm(situation, lease_ended=reaction.name.lower())
    measured = Measured(simulation)
    simulation.observer.release(simulation.lease)
    simulation.run(0.6)
    assert simulation.state is (State.HOLDING if reaction is StopReaction.CONTROLLED_STOP else State.FAULT)
    assert [model.powered for model in simulation.models] == [reaction is not StopReaction.TORQUE_OFF] * 6
    limits = bounds(CONFIG, reaction, brakes(simulation))
    if situation == "jogging" and reaction is StopReaction.CONTROLLED_STOP:
        # The tool's ramp may be longer; no joint exceeds its speed meanwhile.
        slow = tool_bounds(CONFIG, JOG_SPEED, CONFIG.jog.angular_speed)[0].time_s
        limits = tuple(
            Bound(max(bound.time_s, slow), max(bound.way_rad, joint.velocity * slow))
            for bound, joint in zip(limits, CONFIG.joints, strict=True)
        )
    measured.within(f"{reaction.words}, {situation}", limits)


@pytest.mark.parametrize(
    "reaction", [StopReaction.QUICK_STOP, StopReaction.TORQUE_OFF], ids=lambda reaction: reaction.words
)
def test_an_arm_that_holds_stays_where_it_is_by_every_reaction(
    arm: Callable[..., Simulation], reaction: StopReaction
) -> None:
    simulation = arm("holding", slave_lost=reaction.name.lower())
    measured = Measured(simulation)
    lose_the_box(simulation)
    simulation.run(0.2)
    assert simulation.state is State.FAULT
    assert [model.powered for model in simulation.models] == [reaction is StopReaction.QUICK_STOP] * 6
    measured.within(f"{reaction.words}, holding", bounds(CONFIG, reaction, brakes(simulation)))
    assert max(measured.distances) < 0.001


# -- the bounds themselves ------------------------------------------------------------------------------------------


def test_each_reaction_is_bound_by_what_the_configuration_says() -> None:
    slow = replace(CONFIG, joints=tuple(replace(joint, acceleration=1.0) for joint in CONFIG.joints))
    few = replace(CONFIG, bus=replace(CONFIG.bus, lost_cycles=10))
    assert bounds(slow, StopReaction.CONTROLLED_STOP)[0].time_s > bounds(CONFIG, StopReaction.CONTROLLED_STOP)[0].time_s
    assert bounds(few, StopReaction.HOLD)[0].time_s == pytest.approx(0.25 * bounds(CONFIG, StopReaction.HOLD)[0].time_s)
    late = 3 * PERIOD_S + 0.03
    assert bounds(CONFIG, StopReaction.QUICK_STOP)[0].time_s == pytest.approx(0.5 / 10.0 + late)
    assert bounds(CONFIG, StopReaction.QUICK_STOP)[0].way_rad == pytest.approx(0.5**2 / 20.0 + 0.5 * late)
    assert bounds(CONFIG, StopReaction.TORQUE_OFF, [50.0] * 6)[0].time_s == pytest.approx(0.01 + late)


def test_a_bound_that_rests_on_what_is_not_known_is_refused() -> None:
    with pytest.raises(ValueError, match="joint1: what its brake can do is not known"):
        bounds(CONFIG, StopReaction.TORQUE_OFF)
    bare = replace(CONFIG.slaves[1].device, sdo=())
    without = replace(CONFIG, slaves=tuple(replace(slave, device=bare) for slave in CONFIG.slaves))
    with pytest.raises(ValueError, match="0x6085 is not among its start-up SDOs"):
        bounds(without, StopReaction.QUICK_STOP)
