"""A random session from a seed: where it begins, what is done in it, and its result."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite, sqrt
from random import Random
from typing import Any, Literal, cast

import rtcp
from kinematics import forward
from rtcp.config.model import MOST_AXES, ArmConfig, ControlModeName, DriveModeName, InputConfig
from rtcp.config.segment import SegmentConfig
from rtcp.ipc import commands
from rtcp.ipc.message import PAYLOAD_SIZE
from rtcp.ipc.states import ControlMode, DriveMode, JogFrame, State
from rtcp.motion.limits import Values
from rtcp.motion.planning.interpolation import quaternion
from rtcp.motion.planning.plan import COLUMNS, CUBIC, KIND, LINE, POSITIONS, QUINTIC, VELOCITIES
from rtcp.testing.sessions.actions import NONSENSE, SHARES, RandomActions
from rtcp.testing.sessions.checker import Bounds, Reading, Violation, reading_of
from rtcp.testing.sessions.commander import FAULTS, ODD_INTEGERS, Commander, random_command
from rtcp.testing.sessions.coverage import places_of
from rtcp.testing.sessions.environment import HEAVIEST_KG
from rtcp.testing.sessions.visits import Visit, place_of
from rtcp.testing.simulation import Simulation

LONGEST_WAIT_S = 0.3
SWITCHES = 0.2
"""Part of the sessions whose arm has an enabling switch, though none is configured."""
MOVABLE = (State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING, State.CLOSING)
_CLOSE_S = 2.5
_PLACES = 1000
"""Start positions that are tried before one that touches something is taken."""

Outcome = Literal["passed", "violation", "error", "worker_died"]


@dataclass(frozen=True)
class Result:
    """The result of one session; but for its costs, `cpu_s` and `wall_s`, the same wherever it runs."""

    seed: int
    outcome: Outcome
    version: str = rtcp.__version__
    simulated_s: float = 0.0
    cycles: int = 0
    commands: int = 0
    faults: int = 0
    """Faults and actions of people."""
    largest_step: float = 0.0
    """Largest step of a target, as a fraction of what the speed limit allows."""
    largest_acceleration: float = 0.0
    """The same of the acceleration limit."""
    largest_speed: float = 0.0
    """Largest speed of a target, rad/s."""
    violation: str = ""
    """The first violation (fields of `rtcp.testing.sessions.checker.Violation`) or the error, as JSON."""
    coverage: str = ""
    """Counts of commands, events and refusals (fields of `rtcp.testing.sessions.coverage.Coverage`), as JSON."""
    cpu_s: float = 0.0
    wall_s: float = 0.0


class Session(RandomActions):
    """A session on the in-process bus. Everything follows from `random`.

    Args:
        random: source of randomness.
        config: the arm.
        reading: how its frames are read; None: by the configuration.
        segment: the slaves; None: the configured segment.
        periods_us: cycles to choose from, us; empty: the configured one.
        number: of the session: consecutive numbers visit different places; None: a random one.
        simulation: an arm of a cell, which has its modes already and which the caller starts; None: an arm of its own.
    """

    def __init__(
        self,
        random: Random,
        config: ArmConfig,
        reading: Reading | None = None,
        segment: SegmentConfig | None = None,
        periods_us: Sequence[float] = (),
        number: int | None = None,
        simulation: Simulation | None = None,
    ) -> None:
        super().__init__(random)
        self.reading = reading = reading_of(config) if reading is None else reading
        self.bounds = Bounds.configured(config)
        self.joints = len(config.joints)
        place, round_ = place_of(random.randrange(1 << 16) if number is None else number, places_of(config))
        cycle = replace(config.cycle, period_us=random.choice(periods_us)) if periods_us else config.cycle
        control_mode, drive_mode = place.control_mode, place.drive_mode
        chosen = replace(
            with_enabling_switch(config) if random.random() < SWITCHES else config,
            cycle=cycle, drive_mode=cast(DriveModeName, drive_mode.name.lower()),
            control_mode=cast(ControlModeName, control_mode.name.lower()),
        )  # fmt: skip
        positions = self._place(random.random() < 0.9)
        seed = random.randrange(1 << 30)
        if simulation is None:
            simulation = Simulation(chosen, seed, positions=positions, segment=segment, follow_clock=False)
        else:
            chosen, control_mode = simulation.config, simulation.loop.arm.control_mode
        simulation.unlink()
        self.commander = commander = Commander(chosen, seed, positions, reading, segment, simulation)
        environment = commander.environment
        self.visit = Visit(self, place, round_)
        self.period_s = chosen.cycle.period_us * 1e-6
        self.mode = control_mode
        self._makers: dict[type[commands.Command], Callable[[], commands.Command]] = {
            commands.SetDriveMode: lambda: commands.SetDriveMode(random.choice(list(DriveMode))),
            commands.SetControlMode: lambda: commands.SetControlMode(random.choice(list(ControlMode))),
            commands.SetOutput: lambda: commands.SetOutput(random.randrange(1, 17), random.random() < 0.5),
            commands.SetSpeedOverride: lambda: commands.SetSpeedOverride(random.choice((1.0, 1.0, 0.5, 0.1))),
            commands.SetTool: lambda: commands.SetTool(random.randrange(max(1, len(config.models)))),
            commands.SetPayload: self._payload,
            commands.SetZero: self._same_zero,
            commands.Home: lambda: commands.Home(random.randrange(self.joints)),
            commands.MoveJoints: self._long_move,
            commands.RunTrajectory: self._short_trajectory,
            commands.ExtendTrajectory: lambda: commands.ExtendTrajectory(random.randrange(1, 8), random.random() < 0.5),
            commands.RunInStep: self._in_step,
            commands.StreamPosition: self._next_position,
            commands.OpenStream: lambda: commands.OpenStream(commander.simulation.now_ns),
            commands.Jog: self._short_jog,
            commands.MoveAtVelocity: lambda: commands.MoveAtVelocity(tuple(self._small(0.2)), 0.5),
            commands.ApplyTorque: lambda: commands.ApplyTorque(
                tuple(self._small(5.0)), self.or_nonsense(0.0, 0.1), 1.0, 0.5
            ),
            commands.Guide: lambda: commands.Guide(1.0),
        }
        """Commands that the arm accepts in the right place; commands without an entry get random fields."""
        self.actions: list[tuple[int, Callable[[], object]]] = [
            (4, self.enable),
            (24, self._begin_motion),
            (12, self.command),
            (4, self._change_mode),
            (2, lambda: self.send(commands.SetOutput(self.or_odd(random.randrange(0, 18)), random.random() < 0.5))),
            (1, lambda: self._send_random(random.choice(commander.kinds))),
            (4, lambda: self.send_likely(random.choice(commander.kinds))),
            (1, lambda: commander.send_raw(self._kind(), [self._number() for _ in range(PAYLOAD_SIZE // 8)])),
            (1, lambda: commander.send(self._random_move(), lease=random.randrange(3))),
            (1, lambda: commander.fault(random.randrange(self.joints), random.choice(FAULTS))),
            (2, lambda: commander.lose(random.choice((1, 1, 2, 5, 20, 60)), random.random() < 0.5)),
            (1, lambda: commander.drop(random.randrange(1, len(config.slaves) + 1))),
            (3, self._silence),
            (2, self._halt),
            (2, self._push),
            (3, self._arrive),
            (4, environment.hand),
            (2, environment.load),
            (3, environment.falsify),
            (1, environment.freeze),
            (1, environment.delay),
            (1, environment.burst),
            (1, environment.lasting_fault),
            (1, self._release),
            (1, self._pause),
            (1, lambda: commander.overtake(self._random_move(), random.choice((commands.Halt, commands.Disable)))),
            (2, self.joystick),
            (1, self.toggle),
            (1, self.emergency),
            (6, self.limits),
        ]
        if more := len(config.models[1:]):
            self.actions.append((4, lambda: self.send(commands.SetTool(self.or_odd(random.randint(0, more))))))

    @property
    def commanded(self) -> list[float]:
        """The last targets on the bus, rad."""
        return self.commander.commanded

    def send(self, command: commands.Command) -> bool:
        """Send a command."""
        return self.commander.send(command)

    def seconds(self, least: float, most: float) -> None:
        """Let time pass."""
        self.commander.wait(self.cycles(self.random.uniform(least, most)))

    def cycles(self, seconds: float) -> int:
        """Return the number of cycles in this time, at least 1."""
        return max(1, int(seconds / self.period_s))

    def show(self, code: int, seconds: float) -> None:
        """Show a byte at the joystick's inputs for a random time, at most `seconds`."""
        self.commander.joystick(~code & 0x3F)
        self.seconds(0.0, seconds)
        if self.random.random() < 0.1:
            for fraction in (0.5, 1.0):
                self.send(commands.SetSpeedOverride(fraction))

    def or_odd(self, number: int) -> int:
        """Return the integer, or now and then one that nobody should send."""
        return self.random.choice(ODD_INTEGERS) if self.random.random() < 0.03 else number

    def is_free(self, bounds: Bounds, q: Sequence[float], clearance: float = 0.0, tool: int = 0) -> bool:
        """Whether the arm keeps clear of boxes and of itself, by `clearance` m more than it must."""
        workspace = self.reading.workspaces[tool]
        return workspace is None or workspace.deepest(bounds, q) < -clearance

    def _place(self, free: bool) -> list[float]:
        bounds, random = self.bounds, self.random
        for _ in range(_PLACES):
            place = [random.uniform(low, high) for low, high in zip(bounds.low, bounds.high, strict=True)]
            if random.random() < 0.1:
                axis = random.randrange(self.joints)
                place[axis] = random.choice((bounds.low[axis] - 0.01, bounds.high[axis] + 0.01))
            if not free or self.is_free(bounds, place, 0.01):
                break
        return place

    def _kind(self) -> int:
        return self.random.choice((self.random.randrange(1 << 32), self.random.choice(self.commander.kinds).number))

    def _number(self) -> float:
        return self.or_nonsense(self.random.uniform(-3.0, 3.0))

    def _begin_motion(self) -> None:
        """Mostly one that the control mode takes, now and then another."""
        mode = self.random.choice(list(ControlMode)) if self.random.random() < 0.1 else self.mode
        special = {ControlMode.VELOCITY: self.velocity, ControlMode.TORQUE: self.torque,
                   ControlMode.JOYSTICK: self.joystick}  # fmt: skip
        usual = (self._move, self._move, self.trajectory, self.invade, self.line, self.stream, self.jog,
                 self.setpoints, self.open_trajectory)  # fmt: skip
        (special[mode] if mode in special else self.random.choice(usual))()

    def _change_mode(self) -> None:
        (wanted,) = self.random.choices(list(ControlMode), SHARES)
        if self.send(commands.SetControlMode(wanted)):
            self.mode = wanted

    def enable(self) -> None:
        """Enable the arm, mostly after what its state needs."""
        if self.random.random() < 0.9:
            self.commander.enable()
        else:
            self.send(commands.Enable())

    def _random_move(self) -> commands.MoveJoints:
        random, bounds = self.random, self.bounds
        span = random.choice((1.0, 1.0, 0.2, 0.02))
        here = self.commanded
        target = []
        for q, low, high in zip(here, bounds.low, bounds.high, strict=True):
            far = random.uniform(low, high)
            wanted = q + span * (far - q)
            if random.random() < 0.05:
                wanted = random.choice((low, high, low - 1e-3, high + 1e-3))
            target.append(self.or_nonsense(wanted) if random.random() < 0.1 else wanted)
        if random.random() < 0.2:
            kept = random.randrange(self.joints)
            target = [q if axis != kept else wanted for axis, (q, wanted) in enumerate(zip(here, target, strict=True))]
        speed = random.choice((0.5, 0.5, 0.5, 0.2, 0.2, 1e-6, random.uniform(0.0, 0.6)))
        return commands.MoveJoints(tuple(target), self.or_nonsense(speed), random.random() < 0.5)

    def _move(self) -> None:
        self.send(self._random_move())

    def _silence(self) -> None:
        self._begin_long_motion()
        self.commander.fall_silent()
        self.seconds(*self.random.choice(((0.0, 0.8), (1.3, 2.0))))
        self.commander.acquire()

    def _halt(self) -> None:
        self._begin_long_motion()
        self.seconds(0.0, 0.4)
        self.send(commands.Halt())
        self.seconds(*self.random.choice(((0.0, 0.2), (0.8, 1.5))))

    def _begin_long_motion(self) -> None:
        """Mostly begin one that only a stop ends soon."""
        if self.random.random() < 0.7:
            self.send(self._long_move())

    def _long_move(self) -> commands.MoveJoints:
        bounds = self.bounds
        there = [max(a, min(b, q)) for q, a, b in zip(self.near(0.5), bounds.low, bounds.high, strict=True)]
        return commands.MoveJoints(tuple(there), 0.1, True)

    def _arrive(self) -> None:
        """Move a little, mostly with a hand at a joint when the targets come to rest, and wait."""
        if self.send(commands.MoveJoints(tuple(self.near(0.02)), 0.5, True)):
            self.commander.environment.hand()
            self.seconds(0.2, 0.8)

    def torque(self) -> None:
        """Joint torques; now and then with a load."""
        if self.random.random() < 0.25:
            self._weigh()
        else:
            super().torque()

    def _weigh(self) -> None:
        """A torque motion with a load that the model does not know, and one without it, mostly while a joint turns."""
        environment, nothing = self.commander.environment, (0.0,) * self.joints
        environment.carry(self.random.uniform(0.3, HEAVIEST_KG))
        self.seconds(0.3, 0.6)
        self.send(commands.ApplyTorque(nothing, 0.0, 0.0, 0.1))
        self.seconds(0.2, 0.4)
        environment.carry(0.0)
        environment.hand()
        self.seconds(0.1, 0.4)
        self.send(commands.ApplyTorque(nothing, 0.0, 0.0, 0.3))
        self.seconds(0.1, 0.5)

    def _push(self) -> None:
        axis = self.random.randrange(self.joints)
        self.commander.push(axis, self.random.uniform(-15.0, 15.0))
        self.seconds(0.0, 0.2)
        self.commander.push(axis, 0.0)

    def _release(self) -> None:
        """Release the enabling switch for a while, mostly during a motion."""
        self._begin_long_motion()
        self.seconds(0.0, 0.2)
        self.commander.switch(False)
        self.seconds(0.0, 0.6)
        kinds = (commands.Enable, commands.Jog, commands.MoveJoints, commands.Home, commands.MoveGripper)
        self.send_likely(self.random.choice(kinds))
        self.commander.switch(True)

    def _pause(self) -> None:
        """Pause a motion, and mostly resume it; now and then begin another one in between."""
        self._begin_long_motion()
        self.seconds(0.05, 0.3)
        self.send(commands.Pause())
        self.seconds(0.0, 0.2)
        if self.random.random() < 0.5:
            self.send_likely(self.random.choice((commands.MoveJoints, commands.Jog, commands.RunTrajectory)))
        if self.random.random() < 0.8:
            self.send(commands.Resume())

    # -- one command of a kind --------------------------------------------------------------------------------------

    def send_likely(self, kind: type[commands.Command]) -> None:
        """Send a command of a kind, mostly one that the arm accepts in the right place."""
        if kind is commands.SetLimits:
            self.limits()
        elif kind is commands.RunLines and self.commander.simulation.config.arm is not None:
            self.line()
        elif kind in self._makers and self.random.random() < 0.85:
            other = 0.03 if kind.needs_lease else 0.3
            lease = self.random.randrange(3) if self.random.random() < other else None
            self.commander.send(self._makers[kind](), lease)
        else:
            self._send_random(kind)

    def _send_random(self, kind: type[commands.Command]) -> None:
        """Send a command of a kind with random fields.

        Not SetLimits: it would put limits of an old plan in force, of which the checker is not told.
        """
        if kind is not commands.SetLimits:
            self.send(random_command(kind, self.random, self.joints))

    def _small(self, most: float) -> list[float]:
        return [self.random.choice((0.0, self.random.uniform(-most, most))) for _ in range(self.joints)]

    def _payload(self) -> commands.SetPayload:
        random = self.random
        return commands.SetPayload(
            random.choice((0.0, random.uniform(0.0, 1.5))),
            *self.some([random.uniform(-0.1, 0.1) for _ in range(3)], 0.05),
        )

    def _same_zero(self) -> commands.SetZero:
        axis = self.random.randrange(self.joints)
        zero = self.commander.checker.zero[axis]
        return commands.SetZero(axis, self.random.choice((zero, zero, zero, 1e3)))

    def _short_trajectory(self) -> commands.RunTrajectory:
        rows = [_waypoint(t, q, QUINTIC) for t, q in ((0.0, self.commanded), (1.0, self.near(0.1)))]
        slot = self.commander.simulation.observer.write_plan(rows)
        return commands.RunTrajectory(slot, len(rows), open=self.random.random() < 0.5)

    def _in_step(self) -> commands.RunInStep:
        """A motion in step of this arm alone, with a table of five brakes after its rows."""
        simulation = self.commander.simulation
        rows = [_waypoint(t, q, QUINTIC) for t, q in ((0.0, self.commanded), (2.0, self.near(0.1)))]
        slot = simulation.observer.write_plan([*rows, [self.or_nonsense(1.0, 0.1), *[1.0] * (COLUMNS - 1)]])
        now_ns, step_s = simulation.now_ns, self.or_nonsense(0.5, 0.1)
        choice = self.random.choice
        motion, partners = choice((now_ns, now_ns, now_ns, 1, 1 << 60)), choice((0, 0, 0, 0, 1))
        start_ns = now_ns + choice((20_000_000, 20_000_000, 20_000_000, -1, 1 << 50))
        return commands.RunInStep(slot, len(rows), motion, partners, start_ns, 5, step_s)

    def _next_position(self) -> commands.StreamPosition:
        self.stamp += 0.01
        return commands.StreamPosition(tuple(self.near(0.002)), self.stamp)

    def _short_jog(self) -> commands.Jog:
        frame = self.random.choice(list(JogFrame))
        return commands.Jog(tuple(self._small(0.2 if frame is JogFrame.JOINTS else 0.1)), frame, 0.25)

    # -- motions ----------------------------------------------------------------------------------------------------

    def trajectory(self) -> None:
        """A trajectory that nobody has planned: its pieces may be far too quick, or none at all."""
        random = self.random
        kind = random.choice((CUBIC, QUINTIC))
        rows = [_waypoint(0.0, self.commanded, kind)] if random.random() < 0.5 else []
        for t, q in self.waypoints((0.1, 0.3, 0.3, 1.0), 8):
            speed = [random.uniform(-0.3, 0.3) if random.random() < 0.5 else 0.0 for _ in q]
            rows.append(_waypoint(t, q, kind, speed))
        rows[-1][VELOCITIES : VELOCITIES + self.joints] = [0.0] * self.joints
        self._run(commands.RunTrajectory, rows)

    def hurry(self) -> None:
        """Run a trajectory that is far too quick for the limits of the joints."""
        there = [q + self.random.choice((-0.3, 0.3)) for q in self.commanded]
        rows = [_waypoint(t, q, QUINTIC) for t, q in ((0.0, self.commanded), (0.1, there))]
        slot = self.commander.simulation.observer.write_plan(rows)
        self.send(commands.RunTrajectory(slot, len(rows), tool=self.commander.checker.tool))

    def open_trajectory(self) -> None:
        """A trajectory to which rows are appended that nobody has planned; in time, too late, or never."""
        random, observer = self.random, self.commander.simulation.observer
        kind = random.choice((CUBIC, QUINTIC))
        rows = [
            _waypoint(t, q, kind, [random.choice((0.0, random.uniform(-0.3, 0.3))) for _ in q])
            for t, q in self.waypoints((0.1, 0.3, 0.3, 1.0), 12)
        ]
        known = random.randrange(1, len(rows) + 1)
        slot = observer.write_plan(rows[:known])
        going = self.send(commands.RunTrajectory(slot, known, open=True))
        while going and known < len(rows):
            self.seconds(0.0, 0.6)
            more = random.randrange(1, len(rows) - known + 1)
            observer.extend_plan(slot, known, rows[known : known + more])
            known += more
            going = self.send(commands.ExtendTrajectory(self.or_odd(known), random.random() < 0.3))

    def setpoints(self) -> None:
        """A stream through shared memory, with and without velocities, and with what nobody should send."""
        random, simulation = self.random, self.commander.simulation
        stream = self.or_odd(simulation.now_ns)
        interval, pace = random.choice((0.0005, 0.002, 0.01, 0.05)), random.choice((0.1, 0.3, 0.6))
        here = self.commanded
        velocity = [random.uniform(-pace, pace) for _ in here]
        if not self.send(commands.OpenStream(stream)):
            return
        for _ in range(random.randrange(3, 40)):
            self.stamp += interval
            if random.random() < 0.1:
                velocity = [random.uniform(-pace, pace) for _ in here]
            here = [q + v * interval for q, v in zip(here, velocity, strict=True)]
            rest = [0.0] * (MOST_AXES - len(here))
            sent = self.near(0.5) if random.random() < 0.02 else here
            speeds = velocity if random.random() < 0.9 else [random.uniform(-9.0, 9.0) for _ in here]
            rates = [random.uniform(-5.0, 5.0) for _ in here]
            numbers = [*self.some(sent), *rest, *self.some(speeds), *rest, *self.some(rates), *rest]
            bits = random.choice((0, 1, 1, 3)) if random.random() < 0.97 else random.randrange(256)
            stamp = self.or_nonsense(self.stamp - random.choice((0.0, 0.0, 0.0, 0.0, 0.0, 0.5, interval)), 0.01)
            if not simulation.observer.setpoint(stream, bits, stamp, numbers):
                break
            if random.random() < 0.7:
                self.seconds(0.5 * interval, 1.5 * interval)

    def _run(self, kind: type[commands.RunTrajectory] | type[commands.RunLines], rows: list[list[float]]) -> None:
        random = self.random
        if random.random() < 0.1:
            rows[random.randrange(len(rows))][random.randrange(COLUMNS)] = random.choice(NONSENSE)
        slot = self.commander.simulation.observer.write_plan(rows)
        self.send(kind(self.or_odd(slot), self.or_odd(len(rows))))

    def invade(self) -> None:
        """A smooth trajectory to where a point of the arm would be in a keep-out box, or the tool outside its box."""
        bounds, here = self.commander.bounds, self.commanded
        for _ in range(60):
            near = self.near(0.8)
            there = [max(a, min(b, q)) for q, a, b in zip(near, bounds.low, bounds.high, strict=True)]
            if not self.is_free(bounds, there, tool=self.commander.checker.tool):
                break
        else:
            return
        took = 0.1 + max(abs(b - a) for a, b in zip(here, there, strict=True)) / self.random.choice((0.1, 0.25))
        rows = [_waypoint(t, q, QUINTIC) for t, q in ((0.0, here), (took, there))]
        slot = self.commander.simulation.observer.write_plan(rows)
        if self.send(commands.RunTrajectory(slot, len(rows))):
            self.seconds(0.5 * took, took)

    def line(self) -> None:
        """Straight pieces from where the tool is, planned by nobody: out of reach, too quick, through a singularity."""
        random = self.random
        arm = self.commander.simulation.config.arm
        if arm is None:
            return
        pose = forward(arm, self.commanded[:6])
        orientation = quaternion(pose.rotation)
        rows, off = [], 0.05 if random.random() < 0.05 else 0.0
        at = [x + off for x in pose.position]
        for _ in range(random.randrange(1, 4)):
            far = random.choice((0.02, 0.1, 0.3))
            to = [x + random.uniform(-far, far) for x in at]
            length = sqrt(sum((b - a) ** 2 for a, b in zip(at, to, strict=True)))
            speed = random.choice((0.05, 0.1, 0.25, 0.5)) / max(length, 1e-3)
            took = 2.0 / speed
            piece = [*at, *orientation, *to, *orientation, speed, 4 * speed, 40 * speed, length, took]
            rows.append([*piece, *[0.0] * (KIND - len(piece)), LINE])
            at = to
        self._run(commands.RunLines, rows)

    # -- limits -----------------------------------------------------------------------------------------------------

    def widen(self) -> None:
        """Put the configured limits in force."""
        self.commander.set_limits(Values.configured(self.commander.simulation.config))

    def limits(self) -> None:
        """Narrower ones, now and then too narrow for the arm, too wide, or none at all; or those of the start again."""
        random, commander = self.random, self.commander
        old = commander.limits
        widest = Values.configured(commander.simulation.config)
        if random.random() < 0.2:
            self.widen()
            return
        here = self.commanded
        share = random.choice((0.2, 0.6, 0.6, 0.9, 0.9, 1.1))
        changes: dict[str, Any] = {}
        if random.random() < 0.5:
            low = [self.or_nonsense(q + share * (a - q), 0.005) for q, a in zip(here, widest.low, strict=True)]
            high = [self.or_nonsense(q + share * (b - q), 0.005) for q, b in zip(here, widest.high, strict=True)]
            changes |= {"low": tuple(low), "high": tuple(high)}
        for name in ("velocity", "acceleration", "jerk", "torque"):
            if random.random() < 0.5:
                scale = random.choice((0.3, 0.3, 0.5, 0.5, 0.7, 0.7, 1.0, 1.1))
                changes[name] = tuple(self.or_nonsense(scale * x, 0.005) for x in getattr(widest, name))
        if random.random() < 0.3 and widest.box is not None:
            by = random.choice((0.05, 0.2, -0.1))
            changes["box"] = tuple(x + (by if at < 3 else -by) for at, x in enumerate(widest.box))
        if random.random() < 0.3:
            by = random.choice((0.02, 0.1, -0.1))
            changes["keep_out"] = tuple(
                tuple(x - by if at < 3 else x + by for at, x in enumerate(box)) for box in widest.keep_out
            )
        if widest.cones and random.random() < 0.5:
            scale = random.choice((0.6, 0.9, 1.0, 1.1))
            changes["cones"] = tuple(cone._replace(angle=scale * cone.angle) for cone in widest.cones)
        if random.random() < 0.2:
            speed, torque, _ = widest.supervision
            changes["supervision"] = (speed, torque, random.choice((0.01, 0.05, 0.15, 0.2)))
        commander.set_limits(replace(old, **changes), widen=random.random() < 0.2)

    def toggle(self) -> None:
        """Give the joystick to the chair for a while."""
        self.commander.toggle(False)
        self.seconds(0.0, 0.3)
        self.commander.toggle(True)

    def emergency(self) -> None:
        """Press the emergency stop, and mostly reset it later."""
        self.commander.press(True)
        self.seconds(*self.random.choice(((0.05, 0.6), (0.05, 0.6), (0.8, 1.5))))
        self.commander.press(False)
        self.seconds(0.0, 0.1)
        if self.random.random() < 0.8:
            self.send(commands.Reset())
            self.commander.simulation.until(lambda: self.commander.state is not State.RESETTING, 0.5)

    def _disturb(self, seconds: float) -> None:
        """Let something of the surroundings act at two random instants, mostly during the visit."""
        environment = self.commander.environment
        happens = (
            environment.falsify, environment.falsify, environment.falsify, environment.hand, environment.hand,
            environment.load, environment.burst, environment.freeze, environment.delay,
        )  # fmt: skip
        for action in self.random.choices(happens, k=2):
            environment.later(action, seconds)
        if self.random.random() < 0.4:
            environment.later(lambda: self.commander.switch(False), 0.5 * seconds)
            environment.later(lambda: self.commander.switch(True), seconds)

    def run(self, seconds: float) -> None:
        """Run for this simulated time, s, or to the first violation."""
        commander, random = self.commander, self.random
        weights = [weight for weight, _ in self.actions]
        self._disturb(seconds)
        self.visit.run(seconds)
        while commander.seconds < seconds and not (commander.simulation.done or commander.checker.violations):
            if commander.state not in MOVABLE and random.random() < 0.7:
                commander.enable()
            else:
                random.choices(self.actions, weights)[0][1]()
            commander.wait(int(random.expovariate(8.0 / LONGEST_WAIT_S) / self.period_s) + 1)
            if random.random() < 0.3:
                commander.wait(int(random.uniform(0.0, LONGEST_WAIT_S) / self.period_s))
        self.visit.end()
        if commander.state is State.CLOSING:
            commander.wait(int(_CLOSE_S / self.period_s))

    def close(self) -> None:
        """Free the memory."""
        self.commander.close()

    def result(self, seed: int, error: Exception | None = None) -> Result:
        """Return the result of the session as it is now."""
        commander, checker = self.commander, self.commander.checker
        first = checker.violations[0] if checker.violations else None
        return Result(
            seed,
            "error" if error is not None else "passed" if first is None else "violation",
            simulated_s=commander.seconds,
            cycles=checker.frames,
            commands=commander.taken.total() + commander.refused.total(),
            faults=commander.faults.total(),
            largest_step=checker.largest_step,
            largest_acceleration=checker.largest_acceleration,
            largest_speed=checker.largest_speed,
            violation=error_json(error) if error is not None else "" if first is None else violation_json(first),
            coverage=commander.coverage.as_json(),
        )


