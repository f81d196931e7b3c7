"""A checker of what goes over the bus: each frame is decoded and compared with the limits in force at that time.

It knows nothing of the loop. How a frame is read and where the arm's bodies are is a `Reading`: `reading_of` follows
the numbers of the device descriptions and of the arm's geometry, with the code of `oracle` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from math import inf
from typing import TYPE_CHECKING, NamedTuple

from rtcp.config.model import JOINTS, ArmConfig, Joint
from rtcp.ipc.states import State
from rtcp.testing.sessions.oracle import Shape, unpacker
from rtcp.testing.simulation import Frame

if TYPE_CHECKING:
    from rtcp.motion.limits import Corners, Values

CSP, CSV, CST = 8, 9, 10
HOMING = 6
CHANGING = -1
ENABLE_OPERATION = 0x0F
OPERATION_ENABLED, STATE_MASK = 0x27, 0x6F
WINDOWS = (1, 4, 16, 64)
"""Cycles over which the acceleration is checked: a window of n sees what rounding hides from a shorter one."""
SPEED_WINDOW = 16
"""Cycles of the shortest of these windows over which the speed is checked, beside the single step."""
ROUNDING = 2
"""Counts by which the rounding of three positions bends a straight line at most: 1/2 + 2 * 1/2 + 1/2."""
NUMERIC_RAD = 1e-8
"""Rounding of the calculation itself, which counts where the encoder is finer, rad."""
EXACT_COUNTS, EXACT_RAD = 1e-6, 1e-12
"""Rounding of the ends of a range, of which the targets in counts stay inside: counts, and rad where they are finer."""
MARGIN_RAD = 0.02
"""Distance outside its range at which a joint may still be enabled, to be led back, rad."""
LATCHED_RAD = 5e-4
"""Largest distance between the first target after enabling and the joint, which may sag when the brake opens, rad."""
MEASURED_STEPS = 3
"""Cycles by which the measured place of a joint may be older than the target that begins there."""
MOVED_RAD = 5e-3
"""Way of a target, rad, by which a joint that should rest has moved."""
_POINTER_M = 0.1
"""Distance, m, as which 1 rad outside a cone counts."""
ZONE_TOLERANCE_M = 0.5e-3
"""Depth in a zone that the rounding of positions explains, m."""
INCONSISTENT_S = 0.1
"""Time for which the machine's state and its drives may disagree, s."""
MOST_VIOLATIONS = 20
_KEPT = 2 * WINDOWS[-1] + 1
_WITHOUT_TORQUE = frozenset({State.OFF, State.STARTING, State.READY})
_WITH_TORQUE = frozenset({State.HOLDING, State.MOVING})


class Kind(str, Enum):
    """What a violation breaks; `found` and `allowed` of the violation are in the unit given here."""

    FIRST_TARGET = "first_target"
    """The first target after enabling is not where the joint stands, rad."""
    RANGE = "range"
    """A target outside its range, rad."""
    STEP = "step"
    """A step of the target in one cycle, rad."""
    MODE_STEP = "mode_step"
    """A step of the target when the drive mode changes, rad."""
    RECEIVED_STEP = "received_step"
    """A step between two targets that a drive received, with lost frames between them, rad."""
    ACCELERATION = "acceleration"
    """A bend of the target over some cycles, rad/s^2."""
    VELOCITY = "velocity"
    """A target velocity, or that of the target over some cycles, rad/s."""
    VELOCITY_STEP = "velocity_step"
    """A change of the target velocity over some cycles, rad/s^2."""
    TORQUE = "torque"
    """A target torque, Nm."""
    ZONE = "zone"
    """Depth of a body in a keep-out box or another body, or of the tool outside its box, m."""
    MODE = "mode"
    """An enabled drive is commanded in a drive mode whose targets nobody checks; `found`: the mode."""
    NOT_STOPPED = "not_stopped"
    """The number of joints that obey long after the emergency stop, or that move long after the lease or a halt."""
    TORQUE_IN_STATE = "torque_in_state"
    """A drive has torque in a state without; `found`: the state."""
    NO_TORQUE_IN_STATE = "no_torque_in_state"
    """A drive has none while the arm is held; `found`: the state."""
    LOST_FRAMES = "lost_frames"
    """Lost frames, less a tenth of the good ones, with drives that are still commanded."""
    TORQUE_STEP = "torque_step"
    """A step of the target torque in one cycle, Nm."""
    TRUE_SPEED = "true_speed"
    """The speed of a joint itself, rad/s."""
    TRUE_ACCELERATION = "true_acceleration"
    """The acceleration of a joint itself, rad/s^2."""
    ENERGY = "energy"
    """Kinetic energy that a joint gains without a command and without a hand, J."""
    MOVED = "moved"
    """The way of a joint itself without a command and without a hand, rad."""
    NOT_AT_REST = "not_at_rest"
    """The speed of a joint itself long after an emergency stop, a halt or the end of the lease, rad/s."""
    NOT_ARRIVED = "not_arrived"
    """The distance of a joint itself from its target when the loop says that the motion is complete, rad."""
    BODY = "body"
    """Depth of a body itself in a keep-out box or another body, or of the tool outside its box, m."""
    NOT_PERMITTED = "not_permitted"
    """Time since the release of the enabling switch at which a command that lets something move was accepted, s."""
    PARTNER = "partner"
    """Distance of two arms of a cell that came too near to each other, m."""
    NOT_LED_APART = "not_led_apart"
    """Distance of two arms, m, of which one was stopped on a way on which all its bodies move away from the other."""


