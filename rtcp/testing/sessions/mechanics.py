"""A checker of what the simulated joints really do, whatever the frames say: speed, acceleration, place, energy.

It reads the mechanics of the drives' models once a cycle. A hand, a load, a drive that does not obey and lost frames
explain a motion; a false measurement does not. Everything else has to be commanded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import Protocol

from rtcp.config.model import ArmConfig
from rtcp.ipc.commands import (
    ApplyTorque,
    Command,
    Enable,
    Guide,
    Home,
    Jog,
    MotionCommand,
    MoveAtVelocity,
    MoveGripper,
    MoveJoints,
    SetLimits,
)
from rtcp.ipc.events import Arrived, Event, FaultEvent, MotionEnded, Stopped
from rtcp.ipc.states import State
from rtcp.testing.sessions.checker import CSP, CST, CSV, FrameChecker, Kind
from rtcp.testing.simulation import Frame
from rtcp.virtual.models.servo import ServoAxis

WINDOW_S = 0.01
"""Time over which the acceleration of a joint is measured, s."""
SETTLED_S = 0.15
"""Time after which nothing remains of a change: a hand begins or ends to push, a drive obeys, frames return, s."""
ACCELERATION, EXTRA_ACCELERATION = 1.5, 1.0
"""Largest acceleration of a joint as a multiple of its limit, because the drive's loop overshoots, and what friction
adds, which sticks and slips at slow speeds, rad/s^2."""
SPEED, EXTRA_SPEED = 1.1, 0.02
"""Largest speed of a joint as a multiple of its limit, or of the supervised speed in CST, and what the position loop
adds, rad/s."""
STUCK = 2.0
"""How much faster a joint may be in CST while its measured speed is stuck: nothing damps it until that is noticed."""
TORQUE_SHARE, EXTRA_TORQUE = 0.1, 1.0
"""Largest step of a target torque in a cycle, as a fraction of the torque limit, and in addition, Nm: the joints of
small inertia change their speed, and with it their damping, fast."""
EXPLAINED = 1.5
"""Change of a torque as a multiple of what the position loop makes of the motion: its measurements may be late."""
RELEASED_S = 0.1
"""Time after which the release of the enabling switch counts, s: its contact bounces."""
REST_S, REST_WHERE_COMPLIANT_S = 0.5, 1.5
"""Time without a command after which a joint rests, s; the second in CST and CSV, whose position loops are slow where a
hand or a load has moved the joint."""
MOVED_RAD = 5e-3
"""Way by which a joint that should rest has moved, rad."""
STILL_RAD_S = 0.03
"""Speed of a joint that should rest, rad/s."""
ARRIVED_RAD = 1e-3
"""Way of a joint between its measurement and the event that says that it is at its target, and rounding, rad."""
FROM_OTHER_MODE = 1.5
"""How much larger the first step of a torque in CST may be, whose torque before is measured."""
ALMOST = 0.999
"""Fraction of a torque limit that counts as all of it: a target torque is a whole count."""
ENERGY_J, ENERGY_IN_CST_J = 0.02, 0.15
"""Kinetic energy of a joint that needs no explanation, J: in CST the position loop is a spring that has stored some."""
DEEP_M, DEEP_WHERE_COMPLIANT_M = 3e-3, 6e-3
"""Depth in what the arm keeps clear of that the following error of the joints explains, m, in CSP; in CSV and CST."""
GRASPED_NM = 0.3
"""Step of a torque from outside in one cycle that only a hand or a load can be, Nm: the arm's weight changes slower."""
GOOD_PER_LOST = 4
"""Good cycles that make up for a lost one."""
EXTRA_LOST = 2
"""Lost frames that the loop may not have noticed yet."""
GRAVITY = 9.81

_RESTING = frozenset({State.READY, State.HOLDING, State.STOPPED_BY_LIMIT})
_UNCOMMANDED = _RESTING | {
    State.OFF, State.STARTING, State.STOPPING, State.DISABLING, State.FAULT, State.RESETTING, State.EMERGENCY_STOP,
}  # fmt: skip
_ENABLED = frozenset({State.HOLDING, State.MOVING, State.STOPPED_BY_LIMIT})
_WITHOUT_TARGET = (Jog, MoveAtVelocity, ApplyTorque, Guide)
_MOTION_ENDS = (Arrived, Stopped, MotionEnded, FaultEvent)


