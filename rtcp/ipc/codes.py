"""Numbers that cross the blackboard: commands, refusals, events, motion modes. `rtcp.ipc.messages` says them."""

from __future__ import annotations

from enum import IntEnum


class Command(IntEnum):
    """What a commander may ask; numbers of the command ring."""

    ENABLE = 1
    DISABLE = 2
    RESET = 3
    MODE = 4
    """[drive mode]: the cyclic synchronous mode that the set-points reach the drives in."""
    MOVE = 5
    """[q .., at -2: 1 for each joint at its best, at -1: speed, rad/s]"""
    STOP = 6
    OUTPUT = 7
    """[number, 0 or 1]"""
    SHUTDOWN = 8
    MOTION = 9
    """[`MotionMode`]: what the arm takes commands for."""
    TRAJECTORY = 10
    """[slot, waypoints]"""
    LINE = 11
    """[slot, pieces]"""
    STREAM = 12
    """[q .., at -1: the sender's time stamp, s]"""
    JOG = 13
    """[six speeds, at -2: `JogFrame`, at -1: for how long it counts, s]"""
    VELOCITY = 14
    """[joint speeds .., at -1: for how long it counts, s]"""
    TORQUE = 15
    """[joint torques .., at -3 and -2: the parts of the joints' stiffness and damping (0 to 1), at -1: how long, s]"""
    LIMITS = 16
    """[slot, rows]"""
    GRIPPER = 17
    """[0 close, 1 open]"""
    ZERO = 18
    """[axis, offset rad]"""
    HOME = 19
    """[axis]"""


class MotionMode(IntEnum):
    """What the arm takes commands for."""

    JOINT = 1
    CARTESIAN = 2
    JOYSTICK = 3
    VELOCITY = 4
    TORQUE = 5


class JogFrame(IntEnum):
    """What the six speeds of a jog are along."""

    BASE = 0
    TOOL = 1
    JOINTS = 2


class Refusal(IntEnum):
    """Why a command was refused."""

    NONE = 0
    NOT_IN_THIS_STATE = 1
    NO_LEASE = 2
    POSITION_LIMIT = 3
    NOT_A_NUMBER = 4
    SPEED = 5
    MODE = 6
    OUTSIDE_LIMITS = 7
    OUTPUT = 8
    NO_OUTPUTS = 9
    UNKNOWN = 10
    NOT_IN_OP = 11
    SWITCHING = 12
    NOT_STILL = 13
    CLOCK = 14
    NO_PLAN = 15
    OUTPUT_VALUE = 16
    MOTION = 17
    """No motion mode of that number."""
    OTHER_MOTION = 18
    """The arm takes commands of another kind; axis: the motion mode that it is in, value: the one that is needed."""
    NO_GEOMETRY = 19
    PRESSED = 20
    """The emergency stop is pressed."""
    NOT_PERMITTED = 21
    """The enabling switch is not pressed."""
    BAD_PLAN = 22
    """axis: row, value: column; limit: what was found."""
    PLAN_START = 23
    """The plan does not begin where the arm is: axis, value planned, limit: commanded."""
    TORQUE_LIMIT = 24
    HOLD_TIME = 25
    LIMITS_OUTSIDE = 26
    """The arm would be outside the new limits; axis: joint or -1 for the boxes."""
    LIMITS_WRONG = 27
    NO_GRIPPER = 28
    MEANT = 29
    """The output has a meaning of its own."""
    AXIS = 30
    OFFSET = 31
    JOG_SPEED = 32
    STREAM_DROPPED = 33
    """Late or out of order; value: how late, s."""
    ZONE = 34
    """The target lies in a keep-out box or outside the Cartesian box."""
    LIMITS_NARROW = 35
    """Beyond what the configuration allows; axis, value found, limit allowed."""
    HAS_TORQUE = 36
    PLAN_SPEED = 37
    """The plan begins at time 0 with another speed than the arm has."""
    IMPEDANCE = 39
    HOME_MODE = 40
    JOG_FRAME = 41
    GRIPPER_RESTS = 42
    """The gripper's drive is not enabled."""
    PLAN_LEAD = 38
    """No way leads from where the arm is to the plan's first point."""
    JOINT_SPEED = 45
    LIMITS_WEAK = 44
    """The joint holds more than its new torque limit; axis, value held, limit, Nm."""
    PLAN_MOVING = 43
    """Lines begin at rest; axis: the first joint that moves, value: its speed, rad/s."""


