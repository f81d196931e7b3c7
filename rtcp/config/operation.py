"""How the arm is operated: Cartesian limits and keep-out boxes, jogging, what is watched, terminals with a meaning.

As `model`, this module imports nothing heavy. Lengths in m, angles in rad, times in s unless a name says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

Positive = Annotated[float, Gt(0)]
NotNegative = Annotated[float, Ge(0)]
Name = Annotated[str, MinLen(1), MaxLen(64)]
Coordinate = Annotated[float, Ge(-100), Le(100)]
Corner = Annotated[tuple[Coordinate, ...], MinLen(3), MaxLen(3)]
MotionName = Literal["joint", "cartesian", "joystick", "velocity", "torque"]
"""What the arm takes commands for: `joint` and `cartesian` alike take moves, lines, files and streams (auto), the
others only their own; `cartesian` alone lets a plain `rtcp move` run on a straight line."""
FrameName = Literal["base", "tool"]


@dataclass(frozen=True)
class Box:
    """A box along the base's axes: the tool stays inside it. `min < max` in each coordinate."""

    min: Corner
    max: Corner


@dataclass(frozen=True)
class KeepOut:
    """A box that neither tool nor wrist nor elbow may enter: the user, the chair."""

    name: Name
    min: Corner
    max: Corner


@dataclass(frozen=True)
class SingularityLimits:
    """So near to a singularity Cartesian modes come; 0 switches a limit off."""

    shoulder: NotNegative = 0.03
    """m, of the wrist centre from axis 1."""
    elbow: NotNegative = 0.08
    """rad, of the bend from stretched or folded."""
    wrist: NotNegative = 0.08
    """rad, of joint 5 from axes 4 and 6 in one line."""


@dataclass(frozen=True)
class CartesianConfig:
    """What the tool may do: everywhere for the boxes, in Cartesian modes for speeds and singularities."""

    speed: Annotated[float, Gt(0), Le(0.25)] = 0.25
    """m/s; under manual control at most 0.25 (ISO 10218-1)."""
    acceleration: Positive = 0.5
    jerk: Positive = 5.0
    angular_speed: Annotated[float, Gt(0), Le(2)] = 0.5
    angular_acceleration: Positive = 1.0
    angular_jerk: Positive = 10.0
    box: Box | None = None
    keep_out: tuple[KeepOut, ...] = ()
    singularity: SingularityLimits = field(default_factory=SingularityLimits)


@dataclass(frozen=True)
class JogConfig:
    """The stick's speeds and the frame that its directions are those of."""

    speed: Annotated[float, Gt(0), Le(0.25)] = 0.1
    angular_speed: Annotated[float, Gt(0), Le(2)] = 0.3
    frame: FrameName = "base"


@dataclass(frozen=True)
class WatchConfig:
    """What is measured against its limit: so many cycles in a row beyond it lead to the emergency stop."""

    cycles: Annotated[int, Ge(1), Le(1000)] = 5
    speed: Annotated[float, Ge(1), Le(10)] = 1.5
    """Times a joint's velocity limit."""
    torque: Annotated[float, Ge(1), Le(10)] = 1.5
    """Times a joint's torque limit."""
    following_error: Annotated[float, Gt(0), Le(1)] = 0.15
    """rad, of the joint from where it was commanded."""


@dataclass(frozen=True)
class InputConfig:
    """An input terminal of the IO box with a meaning."""

    number: Annotated[int, Ge(1), Le(16)]
    active: Literal["high", "low"] = "high"
    """The level that means what the input is named after."""
    debounce_ms: Annotated[float, Ge(0), Le(1000)] = 5.0


@dataclass(frozen=True)
class EmergencyStopConfig(InputConfig):
    """The emergency stop's input: nobody guesses its level, for the wrong one could not be seen before it is needed."""

    active: Literal["high", "low"] = field()
    """`low` for a normally closed contact, where a cut wire stops the arm too."""


@dataclass(frozen=True)
class JoystickConfig:
    """The terminals of the stick, inputs 1 to 16; all active low through pull-ups, or all active high."""

    forward: Annotated[int, Ge(1), Le(16)] = 1
    backward: Annotated[int, Ge(1), Le(16)] = 2
    left: Annotated[int, Ge(1), Le(16)] = 3
    right: Annotated[int, Ge(1), Le(16)] = 4
    mode_up: Annotated[int, Ge(1), Le(16)] = 5
    mode_down: Annotated[int, Ge(1), Le(16)] = 6
    active: Literal["high", "low"] = "low"
    debounce_ms: Annotated[float, Ge(0), Le(1000)] = 5.0


@dataclass(frozen=True)
class InputsConfig:
    """Inputs with a meaning; what is left out is not there."""

    joystick: JoystickConfig | None = None
    arm_toggle: InputConfig | None = None
    """Active: the stick is the arm's; else it is the wheelchair's and the arm holds still."""
    enabling_switch: InputConfig | None = None
    """Active: motion is allowed. Letting go stops; pressing again moves nothing until a new command."""
    emergency_stop: EmergencyStopConfig | None = None
    """Active: pressed."""


@dataclass(frozen=True)
class OutputsConfig:
    """Outputs with a meaning, by number; what is left out is not there."""

    state_lamp: Annotated[int, Ge(1), Le(16)] | None = None
    """On while drives have torque."""
    motion_lamp: Annotated[int, Ge(1), Le(16)] | None = None
    """On while the arm moves."""
    heartbeat: Annotated[int, Ge(1), Le(16)] | None = None
    """Toggled each cycle, for the oscilloscope."""
