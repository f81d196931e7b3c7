"""The arm that an environment moves: one in simulated time, or a robot that is connected; both by the same commands."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Protocol

from rtcp.api import Faulted, Invalid, Refused, Robot, RtcpError, State, Stream, TimedOut
from rtcp.config import load_segment
from rtcp.config.loader import with_control_mode
from rtcp.config.model import MOST_AXES, ArmConfig
from rtcp.control.cycle import record_schema
from rtcp.gym.actions import ActionKind
from rtcp.ipc.commands import OpenStream, SetControlMode
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.session import SessionError, read_session
from rtcp.ipc.states import ControlMode
from rtcp.testing import Simulation
from rtcp.testing.inputs import Inputs

_STREAM = 1
_AT_REST_RAD_S = 0.005


class Arm(Protocol):
    """An arm for episodes of one action a step.

    Attributes:
        config: of the arm.
        schema: of its cycle records.
        observer: of its blackboard, from the first `begin` on.
    """

    config: ArmConfig
    schema: RecordSchema
    observer: Observer

    @property
    def now_s(self) -> float:
        """The arm's time, s."""

    def begin(self, positions: Sequence[float] | None, seed: int) -> None:
        """Begin an episode: at rest, holding, in the control mode of the actions; raises RtcpError where it cannot.

        Args:
            positions: where its joints begin, rad; None: where they stand at power-on, or now.
            seed: of what is random in a simulation.
        """

    def apply(self, values: Sequence[float]) -> RtcpError | None:
        """Send an action; return why it was not accepted."""

    def advance(self) -> None:
        """Let a step's time pass."""

    def close(self) -> None:
        """Leave the arm at rest; a second time is harmless."""


class SimulatedArm:
    """The arm of `rtcp.testing`, a new one each episode.

    Args:
        config: of the arm.
        kind: of the actions.
        rate_hz: steps a second, a whole number of cycles each.

    Raises:
        Invalid: a step is no whole number of cycles, or the configuration has no joints.
        ConfigError: of the segment's file, or the arm lacks the control mode.
    """

    observer: Observer

    def __init__(self, config: ArmConfig, kind: ActionKind, rate_hz: float) -> None:
        if not config.joints:
            raise RtcpError("invalid", f"config: {config.name} has no joints")
        cycles = 1e6 / (rate_hz * config.cycle.period_us)
        self._cycles = round(cycles)
        if self._cycles < 1 or abs(cycles - self._cycles) > 1e-6 * cycles:
            raise RtcpError(
                "invalid",
                f"rate_hz: found {rate_hz:g}, a step of {cycles:g} cycles of {config.cycle.period_us:g} us: "
                f"give a rate of which a step is a whole number of cycles, as {1e6 / config.cycle.period_us:g} Hz / N",
            )
        self.config = with_control_mode(config, kind.control_mode)
        self.schema = record_schema(config)
        self._kind = kind
        self._segment = load_segment(config.source.parent / config.bus.segment)
        self._padding = (0.0,) * (3 * MOST_AXES - len(config.joints))
        self._simulation: Simulation | None = None
        self._cycles_run = 0

    @property
    def simulation(self) -> Simulation:
        """That of this episode, with its bus and its drives: for frames that are lost, and the like."""
        if self._simulation is None:
            raise RtcpError("invalid", "no episode has begun: call reset()")
        return self._simulation

    @property
    def now_s(self) -> float:
        """Simulated time."""
        return self.simulation.now_ns * 1e-9

    def begin(self, positions: Sequence[float] | None, seed: int) -> None:
        """Power another arm up, and bring it to holding."""
        self.close()
        self._simulation = simulation = Simulation(
            with_control_mode(self.config, "joint"),
            seed,
            positions=positions,
            segment=self._segment,
            follow_clock=False,
        )
        simulation.unlink()
        self.observer, self._cycles_run = simulation.observer, 0
        Inputs(simulation)
        try:
            # The mode of the actions comes last: an arm that rests in joint mode does not sag when torques hold it.
            simulation.hold()
            simulation.until(lambda: max(map(abs, simulation.loop.arm.state.actual_velocity)) < _AT_REST_RAD_S, 5.0)
            simulation.do(SetControlMode(ControlMode[self.config.control_mode.upper()]))
            simulation.until(lambda: not simulation.loop.machine.changing_mode, 1.0)
            simulation.bring_to(State.HOLDING, 0.0)
        except RuntimeError as error:
            raise RtcpError("fault", f"the simulated arm cannot be brought to holding: {error}") from error
        if self._kind.command is None:
            simulation.do(OpenStream(_STREAM))

    def apply(self, values: Sequence[float]) -> RtcpError | None:
        """Send an action; a command takes the first cycle of the step."""
        simulation = self.simulation
        if self._kind.command is None:
            if self.observer.setpoint(_STREAM, 0, self.now_s, (*values, *self._padding)):
                return None
            return RtcpError("fault", "the stream has ended: the events say why")
        self._cycles_run = 1
        refusal = simulation.send(self._kind.command(values)).refusal
        if refusal is None:
            return None
        return RtcpError("refused", simulation.names.message(refusal), refusal.name, refusal.as_json())

    def advance(self) -> None:
        """Run the cycles of a step."""
        cycle = self.simulation.cycle
        for _ in range(self._cycles - self._cycles_run):
            cycle()
        self._cycles_run = 0

    def close(self) -> None:
        """Forget the arm."""
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None


