"""The file of a virtual IRC5 (`config/irc5.yaml`): its panel and its mechanical units."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.numbers import Name, NotNegative, Positive
from rtcp.config.validation import Checker, repeated, rule

MOST_UNITS = 4
PositionDelay = Annotated[float, Ge(-0.01), Le(1.0)]


@dataclass(frozen=True)
class EgmConfig:
    """Settings of EGMSetupUC, EGMActJoint, EGMRunJoint and MOC.cfg; defaults are ABB's unless noted."""

    position_gain: Annotated[float, Ge(0), Le(20)] = 5.0
    """Default Proportional Position Gain k, 1/s."""
    pos_corr_gain: Annotated[float, Ge(0), Le(1)] = 1.0
    """Factor on k; 0: only speed references."""
    low_pass_hz: Annotated[float, Ge(0), Le(100)] = 20.0
    """Cutoff of the low pass on the speed contribution, Hz; 0: none."""
    max_pos_deviation: Positive = 1000.0
    """Largest distance of a joint from its position at the session's start, degrees."""
    max_speed_deviation: Positive = 1.0
    """Largest speed of a joint, degrees/s."""
    ramp_in_s: NotNegative = 0.0
    """Time of the contribution's growth to its full size (RampInTime), s."""
    ramp_s: Annotated[float, Ge(0.005), Le(10)] = 0.5
    """Time to rest at the end of a motion (Default Ramp Time), s."""
    convergence_window: Positive = 0.5
    """Distance from the reference within which a joint counts as converged, degrees."""
    cond_time_s: NotNegative = 1.0
    """Time within the window that ends EGMRunJoint, s."""
    comm_timeout_s: Positive = 1.0
    """Time without a datagram that raises ERR_UDPUC_COMM, s (default unverified)."""


@dataclass(frozen=True)
class ExternalJoint:
    """The seventh axis, which is not in the arm's file."""

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
    """Port of the PC; the unit sends first."""
    remote: Name = "127.0.0.1"
    """Address of the PC."""
    arm: Name = "abb_irb120"
    """Name of an arm's file in `config/`, or its path: geometry, ranges and speeds of six joints."""
    external_joint: ExternalJoint | None = None
    """The seventh axis; none: six axes."""
    initial_position: Annotated[tuple[float, ...], MinLen(6), MaxLen(7)] = (0.0, 0.0, 0.0, 0.0, 30.0, 0.0)
    """Initial joint positions, degrees; the seventh last."""
    robotware: Literal[6, 7] = 7
    """Major version, which determines the messages."""
    period_s: Annotated[float, Ge(0.004), Le(0.1)] = 0.004032
    """The unit's own period, s."""
    dead_time_s: Annotated[float, Ge(0.010), Le(0.020)] = 0.014
    """Delay from the planned to the actual position, s."""
    hand_joint_speed: Annotated[float, Gt(0), Le(100)] = 25.0
    """Largest speed of an external joint in Hand, degrees/s (assumed); that of the flange is 250 mm/s."""
    stream: bool = True
    """True: EGMStreamStart continues the feedback outside EGMRunJoint."""
    loop: bool = True
    """True: RAPID returns to EGMRunJoint after convergence, and to EGMSetupUC after ERR_UDPUC_COMM."""
    egm: EgmConfig = field(default_factory=EgmConfig)


