"""Two arms of twelve joints on in-process buses: random motions in step, and what happens to one of them at random."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from random import Random

import numpy as np

from kinematics.capsules import distance
from rtcp.config import default_config, load
from rtcp.config.cell import Base, CellConfig, Member
from rtcp.config.model import ArmConfig
from rtcp.ipc.commands import Disable, Enable, Halt, MoveJoints, Reset, RunInStep
from rtcp.ipc.events import MotionEnded
from rtcp.ipc.states import State
from rtcp.motion.guards.neighbours import body_of
from rtcp.motion.limits import Limits
from rtcp.motion.planning.in_step import Curve, Way, plan_brakes, plan_moves
from rtcp.motion.planning.plan import COLUMNS, PlanTooFast
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.testing.cell import CellSimulation
from rtcp.testing.sessions.checker import Bounds, FrameChecker
from rtcp.testing.simulation import Simulation
from tests.sessions.oracle import checker_of, is_free

NAMES = ("left", "right")
EMERGENCY_STOP_BIT = 0x0200
LEAD_NS = 60_000_000
STANDS_RAD_S = 1e-9
QUIET_INPUTS = 0x033F
LEAVING = (State.MOVING, State.STOPPING, State.DISABLING)
ON_PATH = ("halt", "halt at both", "disable", "lease ends")
"""Mishaps after which both arms brake along their paths."""


def cell_of(periods_us: tuple[float, float] = (1000.0, 2000.0), apart_m: float = 2.0, **settings: object) -> CellConfig:
    """Return a cell of two EtherCAT arms with cycles of their own, side by side."""
    config = load(default_config())
    # Boxes matter to the planner of each arm, which is not used here.
    config = replace(config, cartesian=replace(config.cartesian, keep_out=(), box=None))
    arms = [replace(config, cycle=replace(config.cycle, period_us=period_us)) for period_us in periods_us]
    members = tuple(
        Member(name, arm, Base((0.0, y, 0.0)))
        for name, arm, y in zip(NAMES, arms, (0.5 * apart_m, -0.5 * apart_m), strict=True)
    )
    return CellConfig("pair", arms=members, **settings)  # type: ignore[arg-type]


@dataclass
class Motion:
    """A motion in step and its measured times."""

    plan: dict[str, Curve]
    goal: dict[str, list[float]]
    start_ns: int
    begun_ns: dict[str, int] = field(default_factory=dict)
    ended_ns: dict[str, int] = field(default_factory=dict)
    apart_s: float = 0.0
    """Largest difference of the paths' times while both moved."""

    @property
    def duration_s(self) -> float:
        """Duration of the motion, s."""
        return max(motion.duration_s for motion in self.plan.values())


