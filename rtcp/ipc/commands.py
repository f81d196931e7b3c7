"""The commands that the loop accepts: one frozen dataclass each, its fields in SI, and the states that accept it.

A command crosses the ring of the blackboard as bytes (`rtcp.ipc.message`). On the control socket it is a JSON-RPC
method of the same name unless it needs planning first (`docs/protocol.md`). A package outside registers its own by
subclassing; the controller or handler that names a command receives it.
"""

from __future__ import annotations

from math import nan
from typing import ClassVar

from rtcp.ipc.message import Joints, Kinds, Message
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State

ANYWHERE = frozenset(State) - {State.OFF}
AT_REST = frozenset({State.READY, State.HOLDING})
CALM = AT_REST | {State.MOVING, State.STOPPED_BY_LIMIT}
MOTION = frozenset({State.HOLDING, State.MOVING})


class Command(Message, abstract=True):
    """Base of all commands."""

    kinds: ClassVar[Kinds[Command]] = Kinds()
    states: ClassVar[frozenset[State]]
    """States in which it is accepted."""
    needs_lease: ClassVar[bool] = True
    """False for commands that only make the arm safer: anyone may send them at any time."""
    waits_for_drive_mode: ClassVar[bool] = False
    """Whether it is refused while the drives change their mode."""
    superseded_by_stop: ClassVar[bool] = True
    """Whether it is refused when a stop was requested after it. False for commands that set nothing in motion."""


class MotionCommand(Command, abstract=True):
    """Base of the commands of motion controllers (`rtcp.motion.controllers`).

    A command with the field `hold_s` expires after that time; default on the control socket: 0.25 s.
    """

    states = MOTION
    waits_for_drive_mode = True
    renewed: ClassVar[bool] = False
    """Whether it lasts for its hold time, or as long as more of its kind arrive; else it ends by itself."""


class ProcessCommand(Command, abstract=True):
    """Base of the commands of processes (`rtcp.processes`).

    A command lasts while the field `busy` of the process is not 0, and ends with its commander's lease.
    """

    states = AT_REST | {State.MOVING}


COMMANDS = Command.kinds


class Enable(Command):
    """Bring all drives to Operation Enabled."""

    states = frozenset({State.READY})


class Disable(Command):
    """Stop, then take the torque off. In a fault: take the torque off at once."""

    states = ANYWHERE - {State.STARTING, State.CLOSING}
    superseded_by_stop = False
    needs_lease = False


class Reset(Command):
    """Leave a fault, an emergency stop, or a stop by a limit."""

    states = frozenset({State.STOPPED_BY_LIMIT, State.FAULT, State.EMERGENCY_STOP})
    superseded_by_stop = False


class SetDriveMode(Command):
    """Change the cyclic synchronous mode of the drives."""

    states = AT_REST
    superseded_by_stop = False
    waits_for_drive_mode = True
    mode: DriveMode


class SetControlMode(Command):
    """Change which motion commands the arm accepts."""

    states = AT_REST
    superseded_by_stop = False
    waits_for_drive_mode = True
    mode: ControlMode


class Halt(Command):
    """Bring all axes to rest and processes into their safe state; the drives stay enabled.

    While drives are enabled, and while a joint returns to its range after its homing, the drives are disabled: with
    torque the joint would return. Without torque it is accepted too, and nothing moves.
    """

    states = ANYWHERE - {State.STARTING, State.FAULT, State.EMERGENCY_STOP, State.RESETTING, State.CLOSING}
    superseded_by_stop = False
    needs_lease = False


class Shutdown(Command):
    """Stop, disable and end the loop; the end of its process is the answer."""

    states = ANYWHERE
    superseded_by_stop = False
    needs_lease = False


class SetOutput(Command):
    """Set a digital output of the IO box."""

    states = CALM | {State.ENABLING, State.STOPPING, State.HOMING, State.FAULT}
    output: int
    """From 1."""
    value: bool
    box: int = 0
    """Index among the IO boxes, in the order of the cable."""


class SetChannel(Command):
    """Set an output channel of an analog, encoder or generic slave."""

    states = CALM | {State.ENABLING, State.STOPPING, State.HOMING}
    slave: int
    """Position on the cable, from 1."""
    channel: int
    """Its place among the output channels of the slave, from 0; padding does not count."""
    value: float
    """In the unit of the channel."""


class MoveGripper(Command):
    """Open or close the gripper."""

    states = CALM | {State.STOPPING}
    open: bool


class MoveAxis(Command):
    """Move an external axis to a position by its drive's profile."""

    states = CALM | {State.STOPPING}
    axis: int
    """Its number among all axes: joints, the gripper's, external ones."""
    position: float
    """m or rad."""
    speed: float = 0.0
    """m/s or rad/s; 0: its speed limit."""


LONGEST_RUN_S = 3600.0
"""Longest run of an external axis by one command, s."""


class RunAxis(Command):
    """Run an external axis at a velocity for `hold_s`."""

    states = CALM | {State.STOPPING}
    axis: int
    velocity: float
    """m/s or rad/s."""
    hold_s: float


class HomeAxis(Command):
    """Search the home of an external axis (mode of operation 6)."""

    states = CALM | {State.STOPPING}
    axis: int
    home_offset: float = nan
    """As of `Home`, m or rad."""