def with_enabling_switch(config: ArmConfig) -> ArmConfig:
    """Return the configuration with an enabling switch at a free terminal; without an IO box the same configuration."""
    inputs = config.inputs
    if inputs.emergency_stop is None or inputs.enabling_switch is not None:
        return config
    contacts = [contact for contact in (inputs.emergency_stop, inputs.arm_toggle) if contact is not None]
    joystick = inputs.joystick
    used = {contact.number for contact in contacts}
    if joystick is not None:
        used |= {
            joystick.forward,
            joystick.backward,
            joystick.left,
            joystick.right,
            joystick.mode_up,
            joystick.mode_down,
        }
    free = next(number for number in range(1, 17) if number not in used)
    switch = InputConfig(free, box=inputs.emergency_stop.box)
    return replace(config, inputs=replace(inputs, enabling_switch=switch))


def violation_json(violation: Violation) -> str:
    """Return the fields of a violation as JSON; infinite ends are left out."""
    fields = asdict(violation)
    return json.dumps({n: v for n, v in fields.items() if not isinstance(v, float) or isfinite(v)})


def error_json(error: BaseException | None) -> str:
    """Return an exception as JSON."""
    return json.dumps({"error": type(error).__name__, "message": str(error)})


def _waypoint(t: float, q: list[float], kind: float, speed: Sequence[float] = ()) -> list[float]:
    row = [0.0] * COLUMNS
    row[0], row[KIND] = t, kind
    row[POSITIONS : POSITIONS + len(q)] = q
    row[VELOCITIES : VELOCITIES + len(speed)] = speed
    return row