class ConnectedArm:
    """A robot on a running platform, in real time.

    Args:
        robot: connected, and enabled before an episode begins.
        kind: of the actions.
        rate_hz: steps a second.

    Attributes:
        late_steps: steps that began later than planned.
        largest_delay_s: largest delay of a step's begin, s.

    Raises:
        NotRunning: the platform has ended.
    """

    def __init__(self, robot: Robot, kind: ActionKind, rate_hz: float) -> None:
        try:
            self.config = read_session(robot.directory).config
            self.observer = Observer(blackboard_file(robot.directory))
        except (BlackboardError, SessionError) as error:
            raise RtcpError("not running", f"no platform runs in {robot.directory} ({error}): `rtcp start`") from error
        self.schema = self.observer.schema
        if rate_hz * self.config.cycle.period_us > 1e6:
            self.observer.close()
            raise RtcpError("invalid", f"rate_hz: found {rate_hz:g}, a cycle takes {self.config.cycle.period_us:g} us")
        self.late_steps, self.largest_delay_s = 0, 0.0
        self._robot = robot
        self._kind = kind
        self._step_s = 1.0 / rate_hz
        self._due_s = 0.0
        self._mode_before = ""
        self._stream: Stream | None = None
        self._is_open = True

    @property
    def now_s(self) -> float:
        """CLOCK_MONOTONIC."""
        return time.monotonic()

    def begin(self, positions: Sequence[float] | None, seed: int) -> None:
        """Move the joints to where the episode begins, if that is given."""
        if not self._is_open:
            raise RtcpError("invalid", "the environment is closed: make another one")
        robot = self._robot
        self._rest()
        status = robot.status()
        if status.state is not State.HOLDING:
            message = f"the arm is in state {status.state.words}: an episode begins while it holds: robot.enable()"
            raise RtcpError("refused", message, "wrong_state", {"state": status.state.name.lower()})
        if not self._mode_before and status.control_mode is not None:
            self._mode_before = status.control_mode.name.lower()
        if positions is not None:
            robot.mode("joint")
            robot.move_joints(positions)
        robot.mode(self._kind.control_mode)
        if self._kind.command is None:
            self._stream = robot.open_stream()
        self._due_s = time.monotonic()

    def apply(self, values: Sequence[float]) -> RtcpError | None:
        """Send an action, as the simulated arm gets it."""
        try:
            if self._stream is not None:
                self._stream.send(values, t=self._due_s)
            else:
                assert self._kind.command is not None  # else `begin` has opened a stream
                command = self._kind.command(values)
                self._robot.command(command.name, **command.as_json(), sent_s=time.monotonic())
        except (Refused, Invalid, TimedOut, Faulted) as error:
            return error
        return None

    def advance(self) -> None:
        """Wait until the step ends."""
        self._due_s += self._step_s
        delay_s = time.monotonic() - self._due_s
        if delay_s <= 0.0:
            time.sleep(-delay_s)
            return
        self.late_steps += 1
        self.largest_delay_s = max(self.largest_delay_s, delay_s)
        self._due_s += delay_s

    def close(self) -> None:
        """Halt the arm, whoever moves it, and return to the control mode of before where the arm holds."""
        if not self._is_open:
            return
        self._is_open = False
        with contextlib.suppress(RtcpError):
            self._rest()
            if self._mode_before:
                self._robot.mode(self._mode_before)
        self.observer.close()

    def _rest(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if self._mode_before:
            self._robot.halt()