@dataclass(frozen=True)
class Violation:
    """A limit that was not kept."""

    kind: Kind
    time_ns: int
    """Simulated time."""
    joint: int
    """Number of the joint, from 1; 0: the arm as a whole."""
    found: float
    low: float
    high: float
    """Ends of what is allowed."""

    def __str__(self) -> str:
        where = f"joint {self.joint}: " if self.joint else ""
        name = self.kind.value.replace("_", " ")
        return f"{self.time_ns * 1e-9:.4f} s, {where}{name} {self.found:.6g}, allowed {self.low:.6g} to {self.high:.6g}"


@dataclass
class Bounds:
    """The limits in force, in rad, rad/s, rad/s^2, Nm and m; one number a joint."""

    low: list[float]
    high: list[float]
    velocity: list[float]
    acceleration: list[float]
    torque: list[float]
    box: Corners | None = None
    keep_out: tuple[Corners, ...] = ()
    cones: tuple[float, ...] = ()
    """Largest angle of each cone, rad."""

    @classmethod
    def configured(cls, config: ArmConfig) -> Bounds:
        """Return the limits of a configuration."""
        joints, cartesian = config.joints, config.cartesian
        return cls(
            [joint.position.min for joint in joints],
            [joint.position.max for joint in joints],
            [joint.velocity for joint in joints],
            [joint.acceleration for joint in joints],
            [joint.torque for joint in joints],
            None if cartesian.box is None else _corners(cartesian.box.min, cartesian.box.max),
            tuple(_corners(box.min, box.max) for box in cartesian.keep_out),
            tuple(cone.angle for cone in cartesian.cones),
        )

    def put(self, new: Values) -> None:
        """Change all of them in place."""
        self.low[:], self.high[:] = new.low, new.high
        self.velocity[:], self.acceleration[:], self.torque[:] = new.velocity, new.acceleration, new.torque
        self.box, self.keep_out = new.box, new.keep_out
        self.cones = tuple(cone.angle for cone in new.cones)


def _corners(low: Sequence[float], high: Sequence[float]) -> Corners:
    (a, b, c), (d, e, f) = low, high
    return a, b, c, d, e, f


# -- how a frame is read --------------------------------------------------------------------------------------------


class Sample(NamedTuple):
    """Process data of a joint, by the drive's own zero: rad, rad/s, Nm."""

    commanded: bool
    """Whether the drive is commanded to enable operation."""
    position: float
    velocity: float
    torque: float
    mode: int
    enabled: bool
    """Whether the drive reports operation enabled."""
    actual: float
    shown_mode: int


@dataclass(frozen=True)
class JointReading:
    """How the frames of one joint are read."""

    slot: int
    """Index of its slave."""
    decode: Callable[[bytes, bytes], Sample]
    """Outputs and inputs of the slave -> sample."""
    resolution: tuple[float, float, float]
    """One count of position, velocity and torque: rad, rad/s, Nm."""


@dataclass(frozen=True)
class Workspace:
    """Where the arm's bodies are."""

    deepest: Callable[[Bounds, Sequence[float]], float]
    """Limits and joint positions -> depth of the arm in what it keeps clear of, m; negative: outside."""
    reach: Sequence[float]
    """Largest distance that a point of the arm moves by a joint, m/rad."""


