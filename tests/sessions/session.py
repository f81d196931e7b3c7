"""A whole session from a seed: where it begins, what is done in it, and what came of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import sqrt
from random import Random

from kinematics import forward
from rtcp.config.model import MOST_AXES, ArmConfig
from rtcp.ipc.commands import (
    Command,
    Enable,
    ExtendTrajectory,
    MoveJoints,
    OpenStream,
    Reset,
    RunLines,
    RunTrajectory,
    SetControlMode,
    SetOutput,
    Shutdown,
)
from rtcp.ipc.message import PAYLOAD_SIZE
from rtcp.ipc.states import ControlMode, State
from rtcp.motion.limits import Values
from rtcp.motion.planning.plan import COLUMNS, KIND, POSITIONS, VELOCITIES
from tests.sessions.actions import CONTROL_MODES, NONSENSE, SHARES, RandomActions
from tests.sessions.driver import (
    FAULTS,
    KINDS,
    ODD_INTEGERS,
    PERIODS_US,
    Driver,
    bounds_of,
    configuration,
    is_free,
    random_command,
    with_start,
)

CUBIC, QUINTIC, LINE = 3.0, 5.0, 1.0
"""Column 19 of a plan's row (`rtcp.motion.planning.plan`)."""
ACTIONS = 14
LONGEST_WAIT_S = 0.3


MOVABLE = (State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING, State.CLOSING)


@dataclass
class Outcome:
    """What came of a session, or of many."""

    sessions: int = 0
    cycles: int = 0
    checked: int = 0
    simulated_s: float = 0.0
    taken: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    happenings: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    step: float = 0.0
    acceleration: float = 0.0
    failures: list[tuple[int, list[str]]] = field(default_factory=list)
    """Seed and sentences."""

    def add(self, other: Outcome) -> None:
        """Add another's numbers."""
        self.sessions += other.sessions
        self.cycles += other.cycles
        self.checked += other.checked
        self.simulated_s += other.simulated_s
        for mine, its in (
            (self.taken, other.taken), (self.refused, other.refused), (self.happenings, other.happenings),
            (self.states, other.states),
        ):  # fmt: skip
            mine.update(its)
        self.step = max(self.step, other.step)
        self.acceleration = max(self.acceleration, other.acceleration)
        self.failures += other.failures


