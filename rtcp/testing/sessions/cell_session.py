"""A random session of a cell from a seed: arms move near each other at once, and share an emergency stop.

Each arm has a `Session` of its own, with its checkers. Beside them the code of `oracle` checks the distance of the
arms, by the true positions of their joints. Nobody may move while a shared emergency stop is pressed or not read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from math import inf
from random import Random
from typing import Any, cast

from rtcp.config.cell import Base, CellConfig, Member
from rtcp.config.model import ArmConfig, ControlModeName, DriveModeName
from rtcp.config.segment import SegmentConfig
from rtcp.ipc import commands
from rtcp.ipc.events import ControllerRaised, PartnerNear
from rtcp.ipc.states import ControlMode, State
from rtcp.motion.limits import Limits, Values
from rtcp.motion.planning.in_step import Curve, Way, plan_brakes, plan_moves
from rtcp.motion.planning.plan import COLUMNS, PlanRefused
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.testing.cell import CellSimulation
from rtcp.testing.sessions.actions import SHARES
from rtcp.testing.sessions.checker import Bounds, Kind, Reading, Violation, reading_of
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.coverage import Coverage, drive_modes
from rtcp.testing.sessions.oracle import Placed, Shape, apart, in_world
from rtcp.testing.sessions.session import MOVABLE, Result, Session
from rtcp.testing.simulation import Frame, Simulation

UNREAD_S = 0.5
"""Time after which an emergency stop that nobody reads counts as pressed, s (docs/cell.md)."""
TOLERANCE_M = 0.01
"""By how much joints that follow their targets, in CST by the position loop, may come nearer than the clearance, m."""
NEAR_M = 0.25
"""Distance beyond the clearance at which the arms begin at most, m."""
_MOST_PLACES = 1500
"""Places of the arms that are tried before any is taken."""
_HALVINGS = 12
"""Halvings of the way between places that are too far from and too near to each other."""
_GOALS = 6
"""Goals of which the one nearest to the partner is taken."""
_LEAD_NS = 60_000_000
"""Time before a motion in step begins, ns."""
_PARTING_STEPS = 20


class Arm:
    """An arm of the cell: its session, and where its bodies are.

    Args:
        member: the arm.
        random: source of randomness of the whole session.
        simulation: the arm on its bus.
        reading: how its frames are read.
    """

    def __init__(self, member: Member, random: Random, simulation: Simulation, reading: Reading) -> None:
        self.name = member.name
        self.session = Session(random, member.config, reading, simulation=simulation)
        self.commander = self.session.commander
        self.commander.start()
        self.shape = Shape(member.config.models, None, 0.0)
        self._base = member.base

    @property
    def state(self) -> State:
        """State of its machine."""
        return self.commander.state

    @property
    def joints(self) -> list[float]:
        """True positions of the joints, rad."""
        servos, zeros = self.commander.servos, self.commander.checker.zero
        return [servo.mechanics.position - zero for servo, zero in zip(servos, zeros, strict=True)]

    def placed(self, q: Sequence[float]) -> list[Placed]:
        """Return the bodies in the world at these joint positions, rad."""
        return placed(self.shape, self._base, q)


class CellSession:
    """A session of a cell of arms on in-process buses. Everything follows from `random`.

    Args:
        random: source of randomness.
        cell: the cell.
        segments: name of an arm -> its slaves; left out: the configured segment.
    """

    def __init__(self, random: Random, cell: CellConfig, segments: Mapping[str, SegmentConfig] | None = None) -> None:
        self.random = random
        members = tuple(replace(arm, config=with_random_modes(arm.config, random)) for arm in cell.arms)
        self.cell = cell = replace(cell, arms=members)
        readings = {arm.name: reading_of(arm.config) for arm in members}
        self.simulation = CellSimulation(
            cell, random.randrange(1 << 30), positions=self._places(readings), segments=segments, follow_clock=False
        )
        self.arms = [Arm(arm, random, self.simulation.arms[arm.name], readings[arm.name]) for arm in members]
        self.live = list(self.arms)
        """The arms whose loop runs."""
        self._allowed = min(cell.clearance, self.distance()) - TOLERANCE_M
        """Least distance, m. Arms that begin nearer than the clearance must not come nearer."""
        self._check_in = 0
        self._off_ns = inf
        """From when on no drive may have torque, simulated time: an emergency stop is pressed, or not read."""
        self._fastest = 0.0
        """Way of two points towards each other in a cycle at most, m."""
        for arm in self.arms:
            simulation = arm.commander.simulation
            for joint, reach in zip(simulation.config.joints, arm.shape.reach, strict=False):
                self._fastest += joint.velocity * reach * simulation.period_ns * 1e-9
            assert simulation.on_frame is not None
            simulation.on_frame = partial(self._see, arm, simulation.on_frame)
        self.actions: list[tuple[int, Callable[[], object]]] = [
            (10, self._approach),
            (4, self._move_in_step),
            (6, self._limit_near_partner),
            (4, self._press),
            (1, self._kill),
            (2, self._lose_box),
            (4, self._part),
            (8, self._act),
        ]

    # -- what is checked ----------------------------------------------------------------------------------------------

    def distance(self) -> float:
        """Return the least distance of the bodies of two arms, m."""
        bodies = [arm.placed(arm.joints) for arm in self.arms]
        return min(apart(a, b) for a, b in combinations(bodies, 2))

    def _see(self, arm: Arm, watch: Callable[[Frame], None], frame: Frame) -> None:
        for other in self.arms:
            if other not in self.live:
                # Nobody sends to its drives any more.
                other.commander.simulation.bus.advance_to(frame.now_ns)
        arm.commander.checker.torque_off_from_ns = min(arm.commander.checker.torque_off_from_ns, self._off_ns)
        watch(frame)
        self._check_in -= 1
        if self._check_in > 0:
            return
        near = self.distance()
        if near < self._allowed:
            self._violate(Kind.PARTNER, near, self._allowed)
            return
        if near >= self.cell.clearance:
            self._allowed = self.cell.clearance - TOLERANCE_M
        self._check_in = int((near - self._allowed) / self._fastest)

    def _violate(self, kind: Kind, found: float, low: float) -> None:
        self.live[0].commander.checker.violations.append(Violation(kind, self.simulation.now_ns, 0, found, low, inf))

    @property
    def commander(self) -> Commander:
        """The commander of the arm with the first violation, or of the first arm."""
        return next((arm.commander for arm in self.arms if arm.commander.checker.violations), self.arms[0].commander)

    def close(self) -> None:
        """Free the memory."""
        self.simulation.__exit__()

    # -- places -------------------------------------------------------------------------------------------------------

    def _places(self, readings: Mapping[str, Reading]) -> dict[str, list[float]]:
        """Return joint positions, rad, at which the arms touch nothing and are as near each other as is wanted."""
        random, clearance, arms = self.random, self.cell.clearance, self.cell.arms
        shapes = [Shape(arm.config.models, None, 0.0) for arm in arms]
        begins_near = random.random() < 0.2
        wanted = clearance * random.uniform(0.3, 0.9) if begins_near else clearance + random.uniform(0.01, NEAR_M)

        def near(all_q: Sequence[Sequence[float]]) -> float:
            bodies = [placed(*each) for each in zip(shapes, (arm.base for arm in arms), all_q, strict=True)]
            return min(apart(a, b) for a, b in combinations(bodies, 2))

        def are_free(all_q: Sequence[Sequence[float]]) -> bool:
            for arm, q in zip(arms, all_q, strict=True):
                workspace = readings[arm.name].workspaces[0]
                if workspace is not None and workspace.deepest(Bounds.configured(arm.config), q) > -0.01:
                    return False
            return True

        far: list[list[float]] = []
        for _ in range(_MOST_PLACES):
            drawn = [[random.uniform(j.position.min, j.position.max) for j in arm.config.joints] for arm in arms]
            if near(drawn) > wanted:
                far = drawn
                continue
            # Somewhere between these places the arms are as near as is wanted.
            there, close = far or drawn, drawn
            for _ in range(_HALVINGS):
                drawn = [[0.5 * (a + b) for a, b in zip(*pair, strict=True)] for pair in zip(there, close, strict=True)]
                there, close = (drawn, close) if near(drawn) > wanted else (there, drawn)
            if far and are_free(there):
                far = there
                break
        return {arm.name: q for arm, q in zip(arms, far or drawn, strict=True)}

    def _near_goal(self, arm: Arm) -> list[float]:
        """Return a place of an arm that is nearer to its partners than most, rad."""
        others = [other.placed(other.joints) for other in self.arms if other is not arm]
        bounds, goals = arm.commander.bounds, []
        for _ in range(_GOALS):
            goal, here = arm.session.near(self.random.choice((0.8, 2.0))), arm.session.commanded
            if self.random.random() < 0.5:
                # One joint alone is guarded least early.
                moved = self.random.randrange(min(3, len(goal)))
                goal = [
                    q if joint == moved else before for joint, (q, before) in enumerate(zip(goal, here, strict=True))
                ]
            goals.append([max(a, min(b, q)) for q, a, b in zip(goal, bounds.low, bounds.high, strict=True)])
        return min(goals, key=lambda q: min(apart(arm.placed(q), bodies) for bodies in others))

    def towards(self, arm: Arm) -> list[float]:
        """Return for each joint the direction, 1 or -1, in which the arm comes nearer to its partners."""
        others = [other.placed(other.joints) for other in self.arms if other is not arm]
        here = arm.joints

        def near(q: Sequence[float]) -> float:
            return min(apart(arm.placed(q), bodies) for bodies in others)

        start, directions = near(here), []
        for joint in range(len(here)):
            moved = list(here)
            moved[joint] += 1e-3
            directions.append(1.0 if near(moved) < start else -1.0)
        return directions

    # -- actions ------------------------------------------------------------------------------------------------------

    def enable(self) -> None:
        """Enable all arms; first each is reset that needs it."""
        for arm in self.live:
            if arm.state not in MOVABLE:
                arm.commander.enable()
        for arm in self.live:
            arm.commander.simulation.until(lambda: arm.state is not State.ENABLING, 0.5)  # noqa: B023

    def _approach(self) -> None:
        """Let the arms move at once, mostly towards each other."""
        random = self.random
        self.enable()
        for arm in random.sample(self.live, len(self.live)):
            if random.random() < 0.2:
                continue
            mode = arm.session.mode
            if mode is ControlMode.TORQUE:
                pushed = zip(self.towards(arm), arm.commander.bounds.torque, strict=True)
                torque = [sign * random.choice((0.1, 0.3)) * most for sign, most in pushed]
                arm.session.send(commands.ApplyTorque(tuple(torque), 0.0, random.choice((0.0, 1.0)), 0.5))
            elif mode is ControlMode.VELOCITY:
                speeds = [sign * random.uniform(0.0, 0.4) for sign in self.towards(arm)]
                arm.session.send(commands.MoveAtVelocity(tuple(speeds), 1.0))
            elif mode is ControlMode.JOYSTICK:
                arm.session.joystick()
            else:
                speed = random.choice((0.5, 0.5, random.uniform(0.1, 0.5)))
                arm.session.send(commands.MoveJoints(tuple(self._near_goal(arm)), speed, random.random() < 0.5))

    def _move_in_step(self) -> None:
        """Run a motion in step, and mostly let something come in between."""
        random, arms = self.random, self.live
        self._set_joint_mode(arms)
        here = {arm.name: arm.session.commanded for arm in arms}
        limits = {arm.name: Limits(arm.commander.simulation.config) for arm in arms}
        try:
            ways = {arm.name: Way(limits[arm.name], here[arm.name], self._near_goal(arm)) for arm in arms}
            points = plan_moves(ways, random.choice((None, random.uniform(0.2, 1.0))))
            plans = {name: plan_trajectory(points[name], limits[name], here[name]).rows for name in here}
            brakes = plan_brakes({name: Curve(plans[name], len(here[name])) for name in here}, limits)
        except PlanRefused:
            return
        start = self.simulation.now_ns + _LEAD_NS
        table = tuple(tuple(brakes.times[at : at + COLUMNS]) for at in range(0, len(brakes.times), COLUMNS))
        step_s = 5e-324 if random.random() < 0.1 else brakes.step_s
        partners = (1 << (len(self.arms) - 1)) - 1
        for arm in arms:
            rows = plans[arm.name]
            slot = arm.commander.simulation.observer.write_plan(rows + table)
            arm.session.send(commands.RunInStep(slot, len(rows), start, partners, start, len(brakes.times), step_s))
        arm = random.choice(arms)
        arm.session.seconds(0.06, 0.8)
        random.choice(
            (lambda: arm.session.send(commands.Halt()), lambda: self._lower_acceleration(arm), self._press, self._kill)
        )()
        arm.session.send(commands.Halt())

    def _set_joint_mode(self, arms: Sequence[Arm]) -> None:
        self.enable()
        for arm in arms:
            if arm.session.send(commands.SetControlMode(ControlMode.JOINT)):
                arm.session.mode = ControlMode.JOINT
                arm.commander.wait(20)

    def _lower_acceleration(self, arm: Arm) -> None:
        commander = arm.commander
        part = self.random.choice((0.2, 0.3, 0.5))
        widest = Values.configured(commander.simulation.config)
        commander.set_limits(replace(commander.limits, acceleration=tuple(part * rate for rate in widest.acceleration)))

    def _limit_near_partner(self) -> None:
        """Lower an acceleration limit while the arms approach, or allow all of it again."""
        for arm in self.live:
            arm.commander.set_limits(Values.configured(arm.commander.simulation.config))
        if self.random.random() < 0.2:
            return
        self._approach()
        arm = self.random.choice(self.live)
        arm.session.seconds(0.1, 0.3)
        moving = [arm for arm in self.live if arm.state is State.MOVING]
        if moving:
            arm = self.random.choice(moving)
            room = self.cell.clearance + self.random.uniform(0.05, 0.6)
            while arm.state is State.MOVING and self.distance() > room and not self.violated:
                arm.session.seconds(0.01, 0.03)
            self._lower_acceleration(arm)
            arm.session.seconds(0.2, 1.0)

    def _press(self) -> None:
        """Press the emergency stop of an arm while others move, and mostly reset the others before it is released."""
        arm, random = self.random.choice(self.live), self.random
        arm.commander.press(True)
        self._stop_all(arm.commander.stopped_ns)
        self._insist()
        arm.commander.press(False)
        self._off_ns = inf if len(self.live) == len(self.arms) else self._off_ns
        arm.session.seconds(0.0, 0.1)
        if random.random() < 0.8:
            self.enable()

    def _kill(self) -> None:
        """Now and then kill the loop of an arm while others move."""
        if len(self.live) == len(self.arms) and self.random.random() < 0.5:
            self.kill(self.random.choice(self.live))

    def kill(self, arm: Arm) -> None:
        """End the loop of an arm for the rest of the session."""
        arm.commander.count_fault("loop killed", arm.name)
        self.live.remove(arm)
        self.simulation.silent.add(arm.name)
        self._stop_all(arm.commander.stopped_ns + round(1e9 * UNREAD_S))
        self._insist()

    def _lose_box(self) -> None:
        """Let the IO box of an arm leave OP, and return after a while: until then nobody reads its emergency stop."""
        arm = self.random.choice(self.live)
        simulation = arm.commander.simulation
        config = simulation.config
        names = [slave.name for slave in config.slaves]
        if config.inputs.emergency_stop is None:
            return
        simulation.service.comes_back = False
        arm.commander.drop(names.index(config.box_of(config.inputs.emergency_stop)) + 1)
        self._stop_all(arm.commander.stopped_ns + round(1e9 * UNREAD_S))
        self._insist()
        simulation.service.comes_back = True
        self._off_ns = inf if len(self.live) == len(self.arms) else self._off_ns
        arm.session.seconds(0.9, 1.2)

    def _stop_all(self, from_ns: int) -> None:
        if self.cell.share.emergency_stop:
            self._off_ns = min(self._off_ns, from_ns)

    def _insist(self) -> None:
        """Go on commanding the arms that are stopped, as a client does that knows nothing of the reason."""
        random = self.random
        for _ in range(random.randrange(1, 4)):
            random.choice(self.live).session.seconds(0.1, 0.5)
            if random.random() < 0.6:
                self._approach()
        until_ns = min(self._off_ns, self.simulation.now_ns + 10**9)
        while self.simulation.now_ns < until_ns and not self.violated:
            self.live[0].session.seconds(0.02, 0.05)
        self._approach()
        self.live[0].session.seconds(0.05, 0.1)

    def _part(self) -> None:
        """Move a joint of an arm so that none of its bodies comes nearer to a partner: the guard has to let it."""
        arm = self.random.choice(self.live)
        if len(self.live) < len(self.arms):
            return
        self._set_joint_mode(self.live)
        if any(each.state is not State.HOLDING for each in self.live):
            return
        goal = self._parting_goal(arm)
        if goal is None:
            return
        simulation, near = arm.commander.simulation, self.distance()
        events = simulation.observer.last_event
        if arm.session.send(commands.MoveJoints(tuple(goal), 0.5, True)):
            simulation.until(lambda: arm.state is not State.MOVING or self.violated, 2.0)
            ended = [record.event for record in simulation.observer.events_since(events)]
            if any(isinstance(event, PartnerNear) for event in ended):
                self._violate(Kind.NOT_LED_APART, near, self.cell.clearance)

    def _parting_goal(self, arm: Arm) -> list[float] | None:
        """Return a goal on whose way every body of the arm moves away from every body of its partners, or None."""
        random, bounds, here = self.random, arm.commander.bounds, arm.joints
        others = [body for other in self.arms if other is not arm for body in other.placed(other.joints)]
        for _ in range(_GOALS):
            goal, joint = list(here), random.randrange(min(3, len(here)))
            goal[joint] += random.choice((-0.5, -0.3, 0.3, 0.5))
            before = [-inf]
            for step in range(_PARTING_STEPS + 1):
                q = [a + (b - a) * step / _PARTING_STEPS for a, b in zip(here, goal, strict=True)]
                now = [apart([mine], [theirs]) for mine in arm.placed(q) for theirs in others]
                if any(b < a + 1e-6 for a, b in zip(before, now, strict=False)):
                    break
                before = now
            else:
                if bounds.low[joint] < goal[joint] < bounds.high[joint]:
                    return goal
        return None

    def _act(self) -> None:
        """Do something of a single arm's session."""
        session = self.random.choice(self.live).session
        self.random.choice(
            (session.command, session.jog, session.stream, session.setpoints, session.trajectory, session.limits)
        )()

    # -- the session --------------------------------------------------------------------------------------------------

    @property
    def violated(self) -> bool:
        """Whether a checker of an arm has found something."""
        return any(arm.commander.checker.violations for arm in self.arms)

    def run(self, seconds: float) -> None:
        """Run for this simulated time, s, or to the first violation.

        Raises:
            RuntimeError: a controller has raised an exception.
        """
        weights = [weight for weight, _ in self.actions]
        while self.live[0].commander.seconds < seconds and not self.violated:
            if any(arm.state not in MOVABLE for arm in self.live) and self.random.random() < 0.7:
                self.enable()
            self.random.choices(self.actions, weights)[0][1]()
            self.random.choice(self.live).session.seconds(0.0, 0.4)
        for arm in self.arms:
            raised = [
                each.event for each in arm.commander.simulation.events if isinstance(each.event, ControllerRaised)
            ]
            if raised:
                raise RuntimeError(arm.commander.simulation.names.message(raised[0]))

    def result(self, seed: int, error: Exception | None = None) -> Result:
        """Return the result of the session as it is now: counts of all arms, and the first violation."""
        results = [arm.session.result(seed, error) for arm in self.arms]
        worst = next((result for result in results if result.outcome != "passed"), results[0])
        sums: dict[str, Any] = {}
        for name in ("cycles", "commands", "faults"):
            sums[name] = sum(getattr(result, name) for result in results)
        for name in ("simulated_s", "largest_step", "largest_acceleration", "largest_speed"):
            sums[name] = max(getattr(result, name) for result in results)
        coverage = Coverage()
        for arm in self.arms:
            coverage.add(arm.commander.coverage)
        return replace(worst, coverage=coverage.as_json(), **sums)


def with_random_modes(config: ArmConfig, random: Random) -> ArmConfig:
    """Return the configuration with a random control mode and drive mode."""
    (control_mode,) = random.choices(list(ControlMode), SHARES)
    drive_mode = random.choice(drive_modes(config))
    return replace(
        config, control_mode=cast(ControlModeName, control_mode.name.lower()),
        drive_mode=cast(DriveModeName, drive_mode.name.lower()),
    )  # fmt: skip


def placed(shape: Shape, base: Base, q: Sequence[float]) -> list[Placed]:
    """Return the bodies of an arm in the world at these joint positions, rad."""
    (x, y, z), (rx, ry, rz) = base.position, base.rpy
    return in_world(shape.placed(q), (x, y, z), (rx, ry, rz))