@dataclass(frozen=True)
class Reading:
    """How the frames of an arm are read."""

    joints: Sequence[JointReading]
    workspaces: Sequence[Workspace | None] = (None,)
    """By the numbers of the tools; None: boxes and bodies are not checked."""


def reading_of(config: ArmConfig) -> Reading:
    """Return the reading of an arm's frames by its device files and its geometry.

    Raises:
        ValueError: there are no joints, or a drive has no controlword, as behind a robot controller, or a channel that
            is not of whole bytes.
    """
    if not config.joints:
        raise ValueError("it has no joints")
    slots = {slave.name: slot for slot, slave in enumerate(config.slaves)}
    joints = [_joint_reading(config, joint, slots[joint.slave]) for joint in config.joints]
    return Reading(joints, [_workspace(config, tool) for tool in range(len(config.models))] or (None,))


def _workspace(config: ArmConfig, tool: int) -> Workspace | None:
    shape, cartesian = Shape(config.models, tool, config.cartesian.clearance), config.cartesian

    def deepest(limits: Bounds, q: Sequence[float]) -> float:
        tilts = [
            _POINTER_M * (shape.tilt(q[:JOINTS], "xyz".index(cone.axis), cone.direction) - angle)
            for cone, angle in zip(cartesian.cones, limits.cones, strict=True)
        ]
        return max([-shape.distance(q[:JOINTS], limits.box, limits.keep_out), *tilts])

    is_guarded = shape.is_guarded or cartesian.box is not None or bool(cartesian.keep_out or cartesian.cones)
    reach = [max(moved, _POINTER_M) for moved in shape.reach] if cartesian.cones else shape.reach
    return Workspace(deepest, reach) if is_guarded else None


def _joint_reading(config: ArmConfig, joint: Joint, slot: int) -> JointReading:
    device = config.slaves[slot].device
    unpack_sent, sent, factors = unpacker(
        device.rpdo, joint.axis,
        ("controlword", "target_position", "target_velocity", "target_torque", "modes_of_operation"),
    )  # fmt: skip
    unpack_received, received, actual_factors = unpacker(
        device.tpdo, joint.axis, ("statusword", "position", "modes_of_operation_display")
    )
    if sent[0] < 0 or sent[1] < 0 or min(received[:2]) < 0:
        raise ValueError(f"slave {joint.slave}: its process data are not those of a CiA 402 drive")
    word, position, velocity, torque, mode = sent
    status, actual, shown = received
    by_position, by_velocity, by_torque = factors[1:4]
    by_actual = actual_factors[1]

    def decode(outputs: bytes, inputs: bytes) -> Sample:
        out, back = unpack_sent(outputs), unpack_received(inputs)
        wanted = out[mode] if mode >= 0 else CSP
        return Sample(
            out[word] & ENABLE_OPERATION == ENABLE_OPERATION,
            out[position] * by_position,
            out[velocity] * by_velocity if velocity >= 0 else 0.0,
            out[torque] * by_torque if torque >= 0 else 0.0,
            wanted,
            back[status] & STATE_MASK == OPERATION_ENABLED,
            back[actual] * by_actual,
            back[shown] if shown >= 0 else wanted,
        )

    return JointReading(slot, decode, (abs(by_position), abs(by_velocity), abs(by_torque)))


# -- the checker ----------------------------------------------------------------------------------------------------


@dataclass
class _Commands:
    """What was commanded of one joint since it was enabled: rad, rad/s."""

    mode: int = 0
    positions: list[float] = field(default_factory=list)
    velocities: list[float] = field(default_factory=list)
    resting: int = 0
    last: float = 0.0
    """Target position of the last frame; in CST the position of the joint."""
    received: float | None = None
    """The last target that reached the drive."""


