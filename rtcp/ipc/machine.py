"""The machine's states, what happens in them and what leads from one to another: one table; the loop walks it.

`docs/machine.md` is made from it by `docs/generate.py`. Names of codes: `rtcp.ipc.codes`.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from rtcp.ipc.codes import Code, Command, Refusal

__all__ = ["ALLOWED", "TABLE", "WITHOUT_LEASE", "WITH_TORQUE", "Code", "Command", "Event", "Refusal", "Row", "State"]


class State(IntEnum):
    """What the arm is doing, as the loop knows it."""

    OFF = 0
    STARTING = 1
    READY = 2
    ENABLING = 3
    HOLDING = 4
    MOVING = 5
    STOPPING = 6
    DISABLING = 7
    FAULT = 8
    RESETTING = 9
    CLOSING = 10
    STOPPED_BY_LIMIT = 11
    EMERGENCY_STOP = 12
    HOMING = 13


class Event(IntEnum):
    """What leads from one state to another."""

    START = 1
    """The loop's process begins its cycle."""
    ALL_IN_OP = 2
    """Every slave is in OP and the reference clock is followed."""
    ENABLE = 3
    ENABLED = 4
    """Every drive shows Operation Enabled, in the mode that was asked for."""
    MOTION = 5
    """A move, a line, a trajectory, a stream, a speed, a torque, the stick."""
    ARRIVED = 6
    """The mode has come to its end and the set-points stand."""
    STOP = 7
    """Asked for, or the lease ended, the enabling switch was let go, the stick was given to the chair."""
    STOPPED = 8
    GUARD = 9
    """A guard, or the mode itself, has ended the motion: it could not go on without passing a limit."""
    LIMIT_STOPPED = 10
    """The stop that a guard began has come to rest."""
    DISABLE = 11
    DISABLED = 12
    BROKEN = 13
    """Something was lost or broke (frames, a slave, a drive, the clock), or an event's rung is more than a controlled
    stop."""
    EMERGENCY = 14
    """The emergency stop is pressed, or something measured was beyond its limit for too long."""
    RESET = 15
    RESET_DONE = 16
    RESET_FAILED = 17
    SHUTDOWN = 18
    ENDED = 19
    HOME = 20
    HOMED = 21
    WAVERS = 22
    """The clock was lost and its rung is a controlled stop: a fault follows at standstill. Disabling goes on to its end
    first."""


class Row(NamedTuple):
    """A state: its name in words, what the drives are commanded, which commands it takes, how it is left."""

    words: str
    commands: str
    takes: frozenset[Command]
    left_by: dict[Event, State]


_ANYWHERE = frozenset({Command.SHUTDOWN})
_READY = _ANYWHERE | {Command.DISABLE, Command.OUTPUT, Command.GRIPPER, Command.LIMITS}
_MOVES = frozenset(
    {
        Command.MOVE,
        Command.TRAJECTORY,
        Command.LINE,
        Command.STREAM,
        Command.JOG,
        Command.VELOCITY,
        Command.TORQUE,
    }
)
_BROKEN = {Event.BROKEN: State.FAULT, Event.EMERGENCY: State.EMERGENCY_STOP, Event.SHUTDOWN: State.CLOSING}
_TORQUE = _BROKEN | {Event.DISABLE: State.DISABLING}
_WAVERS = {Event.WAVERS: State.STOPPING}

