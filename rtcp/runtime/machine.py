"""The machine's state: what it may be, what it is asked, how it answers. Tables; the loop walks them."""

from __future__ import annotations

from enum import IntEnum


class State(IntEnum):
    """What the arm is doing, as the loop knows it."""

    STARTING = 1
    """The cycle runs, slaves are on their way to OP, the reference clock is not yet followed."""
    READY = 2
    """Slaves in OP, drives without torque."""
    ENABLING = 3
    HOLDING = 4
    MOVING = 5
    STOPPING = 6
    """A controlled stop: down to standstill under the limits, then holding."""
    DISABLING = 7
    FAULT = 8
    """Something was lost or broke. Every drive is told to quick-stop and hold; nothing moves until reset."""
    RESETTING = 9
    CLOSING = 10
    """On the way out: stop, disable, INIT."""


class Command(IntEnum):
    """What a commander may ask; numbers of the command ring."""

    ENABLE = 1
    DISABLE = 2
    RESET = 3
    MODE = 4
    MOVE = 5
    STOP = 6
    OUTPUT = 7
    SHUTDOWN = 8


class Refusal(IntEnum):
    """Why a command was refused; `rtcp.runtime.sentences` says it."""

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


ALLOWED: dict[Command, frozenset[State]] = {
    Command.ENABLE: frozenset({State.READY}),
    Command.DISABLE: frozenset(State) - {State.STARTING, State.CLOSING},
    Command.RESET: frozenset({State.FAULT}),
    Command.MODE: frozenset({State.READY, State.HOLDING}),
    Command.MOVE: frozenset({State.HOLDING, State.MOVING}),
    Command.STOP: frozenset({State.HOLDING, State.MOVING, State.STOPPING}),
    Command.OUTPUT: frozenset({State.READY, State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.FAULT}),
    Command.SHUTDOWN: frozenset(State),
}
"""In which states each command is taken."""

WITHOUT_LEASE = frozenset({Command.DISABLE, Command.STOP, Command.SHUTDOWN})
"""Commands that only make the arm safer: anyone may give them at any time."""
