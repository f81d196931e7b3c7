"""A mechanical unit in simulated time: its RAPID task, its EGM session and its joints. Degrees and s.

The planned position follows the control law; the actual position is the planned one delayed by the servo's dead time.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence

from rtcp.config.find import find_arm
from rtcp.config.loader import load_mechanics
from rtcp.config.model import ConfigError
from rtcp.virtual.irc5.accelerometer import Accelerometer
from rtcp.virtual.irc5.config import UnitConfig
from rtcp.virtual.irc5.control_law import ControlLaw
from rtcp.virtual.irc5.geometry import Geometry
from rtcp.virtual.irc5.messages import (
    ROBOT_AXES,
    EgmCodec,
    ForeignDatagram,
    GarbledDatagram,
    MciState,
    Reference,
    UnitState,
)
from rtcp.virtual.irc5.panel import STOPPING_TIME_S, Mode, Motors, Panel
from rtcp.virtual.request_socket import RequestRefused

HAND_SPEED = 250.0
"""Largest speed of the flange in Hand, mm/s (ISO 10218-1)."""
RAPID_PAUSE_S = 0.02
"""Time from the end of one EGMRunJoint to the next (assumed)."""
QUEUE = 64
"""Upper bound on queued datagrams; further ones are lost (assumed, as for a socket's buffer)."""
MOST_EVENTS = 50


class RapidRefused(RequestRefused):
    """RAPID cannot start; the message is a sentence."""


class MechanicalUnit:
    """An arm of the controller. `receive` queues datagrams; `step` advances by one period and returns its message."""

    def __init__(
        self, config: UnitConfig, panel: Panel, resume_after_motors_off: bool = True, uses_egm: bool = True
    ) -> None:
        """The unit starts at rest with RAPID stopped; without EGM `follow` moves it.

        Raises:
            ConfigError: the arm's file is missing or invalid, or the initial position is outside its ranges.
        """
        arm = load_mechanics(find_arm(config.arm))
        self.config = config
        self.ranges = [(math.degrees(limit.lower), math.degrees(limit.upper)) for limit in arm.limits]
        self.speed_limits = [math.degrees(limit.velocity) for limit in arm.limits]
        if config.external_joint is not None:
            self.ranges.append((config.external_joint.min, config.external_joint.max))
            self.speed_limits.append(config.external_joint.velocity)
        for i, (position, (low, high)) in enumerate(zip(config.initial_position, self.ranges, strict=True)):
            if not low <= position <= high:
                mistake = f"found {position:g} for joint {i + 1}, allowed is a number from {low:g} to {high:g}"
                raise ConfigError([f"initial_position of {config.name}: {mistake}"])
        self.planned = list(config.initial_position)
        self.speeds = [0.0] * len(self.planned)
        """Planned speeds of the last period, degrees/s."""
        self.mci = MciState.STOPPED
        self.rapid_running = False
        self.counts: Counter[str] = Counter()
        """Number of datagrams by result."""
        self.events: deque[str] = deque(maxlen=MOST_EVENTS)
        """Sentences, with ABB's event numbers if known."""
        self.collision = False
        self.utilization_override: float | None = None
        """%, a fault; None: as computed."""
        self._panel = panel
        self._resumes = resume_after_motors_off
        self._uses_egm = uses_egm
        self.geometry = Geometry([(row.alpha, row.a, row.d, row.offset) for row in arm.rows])
        self.accelerometer = Accelerometer(self.geometry, config.period_s)
        self._codec = EgmCodec(config.robotware)
        self._law = ControlLaw(config.egm, self.speed_limits)
        self._queue: deque[bytes] = deque()
        self._reference: Reference | None = None
        length = math.ceil(config.dead_time_s / config.period_s) + 1
        self._servo = deque([tuple(self.planned)] * length, length)
        """Delayed planned positions; the first is the actual one."""
        self._start = tuple(self.planned)
        self._seqno = 0
        self._move_index = 0
        self._silence_s = self._converged_s = self._pause_s = 0.0
        self._stop_from = self.speeds
        self._stop_left = self._stop_rate = 0.0
        """Remaining share of the stop's initial speed, and its rate of decrease, 1/s."""
        self._in_instruction = False
        """True: program start continues within EGMRunJoint."""
        self._suspended = False
        """True: EGMRunJoint continues when motors are on again."""

    @property
    def actual(self) -> tuple[float, ...]:
        """Measured joints, degrees."""
        return self._servo[0]

    @property
    def axes(self) -> int:
        """Number of joints, 6 or 7."""
        return len(self.planned)

    # -- the operator -------------------------------------------------------------------------------------------------

    def start_rapid(self) -> None:
        """Start the program: it resumes an interrupted EGMRunJoint, or begins a new session.

        Raises:
            RapidRefused: motors are off.
        """
        if self._panel.motors is not Motors.ON:
            raise RapidRefused(f"the motors of {self.config.name} are {self._panel.motors.value}: switch them on first")
        if self.rapid_running:
            return
        self.rapid_running = True
        self._suspended = False
        if not self._uses_egm:
            self.mci, self.collision = MciState.STOPPED, False
        elif self._in_instruction:
            self._run()
        else:
            self._begin_session()

    def stop_rapid(self) -> None:
        """Stop the program: motion ends within the default ramp time; program start resumes it."""
        self._suspended = False
        if self.rapid_running:
            self.rapid_running = False
            self._leave(MciState.STOPPED, self.config.egm.ramp_s)

    def restart_session(self) -> None:
        """Return RAPID to EGMReset and EGMSetupUC.

        Raises:
            RapidRefused: RAPID is stopped.
        """
        if not self.rapid_running:
            raise RapidRefused(f"RAPID of {self.config.name} is stopped: start it first")
        self._leave(MciState.STOPPED, self.config.egm.ramp_s)
        self._begin_session()

    def end_by_convergence(self) -> None:
        """End EGMRunJoint as by convergence of all joints for CondTime.

        Raises:
            RapidRefused: EGMRunJoint is not active.
        """
        if self.mci is not MciState.RUNNING:
            raise RapidRefused(f"{self.config.name} is in MCI_{self.mci.name}: only MCI_RUNNING ends by convergence")
        self._converged_s = self.config.egm.cond_time_s
        self._end_instruction("EGMRunJoint has converged")

    def fail(self, sentence: str, collision: bool = False) -> None:
        """End the session with MCI_ERROR: RAPID stops, and its next start begins a new session."""
        self.events.append(sentence)
        self.rapid_running = self._in_instruction = self._suspended = False
        self.collision = collision
        self._leave(MciState.ERROR, STOPPING_TIME_S[0] if collision else self.config.egm.ramp_s)

    # -- the cycle ----------------------------------------------------------------------------------------------------

    def receive(self, datagram: bytes) -> None:
        """Queue a datagram; each cycle reads one."""
        if len(self._queue) < QUEUE:
            self._queue.append(datagram)
        else:
            self.counts["overflow"] += 1

    def step(self, clock_s: float) -> bytes | None:
        """Advance by one period; return the message of this cycle, None: the unit is silent.

        `clock_s`: the controller's clock, s since 1970.
        """
        dt = self.config.period_s
        self._read_one(dt)
        self._follow_motors()
        if self.mci is MciState.RUNNING:
            self._advance(dt)
        else:
            self._slow_down(dt)
            if self.rapid_running and self._pause_s > 0.0:
                self._pause_s -= dt
                if self._pause_s <= 0.0:
                    self._run() if self._in_instruction else self._begin_session()
        self._servo.append(tuple(self.planned))
        if self.mci is not MciState.RUNNING and not self.config.stream:
            return None
        return self._codec.encode(self._state(clock_s))

    def follow(self, position: Sequence[float], dt: float) -> None:
        """Advance by one period to a position planned by RAPID's move instructions, degrees."""
        self._follow_motors()
        self.speeds = [(now - then) / dt for now, then in zip(position, self.planned, strict=True)]
        self.planned = list(position)
        self._servo.append(tuple(self.planned))

    def _state(self, clock_s: float) -> UnitState:
        seqno = self._seqno
        self._seqno = (seqno + 1) & 0xFFFFFFFF
        planned = tuple(self.planned)
        return UnitState(
            seqno, clock_s, self.actual, planned, self.geometry.flange(self.actual), self.geometry.flange(planned),
            self._panel.motors is not Motors.OFF, self.rapid_running, self.mci, self._converged_s > 0.0,
            self._law.utilization if self.utilization_override is None else self.utilization_override,
            self._move_index, self.collision,
        )  # fmt: skip

    def _read_one(self, dt: float) -> None:
        self._silence_s += dt
        if not self._queue:
            return
        try:
            reference = self._codec.decode(self._queue.popleft(), self.axes)
        except GarbledDatagram:
            self.counts["garbled"] += 1
            return
        except ForeignDatagram:
            self.counts["foreign"] += 1
            return
        self._silence_s = 0.0
        if self._reference is not None and reference.seqno <= self._reference.seqno:
            self.counts["not_newer"] += 1  # EGM still uses it
        if self.mci is not MciState.RUNNING:
            self.counts["unused"] += 1
            return
        self.counts["used"] += 1
        if self._reference is None:
            self._law.restart(self.speeds)
            self._stop_left = 0.0
        self._reference = reference

    def _follow_motors(self) -> None:
        """Stop with the motors; resume with them if the configuration allows it."""
        if self._panel.motors is Motors.ON:
            if self._suspended:
                self._suspended = False
                self.rapid_running = True
                self._run()
        elif self.rapid_running:
            self._suspended = self._resumes and self._in_instruction
            self.rapid_running = False
            self._leave(MciState.STOPPED, STOPPING_TIME_S[self._panel.category])
            self.events.append("motors are off: RAPID stopped")

    def _run(self) -> None:
        """Enter EGMRunJoint; earlier references are void, and a stop continues until a new one arrives."""
        self.mci = MciState.RUNNING
        self._in_instruction = True
        self._reference = None
        self._silence_s = self._converged_s = self._pause_s = 0.0
        self._move_index += 1

    def _begin_session(self) -> None:
        """Execute EGMReset, EGMSetupUC, EGMActJoint, EGMRunJoint: seqno restarts at 0 with an empty queue."""
        self._seqno = 0
        self._queue.clear()
        self.collision = False
        self._start = tuple(self.planned)
        self._run()

    def _leave(self, state: MciState, time_s: float) -> None:
        """Leave MCI_RUNNING and come to rest within `time_s`."""
        if self.mci is MciState.RUNNING and self._reference is not None:
            self._stop_from, self._stop_left, self._stop_rate = self.speeds, 1.0, 1.0 / time_s
        else:  # a stop in progress continues
            self._stop_rate = max(self._stop_rate, self._stop_left / time_s)
        self.mci = state
        self._pause_s = 0.0
        self._law.utilization = 0.0

    def _end_instruction(self, sentence: str) -> None:
        self.events.append(sentence)
        self._leave(MciState.STOPPED, self.config.egm.ramp_s)
        if self.config.loop:
            self._pause_s = RAPID_PAUSE_S
        else:
            self.rapid_running = self._in_instruction = False

    def _advance(self, dt: float) -> None:
        """Execute a period of EGMRunJoint: control law, limits, and the ends of the instruction."""
        egm, reference = self.config.egm, self._reference
        if self._silence_s > egm.comm_timeout_s:
            self._end_instruction(f"41822 no data for {egm.comm_timeout_s:g} s: ERR_UDPUC_COMM")
            self._in_instruction = False
            return
        if reference is None:
            self._slow_down(dt)
            return
        target = reference.position
        if target is not None:
            outside = [i for i, (low, high) in enumerate(self.ranges) if not low <= target[i] <= high]
            if outside:
                i = outside[0]
                low, high = self.ranges[i]
                self.fail(f"input out of bounds: joint {i + 1} to {target[i]:g}, allowed are {low:g} to {high:g}")
                return
        speeds = self._law.speeds(self.planned, target, reference.speed, dt)
        self._move(self._slowed_in_hand(speeds, dt) if self._panel.mode is Mode.HAND else speeds, dt)
        if target is not None and all(
            abs(wanted - now) <= egm.convergence_window for wanted, now in zip(target, self.actual, strict=True)
        ):
            self._converged_s += dt
            if self._converged_s >= egm.cond_time_s:
                self.end_by_convergence()
        else:
            self._converged_s = 0.0

    def _slowed_in_hand(self, speeds: list[float], dt: float) -> list[float]:
        after = [position + speed * dt for position, speed in zip(self.planned, speeds, strict=True)]
        here, there = self.geometry.flange(self.planned).position, self.geometry.flange(after).position
        size = math.dist(here, there) / dt
        scale = 1.0 if size <= HAND_SPEED else HAND_SPEED / size
        for speed in speeds[ROBOT_AXES:]:
            if abs(speed) * scale > self.config.hand_joint_speed:
                scale = self.config.hand_joint_speed / abs(speed)
        return [speed * scale for speed in speeds]

    def _move(self, speeds: Sequence[float], dt: float) -> None:
        """Move the planned position within the joint ranges and MaxPosDeviation."""
        before, deviation = self.planned, self.config.egm.max_pos_deviation
        self.planned = [
            min(max(position + speed * dt, low, start - deviation), high, start + deviation)
            for position, speed, start, (low, high) in zip(before, speeds, self._start, self.ranges, strict=True)
        ]
        self.speeds = [(now - then) / dt for now, then in zip(self.planned, before, strict=True)]

    def _slow_down(self, dt: float) -> None:
        if self._stop_left == 0.0:
            return
        if self._panel.motors is Motors.OFF:
            self._stop_rate = max(self._stop_rate, 1.0 / STOPPING_TIME_S[0])  # the brakes
        self._stop_left = max(0.0, self._stop_left - self._stop_rate * dt)
        self._move([speed * self._stop_left for speed in self._stop_from], dt)