class Code(IntEnum):
    """What happened; the events of the blackboard."""

    NONE = 0
    BUS_LOST = 1
    DRIVE_LEFT_ENABLED = 2
    ENABLE_STUCK = 3
    DISABLE_STUCK = 4
    SLAVE_NOT_OP = 5
    RESET_STUCK = 6
    GENERATOR = 7
    MODE_STUCK = 8
    LEASE_ENDED = 9
    READY = 10
    ENABLED = 11
    DISABLED = 12
    RESET = 13
    ARRIVED = 14
    STOPPED = 15
    DC_LOCKED = 16
    DC_UNLOCKED = 17
    DRIVE_FAULT = 18
    CLOCK_LOST = 19
    LEFT_RANGE = 20
    TORQUE_OFF = 21
    RESET_MOVING = 22
    PRESSED = 23
    """The emergency stop was pressed."""
    OVER_SPEED = 24
    OVER_TORQUE = 25
    FOLLOWING_ERROR = 26
    PARKED = 27
    """After an emergency stop: torque off, slaves in PRE-OP."""
    NOT_PERMITTED = 28
    """The enabling switch was let go."""
    STICK_TAKEN = 29
    """The toggle gave the stick to the chair."""
    MOTION = 30
    LIMITS = 31
    RELEASED = 32
    """A stop by a limit was reset: the arm holds and takes commands again."""
    GRIPPER = 33
    ZERO = 34
    HOMED = 35
    HOMING_FAILED = 36
    STICK_MODE = 37
    HOMING_RUNNING = 39
    """The drive does not come to rest after a homing that was stopped or has failed; value: its speed, rad/s."""
    HOMING_ZONE = 42
    """A homing was stopped where the arm would be in a box by the drive's old zero; axis: the box."""
    STANDS_IN = 41
    """Enabled beyond the bounds of a box; axis: the box, value: its distance, m, less than 0."""
    GRIPPER_AT = 40
    """A gripper with a drive came to rest; value: position, rad, limit: 1 where it holds something."""
    POSITION_JUMPED = 43
    """While being enabled; axis, value: where the drive says it is, limit: where it was followed to, rad."""
    LED_BACK = 44
    """Enabled a little beyond its range; axis, value: how far, rad, limit: how fast it is led back, rad/s."""
    BUTTON_UNHEARD = 46
    """In a fault the IO box has been out of OP for too long; value: s."""
    CAME_OUT = 38
    """The stick's code was none, or came back to one."""
    STANDS_ELSEWHERE = 45
    """After a reset; axis, value: where the joint stands, limit: where it was last heard before the fault, rad."""
    ENDED = 100
    """ENDED + `Reason`: a mode or a guard ended the motion."""


class Reason(IntEnum):
    """Why a mode ended a motion by itself, or slows it; `rtcp.ipc.messages` says it."""

    NONE = 0
    STREAM_ENDED = 1
    """The sender fell silent."""
    NO_SOLUTION = 2
    """No inverse solution continues the motion: out of reach."""
    JOINT_LIMIT = 3
    """A joint's range ends the motion; `axis`."""
    SINGULARITY = 4
    """`axis`: 0 shoulder, 1 elbow, 2 wrist."""
    CODE = 5
    """The stick shows what is no code; `value`: the byte."""
    PLAN = 6
    """The plan in memory is damaged."""
    KEEP_OUT = 7
    """`axis`: which box, by its place in the configuration; -1: the Cartesian box."""
    JUMP = 8
    """The set-points would have had to jump."""
    COMMAND_ENDED = 9
    """A command that has to be renewed was not."""
    GENERATOR = 10
    """The trajectory generator refused its input: a defect."""