TABLE: dict[State, Row] = {
    State.OFF: Row(
        "off", "no frames; the drives' watchdog has stopped them", frozenset(), {Event.START: State.STARTING}
    ),
    State.STARTING: Row(
        "starting",
        "drives disabled; targets follow the actual positions",
        _ANYWHERE,
        {Event.ALL_IN_OP: State.READY, Event.BROKEN: State.FAULT, Event.SHUTDOWN: State.CLOSING},
    ),
    State.READY: Row(
        "ready",
        "drives disabled; targets follow the actual positions",
        _READY | {Command.ENABLE, Command.MODE, Command.MOTION, Command.ZERO},
        _BROKEN | {Event.ENABLE: State.ENABLING},
    ),
    State.ENABLING: Row(
        "enabling",
        "drives led to Operation Enabled, target = actual until each is there",
        _ANYWHERE | {Command.DISABLE, Command.OUTPUT},
        _TORQUE | {Event.ENABLED: State.HOLDING},
    ),
    State.HOLDING: Row(
        "holding",
        "the last set-points, unchanged",
        _READY | _MOVES | {Command.MODE, Command.MOTION, Command.STOP, Command.HOME},
        _TORQUE | _WAVERS | {Event.MOTION: State.MOVING, Event.GUARD: State.STOPPING, Event.HOME: State.HOMING},
    ),
    State.MOVING: Row(
        "moving",
        "the set-points of the active mode, after the guards",
        _READY | _MOVES | {Command.STOP},
        _TORQUE
        | _WAVERS
        | {
            Event.MOTION: State.MOVING,
            Event.ARRIVED: State.HOLDING,
            Event.STOP: State.STOPPING,
            Event.GUARD: State.STOPPING,
        },
    ),
    State.STOPPING: Row(
        "stopping",
        "down to standstill under the limits of acceleration",
        _ANYWHERE | {Command.DISABLE, Command.OUTPUT, Command.STOP, Command.GRIPPER},
        _TORQUE
        | _WAVERS
        | {
            Event.STOPPED: State.HOLDING,
            Event.LIMIT_STOPPED: State.STOPPED_BY_LIMIT,
            Event.GUARD: State.STOPPING,
        },
    ),
    State.STOPPED_BY_LIMIT: Row(
        "stopped by limit",
        "the set-points at which it came to rest, unchanged",
        _READY | {Command.STOP, Command.RESET},
        _TORQUE | {Event.RESET: State.HOLDING},
    ),
    State.HOMING: Row(
        "homing",
        "one drive homes by itself (mode 6), the others hold",
        _ANYWHERE | {Command.DISABLE, Command.OUTPUT, Command.STOP},
        _TORQUE | {Event.HOMED: State.HOLDING, Event.STOPPED: State.HOLDING},
    ),
    State.DISABLING: Row(
        "disabling",
        "a controlled stop first; then drives led to Switch On Disabled, brakes closed",
        _ANYWHERE | {Command.DISABLE},
        _BROKEN | {Event.DISABLED: State.READY},
    ),
    State.FAULT: Row(
        "fault",
        "quick stop: each drive ramps down by itself and holds (0x605A = 6), or torque off where `stops` says so; "
        "whether or not frames come back",
        _ANYWHERE | {Command.DISABLE, Command.OUTPUT, Command.RESET, Command.LIMITS},
        {
            Event.RESET: State.RESETTING,
            Event.DISABLE: State.FAULT,
            Event.EMERGENCY: State.EMERGENCY_STOP,
            Event.SHUTDOWN: State.CLOSING,
        },
    ),
    State.EMERGENCY_STOP: Row(
        "emergency stop",
        "quick stop, at standstill torque off and brakes closed, or torque off at once where `stops` says so; then the "
        "slaves to PRE-OP",
        _ANYWHERE | {Command.DISABLE, Command.RESET, Command.LIMITS},
        {Event.RESET: State.RESETTING, Event.DISABLE: State.EMERGENCY_STOP, Event.SHUTDOWN: State.CLOSING},
    ),
    State.RESETTING: Row(
        "resetting",
        "slaves brought back to OP, drive faults reset, drives disabled",
        _ANYWHERE | {Command.DISABLE},
        {
            Event.RESET_DONE: State.READY,
            Event.RESET_FAILED: State.FAULT,
            Event.BROKEN: State.FAULT,
            Event.DISABLE: State.FAULT,
            Event.EMERGENCY: State.EMERGENCY_STOP,
            Event.SHUTDOWN: State.CLOSING,
        },
    ),
    State.CLOSING: Row(
        "closing",
        "a controlled stop, drives disabled; then INIT",
        _ANYWHERE,
        {Event.SHUTDOWN: State.CLOSING, Event.ENDED: State.OFF},
    ),
}

ALLOWED: dict[Command, frozenset[State]] = {
    command: frozenset(state for state, row in TABLE.items() if command in row.takes) for command in Command
}
"""In which states each command is taken."""

WITHOUT_LEASE = frozenset({Command.DISABLE, Command.STOP, Command.SHUTDOWN})
"""Commands that only make the arm safer: anyone may give them at any time."""

WITH_TORQUE = frozenset(
    {
        State.ENABLING,
        State.HOLDING,
        State.MOVING,
        State.STOPPING,
        State.STOPPED_BY_LIMIT,
        State.HOMING,
        State.DISABLING,
    }
)
"""States in which drives may have torque and obey targets: an emergency is met by a quick stop."""
