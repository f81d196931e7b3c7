"""The file of a virtual IRC5 (`config/irc5.yaml`): its panel and its mechanical units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

from rtcp.config.document import Finding, read
from rtcp.config.numbers import Name, NotNegative, Positive
from rtcp.config.validation import Checker, rule

MOST_UNITS = 4
PositionDelay = Annotated[float, Ge(-0.01), Le(1.0)]


@dataclass(frozen=True)
class EgmConfig:
    """What EGMSetupUC, EGMActJoint, EGMRunJoint and MOC.cfg set; defaults are ABB's but where it is said."""

    position_gain: Annotated[float, Ge(0), Le(20)] = 5.0
    """Default Proportional Position Gain k, 1/s."""
    pos_corr_gain: Annotated[float, Ge(0), Le(1)] = 1.0
    """Factor on k; 0: speed references alone."""
    low_pass_hz: Annotated[float, Ge(0), Le(100)] = 20.0
    """Cutoff of the low pass on the speed contribution, Hz; 0: none."""
    max_pos_deviation: Positive = 1000.0
    """Largest distance of a joint from where the session began, degrees."""
    max_speed_deviation: Positive = 1.0
    """Largest speed of a joint, degrees/s."""
    ramp_in_s: NotNegative = 0.0
    """Time in which the contribution grows to its full size (RampInTime), s."""
    ramp_s: Annotated[float, Ge(0.005), Le(10)] = 0.5
    """Time to rest when a motion is ended (Default Ramp Time), s."""
    convergence_window: Positive = 0.5
    """Distance of every joint from its reference within which it has converged, degrees."""
    cond_time_s: NotNegative = 1.0
    """Time within the window that ends EGMRunJoint, s."""
    comm_timeout_s: Positive = 1.0
    """Time without a datagram that raises ERR_UDPUC_COMM, s (default unverified)."""


@dataclass(frozen=True)
class ExternalJoint:
    """The seventh axis, of which no arm's file tells."""

    min: float
    """Lower end, degrees."""
    max: float
    """Upper end, degrees; greater than `min`."""
    velocity: Positive
    """Largest speed, degrees/s."""


@dataclass(frozen=True)
class UnitConfig:
    """A mechanical unit with its RAPID task and its UdpUc device."""

    name: Name
    port: Annotated[int, Ge(1), Le(65535)]
    """Port of the PC, to which the unit speaks first."""
    remote: Name = "127.0.0.1"
    """Address of the PC."""
    arm: Name = "abb_irb120"
    """Name of an arm's file in `config/`, or its path: geometry, ranges and speeds of six joints."""
    external_joint: ExternalJoint | None = None
    """The seventh axis; none: six axes."""
    initial_position: Annotated[tuple[float, ...], MinLen(6), MaxLen(7)] = (0.0, 0.0, 0.0, 0.0, 30.0, 0.0)
    """Joints at the start, degrees; the seventh last."""
    robotware: Literal[6, 7] = 7
    """Major version: the messages that it knows."""
    period_s: Annotated[float, Ge(0.004), Le(0.1)] = 0.004032
    """The unit's own period, s."""
    dead_time_s: Annotated[float, Ge(0.010), Le(0.020)] = 0.014
    """From the planned to the actual position, s."""
    hand_joint_speed: Annotated[float, Gt(0), Le(100)] = 25.0
    """Largest speed in Hand of an external joint, degrees/s (assumed); the flange has 250 mm/s."""
    stream: bool = True
    """Whether EGMStreamStart keeps feedback going outside EGMRunJoint."""
    loop: bool = True
    """Whether RAPID goes back to EGMRunJoint after convergence, and to EGMSetupUC after ERR_UDPUC_COMM."""
    egm: EgmConfig = field(default_factory=EgmConfig)