class StopAxis(Command):
    """Halt an external axis; its drive stays enabled."""

    states = ANYWHERE
    superseded_by_stop = False
    needs_lease = False
    axis: int


class SetLimits(Command):
    """Replace the limits by those of a slot of the plan area, all or none."""

    states = CALM | {State.FAULT, State.EMERGENCY_STOP}
    superseded_by_stop = False
    slot: int
    rows: int
    widen: bool = False
    """Whether they may be wider than the configured ones, up to the absolute ones; only without torque."""


class SetSpeedOverride(Command):
    """Move at a fraction of the speed from now on, 0.01 to 1. Anyone may lower it; raising it takes the lease."""

    states = ANYWHERE
    superseded_by_stop = False
    needs_lease = False
    fraction: float


class Pause(Command):
    """Bring the motion under way to rest on its path; all that ends a motion also ends a paused one."""

    states = frozenset({State.MOVING})
    superseded_by_stop = False
    needs_lease = False


class Resume(Command):
    """Continue the motion that is paused, by its lease."""

    states = frozenset({State.MOVING})


class SetTool(Command):
    """Use another tool, without a payload."""

    states = AT_REST
    superseded_by_stop = False
    waits_for_drive_mode = True
    tool: int
    """Its number, from 0, in the order of `kinematics.tools`."""


class SetPayload(Command):
    """Set the payload, whose weight the arm carries: its mass, kg, and its centre in the frame of the tool, m."""

    states = AT_REST
    superseded_by_stop = False
    waits_for_drive_mode = True
    mass: float
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class SetZero(Command):
    """Set the zero offset of an axis: the position of its drive at the axis' zero."""

    states = frozenset({State.READY})
    superseded_by_stop = False
    axis: int
    offset: float
    """rad"""


class Home(Command):
    """Run the homing of one drive (mode of operation 6)."""

    states = frozenset({State.HOLDING})
    waits_for_drive_mode = True
    axis: int
    home_offset: float = nan
    """What the drive must show at its home (0x607C), rad; NaN: not known, and not compared."""


# -- motion commands: each is accepted by the controller that names it ------------------------------------------------


class MoveJoints(MotionCommand):
    """Move to joint positions, rad, at most at `speed`, rad/s."""

    q: Joints
    speed: float
    synchronized: bool
    """All joints arrive together; else each as soon as it can."""


class RunTrajectory(MotionCommand):
    """Run the trajectory in a slot of the plan area."""

    slot: int
    rows: int
    open: bool = False
    """Whether more rows follow (`ExtendTrajectory`): each replaces one that has been passed."""
    tool: int = 0
    """Number of the tool for which it was planned: refused with another one in use."""


class ExtendTrajectory(MotionCommand):
    """Set the number of rows of the open trajectory under way, and whether it ends with them."""

    states = frozenset({State.MOVING})
    rows: int
    ends: bool


class RunInStep(MotionCommand):
    """Run the trajectory in a slot of the plan area from a common instant on, in step with partners of the cell."""

    slot: int
    rows: int
    motion: int
    """Number of the motion, the same for all its arms, greater than 0."""
    partners: int
    """The partners that take part, a bit each, in the order of the cell; 0: this arm alone."""
    start_ns: int
    """CLOCK_MONOTONIC at which it begins."""
    brakes: int
    """Count of numbers after the rows: times for the whole group to brake, s, at every `brake_step_s` of the path."""
    brake_step_s: float
    tool: int = 0
    """As of `RunTrajectory`."""


class RunLines(MotionCommand):
    """Run the straight lines in a slot of the plan area."""

    slot: int
    rows: int
    tool: int = 0
    """As of `RunTrajectory`."""


class StreamPosition(MotionCommand):
    """Send the next position of a stream."""

    renewed = True
    q: Joints
    """rad"""
    stamp_s: float
    """Clock of the sender, s."""


class OpenStream(MotionCommand):
    """Begin a stream whose setpoints come through shared memory (`rtcp.Stream`)."""

    states = frozenset({State.HOLDING})
    renewed = True
    stream: int
    """Its number, greater than 0."""
    motion: int = 0
    """Number of the motion in step, the same for all its arms; 0: this arm alone."""
    partners: int = 0
    """The partners that take part, a bit each, in the order of the cell."""


class Jog(MotionCommand):
    """Move the tool with velocities along and about the axes of a frame, or the joints, for `hold_s`."""

    renewed = True
    velocity: Joints
    """Tool: x y z, m/s, rx ry rz, rad/s. Joints: rad/s."""
    frame: JogFrame
    hold_s: float


class MoveAtVelocity(MotionCommand):
    """Move the joints at velocities, rad/s, for `hold_s`."""

    renewed = True
    velocity: Joints
    hold_s: float


class ApplyTorque(MotionCommand):
    """Add joint torques, Nm, to those that carry the weight of the arm, for `hold_s`."""

    renewed = True
    torque: Joints
    stiffness: float
    """Fraction, 0 to 1, of each joint's `cst_stiffness`."""
    damping: float
    """Fraction, 0 to 1, of each joint's `cst_damping`."""
    hold_s: float


class Guide(MotionCommand):
    """Let the arm be guided by hand: it carries its weight, and follows within its limits."""

    states = frozenset({State.HOLDING})
    duration_s: float = 0.0
    """s, at most 3600; 0: until it is halted, or 3600 s."""