class Pair:
    """The cell, its checkers of frames, and random motions.

    Args:
        seed: of everything.
        cell: of two arms.
    """

    def __init__(self, seed: int, cell: CellConfig | None = None) -> None:
        self.random = Random(seed)
        self.cell = cell_of() if cell is None else cell
        self.simulation = CellSimulation(self.cell, seed)
        self.configs: dict[str, ArmConfig] = {arm.name: arm.config for arm in self.cell.arms}
        self.limits = {name: Limits(config) for name, config in self.configs.items()}
        self.checkers = {name: self._watch(name) for name in NAMES}
        self.slowest_ns = round(1e9 * self.cell.slowest_s)
        self.happened: Counter[str] = Counter()
        for arm in self.simulation.arms.values():
            assert arm.box is not None
            arm.box.inputs = QUIET_INPUTS
        self.simulation.enable()

    def _watch(self, name: str) -> FrameChecker:
        arm, config = self.simulation.arms[name], self.configs[name]
        checker = checker_of(config, arm.period_ns * 1e-9, arm.data.expected_wkc)
        arm.on_frame = checker.check
        return checker

    def close(self) -> None:
        """Release the shared memory."""
        self.simulation.__exit__(None, None, None)

    @property
    def violations(self) -> list[str]:
        """Violations that the checkers of the frames found."""
        return [f"{name}: {violation}" for name, checker in self.checkers.items() for violation in checker.violations]

    def arm(self, name: str) -> Simulation:
        """Return an arm."""
        return self.simulation.arms[name]

    def commanded(self, name: str) -> list[float]:
        """Return the commanded position of an arm, rad."""
        return list(self.arm(name).loop.arm.state.commanded)

    def speed(self, name: str) -> float:
        """Return the largest commanded speed of a joint, rad/s."""
        return max(map(abs, self.arm(name).loop.arm.state.commanded_velocity))

    def path_s(self, name: str) -> float:
        """Return the time of an arm on its path, s."""
        return self.simulation.partners[name].group.path_s

    # -- motions ------------------------------------------------------------------------------------------------------

    def _target(self, name: str) -> list[float]:
        bounds, here = Bounds.configured(self.configs[name]), self.commanded(name)
        reach = self.random.choice((0.05, 0.4, 1.2))
        for _ in range(100):
            q = [
                min(max(angle + self.random.uniform(-reach, reach), low), high)
                for angle, low, high in zip(here, bounds.low, bounds.high, strict=True)
            ]
            middle = [0.5 * (a + b) for a, b in zip(q, here, strict=True)]
            if is_free(bounds, q, 0.05) and is_free(bounds, middle, 0.05):
                return q
        return here

    def begin(self, lead_ns: int = LEAD_NS, only: tuple[str, ...] = NAMES) -> Motion:
        """Plan a random motion of both arms, and command it to `only`."""
        while True:
            goal = {name: self._target(name) for name in NAMES}
            speed = self.random.choice((None, self.random.uniform(0.1, 1.0)))
            begin = {name: self.commanded(name) for name in NAMES}
            points = plan_moves({n: Way(self.limits[n], begin[n], goal[n]) for n in NAMES}, speed)
            plans = {n: plan_trajectory(points[n], self.limits[n], begin[n]) for n in NAMES}
            curves = {n: Curve(plans[n].rows, len(goal[n])) for n in NAMES}
            try:
                brakes = plan_brakes(curves, self.limits)
            except PlanTooFast:
                self.happened["no room to brake"] += 1
                continue
            break
        start = self.simulation.now_ns + lead_ns
        table = tuple(tuple(brakes.times[at : at + COLUMNS]) for at in range(0, len(brakes.times), COLUMNS))
        for name in only:
            rows = plans[name].rows
            slot = self.arm(name).observer.write_plan(rows + table)
            command = RunInStep(slot, len(rows), start, 1, start, len(brakes.times), brakes.step_s)
            refusal = self.simulation.send(name, command).refusal
            assert refusal is None, (name, refusal)
        return Motion(curves, goal, start)

    def follow(self, motion: Motion, until: Callable[[], bool], seconds: float = 60.0) -> bool:
        """Run until a condition; record begin, end and the difference of the paths' times."""

        def tracked() -> bool:
            for name in NAMES:
                arm = self.arm(name)
                if name not in motion.begun_ns and self.speed(name) > STANDS_RAD_S:
                    motion.begun_ns[name] = arm.now_ns
                if name in motion.begun_ns and name not in motion.ended_ns and arm.state is not State.MOVING:
                    motion.ended_ns[name] = arm.now_ns
            if all(self.arm(name).state is State.MOVING for name in NAMES) and len(motion.begun_ns) == len(NAMES):
                times = {name: self.path_s(name) - 1e-9 * self.arm(name).now_ns for name in NAMES}
                motion.apart_s = max(motion.apart_s, abs(times["left"] - times["right"]))
            return until()

        return self.simulation.until(tracked, seconds)

    def rests_after(self, motion: Motion) -> bool:
        """Whether both arms hold, and the motion has begun and ended."""
        begun = self.simulation.now_ns > motion.start_ns + 2 * self.slowest_ns
        return begun and self.simulation.all_in(State.HOLDING)

    def events(self, name: str) -> list[str]:
        """Return the names of an arm's events, oldest first."""
        return [type(record.event).__name__ for record in self.arm(name).events]

    def last_end(self, name: str) -> str:
        """Return the name of the last event that ended a motion early."""
        ends = [
            type(record.event).__name__ for record in self.arm(name).events if isinstance(record.event, MotionEnded)
        ]
        return ends[-1] if ends else ""

    # -- what happens to one arm --------------------------------------------------------------------------------------

    @property
    def mishaps(self) -> Mapping[str, Callable[[str], object]]:
        """Mishaps of an arm by name; `recover` undoes them."""
        return {
            "halt": lambda name: self.simulation.send(name, Halt()),
            "halt at both": self._halt_both,
            "disable": lambda name: self.simulation.send(name, Disable()),
            "lease ends": lambda name: self.arm(name).fall_silent(),
            "drive fault": lambda name: self.arm(name).models[self.random.randrange(6)].inject_fault(0x3210),
            "emergency stop": lambda name: self._press(name, True),
            "frames lost": lambda name: self.arm(name).data.lose(400),
            "loop hangs": self.simulation.silent.add,
        }

    def _halt_both(self, name: str) -> None:
        """Halt both arms, with some milliseconds in between."""
        self.simulation.send(name, Halt())
        self.simulation.run(self.random.uniform(0.0, 0.003))
        for other in NAMES:
            if other != name and self.arm(other).state is State.MOVING:
                self.simulation.send(other, Halt())

    def _press(self, name: str, pressed: bool) -> None:
        box = self.arm(name).box
        assert box is not None
        box.inputs = box.inputs & ~EMERGENCY_STOP_BIT if pressed else box.inputs | EMERGENCY_STOP_BIT

    def recover(self) -> bool:
        """Undo the mishaps, reset and enable; return whether both arms hold."""
        self.simulation.silent.clear()
        for name in NAMES:
            self._press(name, False)
        self.simulation.run(0.8)
        for name in NAMES:
            self.arm(name).acquire()
        for name in NAMES:
            if self.arm(name).state in (State.FAULT, State.EMERGENCY_STOP, State.STOPPED_BY_LIMIT):
                assert self.simulation.send(name, Reset()).refusal is None
                self.simulation.run(0.01)
        if not self.simulation.until(lambda: self.simulation.all_in(State.READY, State.HOLDING), 5.0):
            return False
        for name in NAMES:
            if self.arm(name).state is State.READY:
                self.simulation.send(name, Enable())
        return self.simulation.until(lambda: self.simulation.all_in(State.HOLDING), 5.0)