class Session(RandomActions):
    """A session on the in-process bus. Everything follows from `random`."""

    def __init__(self, random: Random, config: ArmConfig | None = None) -> None:
        super().__init__(random)
        config = configuration() if config is None else config
        self.bounds = bounds_of(config)
        (mode,) = random.choices(CONTROL_MODES, SHARES)
        chosen = with_start(config, random.choice(PERIODS_US), random.choice(("csp", "csp", "csv", "cst")), mode)
        self.driver = driver = Driver(chosen, random.randrange(1 << 30), self._place(random.random() < 0.9))
        self.period_s = chosen.cycle.period_us * 1e-6
        self.mode = ControlMode[mode.upper()]
        self.actions: list[tuple[int, Callable[[], object]]] = [
            (4, self.enable),
            (24, self._begin_motion),
            (12, self.command),
            (4, self._change_mode),
            (2, lambda: self.send(SetOutput(self.or_odd(random.randrange(0, 18)), random.random() < 0.5))),
            (1, lambda: driver.send(random_command(random))),
            (1, lambda: driver.send_raw(self._kind(), [self._number() for _ in range(PAYLOAD_SIZE // 8)])),
            (1, lambda: driver.send(self._random_move(), lease=random.randrange(3))),
            (1, lambda: driver.fault(random.randrange(6), random.choice(FAULTS))),
            (2, lambda: driver.lose(random.choice((1, 1, 2, 5, 20, 60)), random.random() < 0.5)),
            (1, lambda: driver.drop(random.randrange(1, 8))),
            (2, self._silence),
            (2, self._push),
            (2, self.joystick),
            (1, self.toggle),
            (1, self.emergency),
            (3, self.limits),
        ]

    @property
    def commanded(self) -> list[float]:
        """The last targets on the bus, rad."""
        return self.driver.commanded

    def send(self, command: Command) -> bool:
        """Send a command."""
        return self.driver.send(command)

    def seconds(self, least: float, most: float) -> None:
        """Let time pass."""
        self.driver.wait(max(1, int(self.random.uniform(least, most) / self.period_s)))

    def show(self, code: int, seconds: float) -> None:
        """Show a byte at the joystick's inputs for so long."""
        self.driver.joystick(code)
        self.seconds(0.0, seconds)

    def or_odd(self, number: int) -> int:
        """Return the integer, or now and then one that nobody should send."""
        return self.random.choice(ODD_INTEGERS) if self.random.random() < 0.03 else number

    def _place(self, free: bool) -> list[float]:
        bounds = self.bounds
        while True:
            found = [self.random.uniform(low, high) for low, high in zip(bounds.low, bounds.high, strict=True)]
            if self.random.random() < 0.1:
                found[self.random.randrange(6)] = self.random.choice((-0.01, 0.01)) + self.random.choice(
                    (bounds.low[0], bounds.high[0])
                )
            if not free or is_free(bounds, found, 0.01):
                return found

    def _kind(self) -> int:
        return self.random.choice((self.random.randrange(1 << 32), self.random.choice(KINDS).number))

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
        if self.send(SetControlMode(wanted)):
            self.mode = wanted

    def enable(self) -> None:
        if self.random.random() < 0.9:
            self.driver.enable()
        else:
            self.send(Enable())

    def _random_move(self) -> MoveJoints:
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
            kept = random.randrange(6)
            target = [q if axis != kept else wanted for axis, (q, wanted) in enumerate(zip(here, target, strict=True))]
        speed = random.choice((0.5, 0.5, 0.2, random.uniform(0.0, 0.6)))
        return MoveJoints(tuple(target), self.or_nonsense(speed), random.random() < 0.5)

    def _move(self) -> None:
        self.send(self._random_move())

    def _silence(self) -> None:
        self.driver.fall_silent()
        self.seconds(0.0, 0.8)
        self.driver.acquire()

    def _push(self) -> None:
        axis = self.random.randrange(6)
        self.driver.push(axis, self.random.uniform(-15.0, 15.0))
        self.seconds(0.0, 0.2)
        self.driver.push(axis, 0.0)

    def trajectory(self) -> None:
        """A trajectory that nobody has planned: its pieces may be far too quick, or none at all."""
        random = self.random
        kind = random.choice((CUBIC, QUINTIC))
        rows = [_waypoint(0.0, self.commanded, kind)] if random.random() < 0.5 else []
        for t, q in self.waypoints((0.1, 0.3, 0.3, 1.0), 8):
            speed = [random.uniform(-0.3, 0.3) if random.random() < 0.5 else 0.0 for _ in q]
            rows.append(_waypoint(t, q, kind, speed))
        rows[-1][VELOCITIES : VELOCITIES + 6] = [0.0] * 6
        self._run(RunTrajectory, rows)

    def open_trajectory(self) -> None:
        """A trajectory to which rows are appended that nobody has planned; in time, too late, or never."""
        random, observer = self.random, self.driver.simulation.observer
        kind = random.choice((CUBIC, QUINTIC))
        rows = [
            _waypoint(t, q, kind, [random.choice((0.0, random.uniform(-0.3, 0.3))) for _ in q])
            for t, q in self.waypoints((0.1, 0.3, 0.3, 1.0), 12)
        ]
        known = random.randrange(1, len(rows) + 1)
        slot = observer.write_plan(rows[:known])
        going = self.send(RunTrajectory(slot, known, open=True))
        while going and known < len(rows):
            self.seconds(0.0, 0.6)
            more = random.randrange(1, len(rows) - known + 1)
            observer.extend_plan(slot, known, rows[known : known + more])
            known += more
            going = self.send(ExtendTrajectory(self.or_odd(known), random.random() < 0.3))

    def setpoints(self) -> None:
        """A stream through shared memory, with and without velocities, and with what nobody should send."""
        random, simulation = self.random, self.driver.simulation
        stream = self.or_odd(simulation.now_ns)
        interval, pace = random.choice((0.0005, 0.002, 0.01, 0.05)), random.choice((0.1, 0.3, 0.6))
        here = self.commanded
        velocity = [random.uniform(-pace, pace) for _ in here]
        if not self.send(OpenStream(stream)):
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

    def _run(self, kind: type[RunTrajectory] | type[RunLines], rows: list[list[float]]) -> None:
        random = self.random
        if random.random() < 0.1:
            rows[random.randrange(len(rows))][random.randrange(COLUMNS)] = random.choice(NONSENSE)
        slot = self.driver.simulation.observer.write_plan(rows)
        self.send(kind(self.or_odd(slot), self.or_odd(len(rows))))

    def invade(self) -> None:
        """A smooth trajectory to where a point of the arm would be in a keep-out box, or the tool outside its box."""
        bounds, here = self.driver.bounds, self.commanded
        for _ in range(60):
            near = self.near(0.8)
            there = [max(a, min(b, q)) for q, a, b in zip(near, bounds.low, bounds.high, strict=True)]
            if not is_free(bounds, there):
                break
        else:
            return
        took = 0.1 + max(abs(b - a) for a, b in zip(here, there, strict=True)) / self.random.choice((0.1, 0.25))
        rows = [_waypoint(t, q, QUINTIC) for t, q in ((0.0, here), (took, there))]
        slot = self.driver.simulation.observer.write_plan(rows)
        if self.send(RunTrajectory(slot, len(rows))):
            self.seconds(0.5 * took, took)

    def line(self) -> None:
        """Straight pieces from where the tool is, planned by nobody: out of reach, too quick, through a singularity."""
        random = self.random
        arm = configuration().arm
        if arm is None:
            return
        pose = forward(arm, self.commanded)
        turn = _quaternion(pose.rotation)
        rows, at = [], list(pose.position)
        for _ in range(random.randrange(1, 4)):
            far = random.choice((0.02, 0.1, 0.3))
            to = [x + random.uniform(-far, far) for x in at]
            length = sqrt(sum((b - a) ** 2 for a, b in zip(at, to, strict=True)))
            speed = random.choice((0.05, 0.1, 0.25, 0.5)) / max(length, 1e-3)
            took = 2.0 / speed
            piece = [*at, *turn, *to, *turn, speed, 4 * speed, 40 * speed, length, took]
            rows.append([*piece, *[0.0] * (KIND - len(piece)), LINE])
            at = to
        self._run(RunLines, rows)

    # -- limits -----------------------------------------------------------------------------------------------------

    def limits(self) -> None:
        """Narrower ones, now and then too narrow for the arm, too wide, or none at all; or those of the start again."""
        random, driver = self.random, self.driver
        old = driver.limits
        widest = Values.configured(driver.simulation.config)
        if random.random() < 0.2:
            driver.set_limits(widest)
            return
        here = self.commanded
        share = random.choice((0.2, 0.6, 0.9, 1.1))
        changes: dict[str, object] = {}
        if random.random() < 0.5:
            low = [self.or_nonsense(q + share * (a - q), 0.005) for q, a in zip(here, widest.low, strict=True)]
            high = [self.or_nonsense(q + share * (b - q), 0.005) for q, b in zip(here, widest.high, strict=True)]
            changes |= {"low": tuple(low), "high": tuple(high)}
        for name in ("velocity", "acceleration", "jerk", "torque"):
            if random.random() < 0.3:
                scale = random.choice((0.3, 0.7, 1.0, 1.0, 1.1))
                changes[name] = tuple(self.or_nonsense(scale * x, 0.005) for x in getattr(widest, name))
        if random.random() < 0.3 and widest.box is not None:
            by = random.choice((0.05, 0.2, -0.1))
            changes["box"] = tuple(x + (by if at < 3 else -by) for at, x in enumerate(widest.box))
        if random.random() < 0.3:
            by = random.choice((0.02, 0.1, -0.1))
            changes["keep_out"] = tuple(
                tuple(x - by if at < 3 else x + by for at, x in enumerate(box)) for box in widest.keep_out
            )
        driver.set_limits(replace(old, **changes))  # type: ignore[arg-type]

    def toggle(self) -> None:
        """Give the joystick to the chair for a while."""
        self.driver.toggle(False)
        self.seconds(0.0, 0.3)
        self.driver.toggle(True)

    def emergency(self) -> None:
        """Press the emergency stop, and mostly reset it later."""
        self.driver.press(True)
        self.seconds(0.0, 0.6)
        self.driver.press(False)
        self.seconds(0.0, 0.1)
        if self.random.random() < 0.8:
            self.send(Reset())
            self.driver.simulation.until(lambda: self.driver.state is not State.RESETTING, 0.5)

    def run(self) -> Outcome:
        """Run the session to its end and return what came of it."""
        driver, random = self.driver, self.random
        weights = [weight for weight, _ in self.actions]
        try:
            for _ in range(ACTIONS):
                if driver.simulation.done or driver.violations:
                    break
                if driver.state not in MOVABLE and random.random() < 0.7:
                    driver.enable()
                else:
                    random.choices(self.actions, weights)[0][1]()
                driver.wait(int(random.expovariate(8.0 / LONGEST_WAIT_S) / self.period_s) + 1)
                if random.random() < 0.3:
                    driver.wait(int(random.uniform(0.0, LONGEST_WAIT_S) / self.period_s))
            if random.random() < 0.15:
                driver.send(Shutdown())
                driver.wait(int(2.5 / self.period_s))
        finally:
            driver.close()
        checker = driver.checker
        states = Counter({state.name: count for state, count in driver.states.items()})
        return Outcome(
            1, checker.frames, checker.obeyed, checker.frames * self.period_s, driver.taken, driver.refused,
            driver.happenings, states, checker.largest_step, checker.largest_acceleration,
        )  # fmt: skip


def run_session(seed: int, config: ArmConfig | None = None) -> Outcome:
    """Run the session of `seed`; a failure is in the outcome, with what was done before it."""
    session = None
    try:
        session = Session(Random(seed), config)
        outcome = session.run()
    except Exception as error:
        outcome = Outcome(1)
        outcome.failures.append(
            (seed, [f"{type(error).__name__}: {error}", *(session.driver.log[-12:] if session else ())])
        )
        return outcome
    if session.driver.violations:
        outcome.failures.append((seed, [*session.driver.violations[:4], *session.driver.log[-12:]]))
    return outcome


def _waypoint(t: float, q: list[float], kind: float, speed: Sequence[float] = ()) -> list[float]:
    row = [0.0] * COLUMNS
    row[0], row[KIND] = t, kind
    row[POSITIONS : POSITIONS + len(q)] = q
    row[VELOCITIES : VELOCITIES + len(speed)] = speed
    return row


def _quaternion(rotation: object) -> list[float]:
    """w, x, y, z of a rotation, by its largest component (nine numbers, row by row)."""
    (a, b, c), (d, e, f), (g, h, i) = _rows(rotation)
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    at = squares.index(max(squares))
    size = sqrt(squares[at])
    mixed = (
        (size, (h - f) / size, (c - g) / size, (d - b) / size),
        ((h - f) / size, size, (b + d) / size, (c + g) / size),
        ((c - g) / size, (b + d) / size, size, (f + h) / size),
        ((d - b) / size, (c + g) / size, (f + h) / size, size),
    )
    return [0.5 * part for part in mixed[at]]


def _rows(rotation: object) -> list[list[float]]:
    flat = [float(x) for row in rotation for x in (row if hasattr(row, "__iter__") else (row,))]  # type: ignore[attr-defined]
    return [flat[0:3], flat[3:6], flat[6:9]]