@dataclass(frozen=True)
class RapidConfig:
    """RAPID streaming: what `abb/rapid` and the planner do. The defaults give the 455 ms of a sine at 30 Hz."""

    bind: Name = "127.0.0.1"
    """Address of the controller."""
    motion_port: Annotated[int, Ge(0), Le(65535)] = 11000
    """TCP port of the motion server; 0: a free one."""
    state_port: Annotated[int, Ge(0), Le(65535)] = 11002
    """TCP port of the state server; 0: a free one."""
    queue_moves: Annotated[int, Ge(1), Le(100)] = 13
    """Moves that RAPID is ahead of the motion; the next one waits for room, and its reply too."""
    start_delay_s: NotNegative = 0.385
    """Look-ahead of the first motion from rest, s; a full queue ends it earlier."""
    zone_mm: Positive = 10.0
    """Zone between points; half the distance of the points where that is less."""
    ramp_s: Annotated[float, Ge(0.005), Le(10)] = 0.1
    """Time from rest to the programmed speed, and of a stop, s (assumed); a shorter move has its own duration."""
    accept_timeout_s: Positive = 0.5
    """Time that a point waits for room before it is refused (WaitSyncTask's timeout), s."""
    max_speed: Positive = 180.0
    """A point that asks a joint for more is refused, degrees/s (MAX_SPEED of `abb/rapid`)."""
    state_period_s: Positive = 0.01
    """Period of the state messages, s."""
    position_delay_s: tuple[PositionDelay, PositionDelay] = (-0.005, 0.012)
    """Range of the delay of a reported position behind the arm, s: each has its own. The range was measured."""


@dataclass(frozen=True)
class Irc5Config:
    """A controller."""

    units: Annotated[tuple[UnitConfig, ...], MinLen(1), MaxLen(MOST_UNITS)]
    mode: Literal["hand", "auto"] = "auto"
    autostart: bool = True
    """Whether motors are on and RAPID runs from the start; in Hand an operator has to do both."""
    emergency_stop_category: Literal[0, 1] = 0
    do_not_restart_after_motors_off: bool = False
    """ABB's default lets corrections go on after Motors On."""
    rapid: RapidConfig | None = None
    """RAPID streaming in the place of EGM; none: EGM."""


@rule(UnitConfig)
def _axes(unit: UnitConfig) -> Iterator[Finding]:
    wanted = 6 if unit.external_joint is None else 7
    if len(unit.initial_position) != wanted:
        yield ("initial_position",), f"found {len(unit.initial_position)} joints, allowed are the unit's {wanted}"


@rule(ExternalJoint)
def _range(joint: ExternalJoint) -> Iterator[Finding]:
    if joint.min >= joint.max:
        yield ("max",), f"found {joint.max:g}, allowed is a number greater than min, {joint.min:g}"


@rule(Irc5Config, "units")
def _unique(config: Irc5Config) -> Iterator[Finding]:
    for key in ("name", "port"):
        values = [getattr(unit, key) for unit in config.units]
        for i, value in enumerate(values):
            if value in values[:i]:
                yield ("units", i, key), f"found {value}, which units[{values.index(value)}] has; each needs its own"


@rule(RapidConfig)
def _delays(rapid: RapidConfig) -> Iterator[Finding]:
    low, high = rapid.position_delay_s
    if low > high:
        yield ("position_delay_s",), f"found {low:g} before {high:g}, allowed is the lower one first"


@rule(Irc5Config, "units", "rapid")
def _alike(config: Irc5Config) -> Iterator[Finding]:
    if config.rapid is None:
        return
    for i, unit in enumerate(config.units):
        if unit.period_s != config.units[0].period_s:
            yield ("units", i, "period_s"), "with rapid all units have the same"
        if unit.external_joint is not None:
            yield ("units", i, "external_joint"), "with rapid a unit has six joints"


_IRC5 = Checker(Irc5Config)


def load_irc5(path: Path) -> Irc5Config:
    """Read the file of a virtual IRC5.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    return _IRC5.read(read(path))