class Surroundings(Protocol):
    """What acts on the arm from outside."""

    pushed: dict[int, float]
    """Torque of a hand, Nm, by the joint's number from 0."""
    payload_kg: float
    """Mass at the tool that the arm's model does not know, kg."""
    stuck_until_ns: list[int]
    """Simulated time until which a value of each drive is stuck, or its consequences last."""
    permitted: bool
    """Whether the enabling switch is pressed, or there is none."""


class MechanicsChecker:
    """Checks the joints in every cycle; violations are added to those of the frames.

    Args:
        frames: the checker of the frames, which has checked the same cycle before.
        config: the arm.
        servos: the drives of its joints.
    """

    def __init__(self, frames: FrameChecker, config: ArmConfig, servos: Sequence[ServoAxis]) -> None:
        self._frames = frames
        self._bounds = frames.bounds
        self._axes = [servo.axis for servo in servos]
        self._mechanics = [servo.mechanics for servo in servos]
        self._settle = config.settle.tolerance
        self._clearance = config.cartesian.clearance
        self._fastest_in_cst = config.supervision.speed
        self._most_lost = config.bus.lost_cycles + EXTRA_LOST
        self._stop_s = REST_S + max(j.velocity / j.acceleration + j.acceleration / j.jerk for j in config.joints)
        self._dt = dt = config.cycle.period_us * 1e-6
        count = len(servos)
        self._window = max(1, round(WINDOW_S / dt))
        self._speeds: deque[list[float]] = deque(maxlen=3 * self._window + 1)
        """Speeds of the joints in the last cycles, rad/s."""
        self._outside = [mechanics.external_torque for mechanics in self._mechanics]
        self._obeys = [False] * count
        self._torques: list[float | None] = [None] * count
        self._was_cst = [False] * count
        """Target torques of the last frame of drives in CST, Nm."""
        self._efforts: deque[list[float | None]] = deque(maxlen=self._window + 1)
        """The same of the last cycles."""
        self._torque_steps = [TORQUE_SHARE * joint.torque + EXTRA_TORQUE for joint in config.joints]
        self._stiffness = [joint.cst_stiffness for joint in config.joints]
        self._damping = [joint.cst_damping for joint in config.joints]
        self._cycles_by_position = 0
        """Cycles since the last torque motion, or the torque that was left of it."""
        self._cycles_calm = 0
        """Cycles since the last change of what acts on the joints."""
        self._cycles_stiff = 0
        """Cycles since a joint was last in CST, where accelerations have no limit."""
        self._cycles_uncommanded = self._cycles_resting = self._cycles_released = 0
        """Cycles in a state without a command, in one in which the joints rest, and without the enabling switch."""
        self._energy = [inf] * count
        """Kinetic energy of each joint that is explained, J."""
        self._begin: list[float] | None = None
        """Where the joints were when the energy was first compared, rad."""
        self._places: list[float] | None = None
        """Where the joints came to rest, rad."""
        self._stopped: list[float] | None = None
        """Where they stood when they had to, rad."""
        self._lost = 0.0
        self._check_bodies_in = 0
        self._is_excused = True
        """Whether the arm was enabled where a body is too near and has not come away yet."""
        self._target: Sequence[float] | None = None
        """Where the last motion command leads, rad; None: to the last targets on the bus."""
        self._arrives = True
        """Whether the last motion command has a target."""
        self._pushing: Sequence[float] | None = None
        """Torques of the present torque motion without a spring, Nm; None: there is none."""

    # -- what happens -----------------------------------------------------------------------------------------------

    def accepted(self, command: Command, now_ns: int) -> None:
        """Take note of a command that was accepted; without the enabling switch it must not let anything move."""
        if isinstance(command, MotionCommand | Enable | Home | MoveGripper):
            self._limit(Kind.NOT_PERMITTED, now_ns, -1, self._cycles_released * self._dt, RELEASED_S)
        if isinstance(command, MotionCommand):
            self._target = command.q if isinstance(command, MoveJoints) else None
            self._arrives = not isinstance(command, _WITHOUT_TARGET)
            self._pushing = None
            if isinstance(command, Guide):
                self._pushing = [0.0] * len(self._mechanics)
            elif isinstance(command, ApplyTorque) and command.stiffness == 0.0:
                self._pushing = command.torque
            self._cycles_uncommanded, self._begin = 0, None
        elif isinstance(command, SetLimits):
            # What the joints do now began under the old limits.
            self._cycles_calm = 0

    def event(self, event: Event, now_ns: int) -> None:
        """Check an event of the loop: a motion is only complete when the joints are at its target."""
        if isinstance(event, Arrived) and self._arrives:
            targets = self._frames.targets if self._target is None else self._target
            allowed = self._settle + ARRIVED_RAD
            for axis, (target, q) in enumerate(zip(targets, self._positions(), strict=False)):
                self._limit(Kind.NOT_ARRIVED, now_ns, axis, abs(target - q), allowed)
        if isinstance(event, _MOTION_ENDS):
            self._target = self._pushing = None

    def _positions(self) -> list[float]:
        """Return the joint positions, rad."""
        return [axis.position - zero for axis, zero in zip(self._axes, self._frames.zero, strict=True)]

    def _limit(self, kind: Kind, now_ns: int, axis: int, found: float, allowed: float) -> None:
        if found > allowed:
            self._frames.violate(kind, now_ns, axis, found, -inf, allowed)

    # -- every cycle ------------------------------------------------------------------------------------------------

    def check(self, frame: Frame, state: State, surroundings: Surroundings) -> None:
        """Check a cycle.

        Args:
            frame: what was sent and received.
            state: state of the machine after the cycle.
            surroundings: what acts on the arm now.
        """
        now, speeds = frame.now_ns, [mechanics.velocity for mechanics in self._mechanics]
        self._speeds.append(speeds)
        self._find_changes()
        self._check_lost(now, state)
        calm = self._cycles_calm * self._dt > SETTLED_S
        self._check_torques(now, calm)
        self._check_efforts(now, calm, surroundings)
        pushed = any(surroundings.pushed.values())
        if calm and all(self._obeys):
            self._check_motion(now, speeds, surroundings)
        self._check_uncommanded(now, state, speeds, surroundings, calm)
        rests = not pushed and self._cycles_calm * self._dt > self._rest_s()
        self._check_stop(now, speeds, surroundings, rests)
        self._check_bodies(now, pushed or not calm)

    def _rest_s(self) -> float:
        """Return the time after a change in which the joints come to rest in their drive mode, s."""
        return SETTLED_S if self._frames.samples[0].mode == CSP else REST_WHERE_COMPLIANT_S

    def _find_changes(self) -> None:
        """Count the cycles since a hand, a load, a drive or lost frames last changed what acts on the joints."""
        changed = not self._frames.is_answered
        outside = [mechanics.external_torque for mechanics in self._mechanics]
        for torque, before in zip(outside, self._outside, strict=True):
            if not -GRASPED_NM <= torque - before <= GRASPED_NM:
                changed = True
        self._outside = outside
        obeys = [s.commanded and s.enabled and s.mode in (CSP, CSV, CST) for s in self._frames.samples]
        if obeys != self._obeys:
            self._obeys, changed = obeys, True
            self._torques = [None] * len(obeys)
        self._cycles_calm = 0 if changed else self._cycles_calm + 1

    def _check_lost(self, now: int, state: State) -> None:
        """Frames that are lost again and again end in a fault."""
        if state not in _ENABLED:
            self._lost = 0.0
        elif self._frames.is_answered:
            self._lost = max(self._lost - 1.0 / GOOD_PER_LOST, 0.0)
        else:
            self._lost += 1.0
            self._limit(Kind.LOST_FRAMES, now, -1, self._lost, self._most_lost)

    def _check_torques(self, now: int, calm: bool) -> None:
        """The target torque of a drive in CST is continuous, also when it continues the torque of another mode."""
        for axis, sample in enumerate(self._frames.samples):
            if not self._obeys[axis]:
                continue
            if sample.mode != CST:
                # A torque that changes fast is measured too late.
                self._torques[axis] = self._axes[axis].torque if calm else None
                self._was_cst[axis] = False
                continue
            last, self._torques[axis] = self._torques[axis], sample.torque
            if last is not None and last != sample.torque and not self._ends_outward(axis, last, sample.torque):
                # Of another mode the last torques count that are no false samples.
                allowed = self._torque_steps[axis] * (1.0 if self._was_cst[axis] else FROM_OTHER_MODE)
                self._limit(Kind.TORQUE_STEP, now, axis, abs(sample.torque - last), allowed)
            self._was_cst[axis] = True

    def _ends_outward(self, axis: int, last: float, torque: float) -> bool:
        """Whether a torque that pushes a joint further out of its range becomes smaller: that may be at once."""
        position, bounds = self._mechanics[axis].position, self._bounds
        side = 1.0 if position > bounds.high[axis] else -1.0 if position < bounds.low[axis] else 0.0
        return 0.0 <= torque * side < last * side

    def _check_efforts(self, now: int, calm: bool, surroundings: Surroundings) -> None:
        """Over 10 ms too the position loop in CST changes its torque no more than the motion of the joint explains."""
        self._cycles_by_position = 0 if self._pushing is not None or not calm else self._cycles_by_position + 1
        in_cst = [self._obeys[axis] and s.mode == CST for axis, s in enumerate(self._frames.samples)]
        self._efforts.append([self._torques[axis] if in_cst[axis] else None for axis in range(len(in_cst))])
        if self._cycles_by_position * self._dt <= SETTLED_S:
            return
        for axis, (torque, before) in enumerate(zip(self._efforts[-1], self._efforts[0], strict=True)):
            if torque is None or before is None or now < surroundings.stuck_until_ns[axis]:
                continue
            change, allowed = abs(torque - before), self._torque_steps[axis]
            if change > allowed:
                speeds = [each[axis] for each in self._speeds]
                fastest = max(*speeds, -min(speeds))
                explained = self._damping[axis] * (max(speeds) - min(speeds))
                explained += self._stiffness[axis] * fastest * self._window * self._dt
                allowed += EXPLAINED * explained
                self._limit(Kind.TORQUE_STEP, now, axis, change, allowed)

    def _check_motion(self, now: int, speeds: Sequence[float], surroundings: Surroundings) -> None:
        past = self._speeds[max(len(self._speeds) - 1 - self._window, 0)]
        velocity, acceleration = self._bounds.velocity, self._bounds.acceleration
        pushed, window_s = surroundings.pushed, self._window * self._dt
        self._cycles_stiff = 0 if any(s.mode == CST for s in self._frames.samples) else self._cycles_stiff + 1
        for axis, speed in enumerate(speeds):
            if pushed and abs(pushed.get(axis, 0.0)) > self._bounds.torque[axis]:
                continue  # nothing holds against this hand
            in_cst = self._frames.samples[axis].mode == CST
            faster = self._fastest_in_cst * (STUCK if now < surroundings.stuck_until_ns[axis] else 1.0)
            fastest = SPEED * velocity[axis] * (faster if in_cst else 1.0) + EXTRA_SPEED
            if not -fastest <= speed <= fastest:
                self._limit(Kind.TRUE_SPEED, now, axis, abs(speed), fastest)
            if self._cycles_stiff > self._window:
                change, allowed = speed - past[axis], ACCELERATION * acceleration[axis] + EXTRA_ACCELERATION
                if not -allowed * window_s <= change <= allowed * window_s:
                    self._limit(Kind.TRUE_ACCELERATION, now, axis, abs(change) / window_s, allowed)

    def _check_uncommanded(
        self, now: int, state: State, speeds: Sequence[float], surroundings: Surroundings, calm: bool
    ) -> None:
        """Without a command no joint gains energy, and soon none moves."""
        pushed = any(surroundings.pushed.values())
        is_torque = state is State.MOVING and self._pushing is not None
        if not (state in _UNCOMMANDED or is_torque) or not calm or (pushed and not is_torque):
            self._cycles_uncommanded = self._cycles_resting = 0
            self._begin = None
            return
        self._cycles_uncommanded += 1
        if self._cycles_uncommanded * self._dt > SETTLED_S or is_torque:
            self._check_energy(now, speeds, surroundings, self._pushing if is_torque else None)
        if state not in _RESTING:
            self._cycles_resting = 0
            return
        self._cycles_resting += 1
        if self._cycles_resting * self._dt <= max(self._rest_s(), REST_S):
            self._places = None
            return
        places = [mechanics.position for mechanics in self._mechanics]
        if self._places is None:
            self._places = places
        for axis, (q, place, rest) in enumerate(zip(self._positions(), places, self._places, strict=True)):
            # A joint outside its range returns by itself.
            if self._bounds.low[axis] <= q <= self._bounds.high[axis]:
                self._limit(Kind.MOVED, now, axis, abs(place - rest), MOVED_RAD)

    def _check_energy(
        self, now: int, speeds: Sequence[float], surroundings: Surroundings, torques: Sequence[float] | None
    ) -> None:
        """No joint has more kinetic energy than it had, and than torques and hands have given it since.

        An unknown load is carried by the torque that was needed where the motion began; elsewhere it pulls.
        """
        places = [mechanics.position for mechanics in self._mechanics]
        if self._begin is None:
            self._begin, self._energy = places, [inf] * len(places)
        far = min(1.0, sum(abs(a - b) for a, b in zip(places, self._begin, strict=True)))
        workspace = self._frames.workspace
        for axis, (mechanics, speed) in enumerate(zip(self._mechanics, speeds, strict=True)):
            energy = 0.5 * mechanics.inertia * speed * speed
            if torques is None:
                # A drive that gives all that the limits allow may be too weak for the weight.
                spent = abs(self._frames.samples[axis].torque) >= self._bounds.torque[axis] * ALMOST
                explained = energy if spent else min(self._energy[axis], energy)
            else:
                reach = workspace.reach[axis] if workspace is not None and axis < len(workspace.reach) else 1.0
                pull = abs(torques[axis]) + abs(surroundings.pushed.get(axis, 0.0))
                # What holds a joint at rest may be wrong by its friction.
                pull += surroundings.payload_kg * GRAVITY * reach * far + mechanics.coulomb
                explained = energy if self._energy[axis] == inf else self._energy[axis] + pull * abs(speed) * self._dt
            self._energy[axis] = explained
            is_spring = torques is None and self._frames.samples[axis].mode == CST
            self._limit(Kind.ENERGY, now, axis, energy - explained, ENERGY_IN_CST_J if is_spring else ENERGY_J)

    def _check_stop(self, now: int, speeds: Sequence[float], surroundings: Surroundings, calm: bool) -> None:
        """After a stop, and without the enabling switch, the joints rest in time, not only their targets."""
        self._cycles_released = 0 if surroundings.permitted else self._cycles_released + 1
        stopped_ns = min(self._frames.rest_from_ns, self._frames.torque_off_from_ns) + SETTLED_S * 1e9
        if (now <= stopped_ns and self._cycles_released * self._dt <= self._stop_s) or not calm:
            self._stopped = None
            return
        places = [mechanics.position for mechanics in self._mechanics]
        if self._stopped is None:
            self._stopped = places
        for axis, (speed, place, rest) in enumerate(zip(speeds, places, self._stopped, strict=True)):
            self._limit(Kind.NOT_AT_REST, now, axis, abs(speed), STILL_RAD_S)
            self._limit(Kind.MOVED, now, axis, abs(place - rest), MOVED_RAD)

    def _check_bodies(self, now: int, pushed: bool) -> None:
        """In every mode the bodies stay off the boxes and each other; a hand may push them into the clearance."""
        workspace = self._frames.workspace
        if workspace is None or not all(self._obeys):
            self._check_bodies_in, self._is_excused = 0, True
            return
        self._check_bodies_in -= 1
        if self._check_bodies_in > 0:
            return
        deepest = workspace.deepest(self._bounds, self._positions())
        if self._is_excused and deepest > 0.0:
            return
        self._is_excused = False
        follows = DEEP_M if self._frames.samples[0].mode == CSP else DEEP_WHERE_COMPLIANT_M
        self._limit(Kind.BODY, now, -1, deepest, self._clearance if pushed else follows)
        fastest = sum(v * reach for v, reach in zip(self._bounds.velocity, workspace.reach, strict=False)) * self._dt
        self._check_bodies_in = int(max(-deepest, 0.01) / (self._fastest_in_cst * fastest))