@dataclass(frozen=True)
class RapidConfig:
    """RAPID streaming by `abb/rapid` and the planner. The defaults give the measured 455 ms of a sine at 30 Hz."""

    bind: Name = "127.0.0.1"
    """Address of the controller."""
    motion_port: Annotated[int, Ge(0), Le(65535)] = 11000
    """TCP port of the motion server; 0: a free one."""
    state_port: Annotated[int, Ge(0), Le(65535)] = 11002
    """TCP port of the state server; 0: a free one."""
    queue_moves: Annotated[int, Ge(1), Le(100)] = 13
    """Moves by which RAPID is ahead of the motion; the next one waits for room, and so does its reply."""
    start_delay_s: NotNegative = 0.385
    """Look-ahead before a motion from rest, s; a full queue ends it earlier."""
    zone_mm: Positive = 10.0
    """Zone between points, at most half of their distance."""
    ramp_s: Annotated[float, Ge(0.005), Le(10)] = 0.1
    """Time from rest to the programmed speed, and of a stop, s (assumed); a shorter move has its own duration."""
    accept_timeout_s: Positive = 0.5
    """Upper bound on a point's wait for room before a refusal (WaitSyncTask's timeout), s."""
    max_speed: Positive = 180.0
    """Upper bound on a joint's speed, degrees/s; a faster point is refused (MAX_SPEED of `abb/rapid`)."""
    client_timeout_s: Positive = 2.0
    """Time without a byte after which a client that has sent a PING is lost, s (CLIENT_TIMEOUT of `abb/rapid`)."""
    idle_timeout_s: Positive = 60.0
    """The same for a motion client that has sent none, s (IDLE_TIMEOUT)."""
    motors_off_s: NotNegative = 300.0
    """Time without a motion client after which the motors are switched off, s; 0: never (MOTORS_OFF_TIME)."""
    state_period_s: Positive = 0.01
    """Period of the state messages, s."""
    position_delay_s: tuple[PositionDelay, PositionDelay] = (-0.005, 0.012)
    """Range of the delay of reported positions, s, drawn for each; the range was measured."""


@dataclass(frozen=True)
class Irc5Config:
    """A controller."""

    units: Annotated[tuple[UnitConfig, ...], MinLen(1), MaxLen(MOST_UNITS)]
    mode: Literal["hand", "auto"] = "auto"
    autostart: bool = True
    """True: motors are on and RAPID runs from the start; in Hand an operator must do both."""
    emergency_stop_category: Literal[0, 1] = 0
    do_not_restart_after_motors_off: bool = False
    """False, ABB's default, resumes corrections after Motors On."""
    rapid: RapidConfig | None = None
    """RAPID streaming; none: EGM."""


@rule(UnitConfig)
def _axes(unit: UnitConfig) -> Iterator[Finding]:
    wanted = 6 if unit.external_joint is None else 7
    if len(unit.initial_position) != wanted:
        found, of = len(unit.initial_position), "as the unit has"
        yield Finding(("initial_position",), "count", found=found, allowed=wanted, of=of)


@rule(ExternalJoint)
def _range(joint: ExternalJoint) -> Iterator[Finding]:
    if joint.min >= joint.max:
        yield Finding(("max",), "range", found=joint.max, allowed=f"a number greater than min, {joint.min:g}")


@rule(Irc5Config, "units")
def _unique(config: Irc5Config) -> Iterator[Finding]:
    for key in ("name", "port"):
        yield from repeated(((("units", i, key), getattr(unit, key)) for i, unit in enumerate(config.units)), key)


@rule(RapidConfig)
def _delays(rapid: RapidConfig) -> Iterator[Finding]:
    low, high = rapid.position_delay_s
    if low > high:
        text = f"found {low:g} before {high:g}, allowed is the lower one first"
        yield Finding(("position_delay_s",), "order", text=text)


@rule(Irc5Config, "units", "rapid")
def _alike(config: Irc5Config) -> Iterator[Finding]:
    if config.rapid is None:
        return
    for i, unit in enumerate(config.units):
        if unit.period_s != config.units[0].period_s:
            yield Finding(("units", i, "period_s"), "unlike", text="with rapid all units have the same")
        if unit.external_joint is not None:
            yield Finding(("units", i, "external_joint"), "seventh_joint", text="with rapid a unit has six joints")


_IRC5 = Checker(Irc5Config)


def load_irc5(path: Path) -> Irc5Config:
    """Read the file of a virtual IRC5.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    return _IRC5.read(read(path))