class FrameChecker:
    """Checks every frame.

    Args:
        bounds: the limits; changed in place, then reported by `changed`.
        period_s: the cycle.
        reading: how frames are read.
        expected_wkc: working counter of an exchange in which every slave took part.
        zeros: what each drive shows at its joint's zero, rad; None: all 0.

    Attributes:
        violations: at most 20.
        largest_step, largest_acceleration: relative to what is allowed.
        largest_speed: of a target, rad/s.
        frames: number of frames.
        obeyed: frames in which at least one drive was enabled and commanded to be.
        targets: last targets on the bus, rad.
        torque_off_from_ns: simulated time from which on no drive may have torque; inf: it may.
        rest_from_ns: the same of targets that move.
    """

    def __init__(
        self,
        bounds: Bounds,
        period_s: float,
        reading: Reading,
        expected_wkc: int,
        zeros: Sequence[float] | None = None,
    ) -> None:
        self.bounds = bounds
        self.violations: list[Violation] = []
        self.largest_step = self.largest_acceleration = self.largest_speed = 0.0
        self.frames = self.obeyed = 0
        count = len(reading.joints)
        self.zero = list(zeros or [0.0] * count)
        self.targets = [0.0] * count
        self.torque_off_from_ns = self.rest_from_ns = inf
        self._resting: list[float] | None = None
        """The targets at that time."""
        self.stuck_until_ns = [0] * count
        """Simulated time until which each drive shows a stuck value: its joint may be elsewhere when it is enabled."""
        self._dt = period_s
        self._joints = list(reading.joints)
        self._workspaces = reading.workspaces
        self.tool = 0
        """Number of the tool that the arm has."""
        self._expected = expected_wkc
        self._commands = [_Commands() for _ in reading.joints]
        self.samples: list[Sample] = []
        """Process data of the last frame."""
        self.is_answered = True
        """Whether every slave took part in the last exchange."""
        self._check_zones_in = 0
        self._excused = True
        """Whether the arm was enabled inside a zone and has not come out of it yet."""
        self._inconsistent = 0

    @property
    def workspace(self) -> Workspace | None:
        """Where the bodies of the arm with its tool are."""
        return self._workspaces[self.tool]

    def use(self, tool: int) -> None:
        """Take note that the arm has another tool."""
        self.tool = tool
        self._check_zones_in = 0

    def changed(self) -> None:
        """Take note that `bounds` have changed: windows do not reach back beyond this."""
        for commands in self._commands:
            del commands.positions[:-1]
            del commands.velocities[:-1]
            commands.resting = 0
        self._check_zones_in = 0

    def check(self, frame: Frame, state: State | None = None) -> None:
        """Check a frame; the statuswords that came back with it show which drives obey it.

        Args:
            frame: what was sent and received.
            state: of the machine after this cycle; None: it is not compared with the drives.
        """
        self.frames += 1
        answered, self.is_answered = self.is_answered, frame.wkc == self._expected
        obeying = enabled = 0
        homing = False
        self.samples = [joint.decode(frame.sent[joint.slot], frame.received[joint.slot]) for joint in self._joints]
        for axis, sample in enumerate(self.samples):
            commands, mode = self._commands[axis], sample.mode
            position = self.targets[axis] = sample.position - self.zero[axis]
            enabled += sample.enabled
            obeys = sample.commanded and sample.enabled
            obeying += obeys
            if not obeys or mode not in (CSP, CSV, CST):
                homing |= obeys and mode == HOMING
                if obeys and mode != HOMING:
                    self.violate(Kind.MODE, frame.now_ns, axis, float(mode), CSP, CST)
                if commands.mode:
                    self._commands[axis] = _Commands()
                continue
            if mode != sample.shown_mode:
                # Commanded to change its mode and has not yet.
                if commands.mode:
                    self._check_continued(axis, commands, position, sample.actual - self.zero[axis], mode, frame.now_ns)
                    commands.mode = CHANGING
            elif mode != commands.mode:
                self._check_entry(axis, commands, position, sample.actual - self.zero[axis], mode, frame.now_ns)
                commands = self._commands[axis] = _Commands(mode)
            elif mode == CST:
                self._check_torque(axis, sample.torque, frame.now_ns)
            else:
                self._check_position(axis, commands, position, mode, answered, frame.now_ns)
                if frame.heard:
                    self._check_received(axis, commands, position, frame.now_ns)
                if mode == CSV:
                    self._check_velocity(axis, commands, sample.velocity, answered, frame.now_ns)
            if mode != CST and commands.mode == mode and not commands.positions:
                commands.positions.append(position)
            # In CST the joint need not be at its target: the next mode continues from the joint.
            commands.last = sample.actual - self.zero[axis] if mode == CST else position
        if obeying:
            self.obeyed += 1
        self._check_stopped(obeying, frame.now_ns)
        workspace = self.workspace
        if workspace is not None:
            # By its new zero a homed joint may be anywhere.
            if obeying < len(self._joints) or homing:
                self._check_zones_in = 0
                self._excused = True
            elif all(commands.positions for commands in self._commands):
                self._check_zones(workspace, frame.now_ns)
        if state is not None and self.is_answered:
            self._check_state(state, enabled, frame.now_ns)

    def violate(self, kind: Kind, now_ns: int, axis: int, found: float, low: float, high: float) -> None:
        """Add a violation: joint from 0 or -1, value, and what is allowed."""
        if len(self.violations) < MOST_VIOLATIONS:
            self.violations.append(Violation(kind, now_ns, axis + 1, found, low, high))

    def _range(self, axis: int) -> tuple[float, float]:
        rounding = EXACT_COUNTS * self._joints[axis].resolution[0] + EXACT_RAD
        return self.bounds.low[axis] - rounding, self.bounds.high[axis] + rounding

    def _step(self, axis: int) -> float:
        return self.bounds.velocity[axis] * self._dt + self._joints[axis].resolution[0] + NUMERIC_RAD

    def _check_entry(self, axis: int, commands: _Commands, position: float, actual: float, mode: int, now: int) -> None:
        """The first target after enabling is where the joint is; the first in another mode continues the last."""
        self._check_continued(axis, commands, position, actual, mode, now)
        if mode != CSP:
            return
        excused = now < self.stuck_until_ns[axis]
        if not commands.mode and abs(position - actual) > LATCHED_RAD + NUMERIC_RAD and not excused:
            self.violate(Kind.FIRST_TARGET, now, axis, position, actual - LATCHED_RAD, actual + LATCHED_RAD)
        low, high = self._range(axis)
        if not low - MARGIN_RAD <= position <= high + MARGIN_RAD:
            self.violate(Kind.RANGE, now, axis, position, low - MARGIN_RAD, high + MARGIN_RAD)

    def _check_continued(
        self, axis: int, commands: _Commands, position: float, actual: float, mode: int, now: int
    ) -> None:
        """The first target in CSP continues the last one, or begins where a hand has moved the joint."""
        step, allowed = position - commands.last, self._step(axis)
        is_at_joint = abs(position - actual) <= LATCHED_RAD + MEASURED_STEPS * allowed
        if commands.mode and mode == CSP and abs(step) > allowed and not is_at_joint:
            self.violate(Kind.MODE_STEP, now, axis, step, -allowed, allowed)

    def _check_position(
        self, axis: int, commands: _Commands, position: float, mode: int, answered: bool, now: int
    ) -> None:
        past = commands.positions
        low, high = self._range(axis)
        last = past[-1]
        if not min(low, last) <= position <= max(high, last):
            self.violate(Kind.RANGE, now, axis, position, min(low, last), max(high, last))
        step, allowed = abs(position - last), self._step(axis)
        self.largest_step = max(self.largest_step, step / allowed)
        if step > allowed:
            self.violate(Kind.STEP, now, axis, position - last, -allowed, allowed)
        if not step:
            # Nobody received the last targets: the set-points wait, and no sample is added.
            if not answered:
                return
            commands.resting += 1
            if commands.resting > _KEPT:
                return
        else:
            commands.resting = 0
        past.append(position)
        if len(past) > _KEPT:
            del past[0]
        if mode == CSV:
            return  # the drive follows the velocities, whose changes are checked
        bound = self.bounds.acceleration[axis] * self._dt * self._dt
        count, fastest = self._joints[axis].resolution[0], self.bounds.velocity[axis]
        rounding = ROUNDING * count + NUMERIC_RAD
        newest = len(past) - 1
        for n in WINDOWS:
            if newest < n:
                break
            if n >= SPEED_WINDOW:
                # Less the rounding, which is a large part of a single step.
                speed = (abs(past[newest] - past[newest - n]) - count - NUMERIC_RAD) / (n * self._dt)
                self.largest_speed = max(self.largest_speed, speed)
                if speed > fastest:
                    self.violate(Kind.VELOCITY, now, axis, speed, -fastest, fastest)
            if newest < 2 * n:
                continue
            bend = abs(past[newest] - 2 * past[newest - n] + past[newest - 2 * n])
            allowed = bound * n * n + rounding
            if bend > allowed * self.largest_acceleration:
                self.largest_acceleration = bend / allowed
                if bend > allowed:
                    scale = 1.0 / (n * self._dt) ** 2
                    self.violate(Kind.ACCELERATION, now, axis, bend * scale, 0.0, allowed * scale)

    def _check_received(self, axis: int, commands: _Commands, position: float, now: int) -> None:
        """A drive that missed frames must not be far behind when the next one reaches it."""
        allowed, last = self._step(axis), commands.received
        if last is not None and abs(position - last) > allowed:
            self.violate(Kind.RECEIVED_STEP, now, axis, position - last, -allowed, allowed)
        commands.received = position

    def _check_velocity(self, axis: int, commands: _Commands, velocity: float, answered: bool, now: int) -> None:
        """In CSV the velocity itself is on the wire, with what pulls the joint back to its position."""
        past, count = commands.velocities, self._joints[axis].resolution[1]
        allowed = self.bounds.velocity[axis] + count
        self.largest_speed = max(self.largest_speed, abs(velocity))
        if abs(velocity) > allowed:
            self.violate(Kind.VELOCITY, now, axis, velocity, -allowed, allowed)
        if not answered:
            return
        past.append(velocity)
        if len(past) > _KEPT:
            del past[0]
        newest = len(past) - 1
        for n in WINDOWS:
            if newest < n:
                break
            change = abs(past[newest] - past[newest - n])
            allowed = self.bounds.acceleration[axis] * n * self._dt + ROUNDING * count + NUMERIC_RAD
            self.largest_acceleration = max(self.largest_acceleration, change / allowed)
            if change > allowed:
                scale = 1.0 / (n * self._dt)
                self.violate(Kind.VELOCITY_STEP, now, axis, change * scale, 0.0, allowed * scale)

    def _check_torque(self, axis: int, torque: float, now: int) -> None:
        allowed = self.bounds.torque[axis] + self._joints[axis].resolution[2]
        if abs(torque) > allowed:
            self.violate(Kind.TORQUE, now, axis, torque, -allowed, allowed)

    def _check_zones(self, workspace: Workspace, now: int) -> None:
        self._check_zones_in -= 1
        if self._check_zones_in > 0:
            return
        bounds = self.bounds
        deepest = workspace.deepest(bounds, [commands.positions[-1] for commands in self._commands])
        if deepest > ZONE_TOLERANCE_M and self._excused:
            # The arm was enabled in there: it is checked once it is out.
            self._check_zones_in = 1
            return
        self._excused = False
        if deepest > ZONE_TOLERANCE_M:
            self.violate(Kind.ZONE, now, -1, deepest, -inf, ZONE_TOLERANCE_M)
            self._check_zones_in = 50
            return
        # No body is nearer than -deepest: the next check is due when one may have moved that far.
        fastest = sum(v * reach for v, reach in zip(bounds.velocity, workspace.reach, strict=False)) * self._dt
        self._check_zones_in = int(-deepest / fastest)

    def _check_stopped(self, obeying: int, now: int) -> None:
        if obeying and now > self.torque_off_from_ns:
            self.violate(Kind.NOT_STOPPED, now, -1, float(obeying), 0.0, 0.0)
        if now <= self.rest_from_ns:
            self._resting = None
        elif self._resting is None:
            self._resting = list(self.targets)
        else:
            moved = sum(
                commands.mode in (CSP, CSV) and abs(target - rest) > MOVED_RAD
                for commands, target, rest in zip(self._commands, self.targets, self._resting, strict=True)
            )
            if moved:
                self.violate(Kind.NOT_STOPPED, now, -1, float(moved), 0.0, 0.0)

    def _check_state(self, state: State, enabled: int, now: int) -> None:
        """The machine must know which drives have torque; it may take a moment to notice a change."""
        wrong = enabled > 0 if state in _WITHOUT_TORQUE else state in _WITH_TORQUE and enabled < len(self._joints)
        self._inconsistent = self._inconsistent + 1 if wrong else 0
        if self._inconsistent * self._dt > INCONSISTENT_S:
            self._inconsistent = 0
            kind = Kind.TORQUE_IN_STATE if enabled and state in _WITHOUT_TORQUE else Kind.NO_TORQUE_IN_STATE
            self.violate(kind, now, -1, float(state), -inf, inf)