@dataclass
class Outcome:
    """Results of random motions; times in ns, angles in rad."""

    motions: int = 0
    begin_apart_ns: int = 0
    end_apart_ns: int = 0
    apart_s: float = 0.0
    off_goal: float = 0.0
    off_path: float = 0.0
    """Largest distance from its path of an arm at rest after a stop, rad."""
    rest_apart_s: float = 0.0
    """Difference of the paths' times at rest, where both braked on their paths."""
    reaction_ns: dict[str, int] = field(default_factory=dict)
    """Longest time from the mishap of one arm until the other brakes."""
    problems: list[str] = field(default_factory=list)

    def add(self, other: Outcome) -> None:
        """Add another outcome."""
        self.motions += other.motions
        self.problems += other.problems
        for name in ("begin_apart_ns", "end_apart_ns", "apart_s", "off_goal", "off_path", "rest_apart_s"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        for kind, longest in other.reaction_ns.items():
            self.reaction_ns[kind] = max(self.reaction_ns.get(kind, 0), longest)


def run_motions(seed: int, count: int) -> Outcome:
    """Run random motions to their ends."""
    pair, outcome = Pair(seed), Outcome()
    for number in range(count):
        motion = pair.begin()
        if not pair.follow(motion, lambda: pair.rests_after(motion)):  # noqa: B023
            outcome.problems.append(f"motion {number} does not end")
            break
        outcome.motions += 1
        for name in NAMES:
            if ended := pair.last_end(name):
                outcome.problems.append(f"motion {number}: {name}: {ended}")
            off = max(abs(a - b) for a, b in zip(pair.commanded(name), motion.goal[name], strict=True))
            outcome.off_goal = max(outcome.off_goal, off)
        if len(motion.begun_ns) == len(NAMES):
            begun, ended_ns = motion.begun_ns, motion.ended_ns
            outcome.begin_apart_ns = max(outcome.begin_apart_ns, abs(begun["left"] - begun["right"]))
            outcome.end_apart_ns = max(outcome.end_apart_ns, abs(ended_ns["left"] - ended_ns["right"]))
            outcome.apart_s = max(outcome.apart_s, motion.apart_s)
    outcome.problems += pair.violations
    pair.close()
    return outcome


def run_mishaps(seed: int, count: int, kinds: Sequence[str] = ()) -> Outcome:
    """Cause a mishap of one arm at a random instant of random motions and record what the other does."""
    pair, outcome = Pair(seed), Outcome()
    for number in range(count):
        kind = kinds[number % len(kinds)] if kinds else pair.random.choice(list(pair.mishaps))
        who = pair.random.choice(NAMES)
        other = next(name for name in NAMES if name != who)
        motion = pair.begin()
        at = motion.start_ns + round(1e9 * pair.random.uniform(0.0, motion.duration_s))
        pair.follow(motion, lambda: pair.simulation.now_ns >= at or pair.rests_after(motion))  # noqa: B023
        began = pair.simulation.now_ns
        both_move = all(pair.arm(name).state is State.MOVING for name in NAMES)
        pair.mishaps[kind](who)
        stopped = pair.simulation.until(lambda: pair.arm(other).state is not State.MOVING, 30.0)  # noqa: B023
        reaction = pair.simulation.now_ns - began
        pair.simulation.until(lambda: pair.arm(other).state is not State.STOPPING, 30.0)  # noqa: B023
        pair.simulation.until(lambda: who in pair.simulation.silent or pair.arm(who).state not in LEAVING, 30.0)  # noqa: B023
        outcome.motions += 1
        if not stopped or pair.arm(other).state in (State.MOVING, State.STOPPING):
            outcome.problems.append(f"{number}: {kind} of {who}: {other} does not stop")
        if both_move:
            outcome.reaction_ns[kind] = max(outcome.reaction_ns.get(kind, 0), reaction)
        if pair.arm(other).state is State.HOLDING:
            place, _, _ = motion.plan[other].at(np.array([pair.path_s(other)]))
            off = max(abs(a - b) for a, b in zip(pair.commanded(other), place[0], strict=True))
            outcome.off_path = max(outcome.off_path, off)
            if kind in ON_PATH:
                outcome.rest_apart_s = max(outcome.rest_apart_s, abs(pair.path_s(who) - pair.path_s(other)))
        if not pair.recover():
            outcome.problems.append(f"{number}: {kind} of {who}: no recovery, {pair.events(who)} {pair.events(other)}")
            break
    outcome.problems += pair.violations
    pair.close()
    return outcome


@dataclass
class Nearness:
    """Least distance of two arms that do not know each other's targets."""

    stops: int = 0
    """Motions that the guard between them ended."""
    arrivals: int = 0
    least_m: float = inf
    problems: list[str] = field(default_factory=list)


def run_near(seed: int, count: int, clearance: float = 0.02) -> Nearness:
    """Let two arms move at random where they reach each other, until each was commanded `count` times."""
    pair, nearness = Pair(seed, cell_of(apart_m=0.55, clearance=clearance)), Nearness()
    bodies = {arm.name: body_of(arm) for arm in pair.cell.arms}
    left, right = bodies["left"], bodies["right"]
    assert left is not None
    assert right is not None
    commanded = dict.fromkeys(NAMES, 0)
    step = 0
    while min(commanded.values()) < count:
        for name in NAMES:
            arm = pair.arm(name)
            if arm.state is State.STOPPED_BY_LIMIT:
                pair.simulation.send(name, Reset())
            elif arm.state is State.HOLDING:
                commanded[name] += 1
                goal, speed = pair._target(name), pair.random.uniform(0.1, 1.5)
                pair.simulation.send(name, MoveJoints(tuple(goal), speed, pair.random.random() < 0.5))
        pair.simulation.cycle()
        step += 1
        if step % 4 == 0:
            left.place(pair.commanded("left"))
            right.place(pair.commanded("right"))
            nearness.least_m = min(nearness.least_m, distance(left.placed, right.placed)[0])
    for name in NAMES:
        nearness.stops += pair.events(name).count("PartnerNear")
        nearness.arrivals += pair.events(name).count("Arrived")
    if nearness.least_m < clearance:
        nearness.problems.append(f"the arms came as near as {nearness.least_m:.4f} m")
    nearness.problems += pair.violations
    pair.close()
    return nearness
