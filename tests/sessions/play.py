"""A whole session from a seed: where it begins, what is done in it, and what came of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from rtcp.config.model import ArmConfig
from rtcp.ipc.commands import (
    Disable,
    Enable,
    Halt,
    MoveGripper,
    MoveJoints,
    Reset,
    SetControlMode,
    SetDriveMode,
    SetOutput,
    Shutdown,
)
from rtcp.ipc.states import ControlMode, DriveMode, State
from tests.sessions.deeds import Deeds
from tests.sessions.driver import (
    FAULTS,
    KINDS,
    PERIODS_US,
    Driver,
    bounds_of,
    configuration,
    is_free,
    random_command,
    with_start,
)

MOTIONS = ("joint", "cartesian", "joystick", "velocity", "torque")
SHARES = (3, 3, 2, 1, 1)
ACTIONS = 14
LONGEST_WAIT_S = 0.3


MOVABLE = (State.ENABLING, State.HOLDING, State.MOVING, State.STOPPING, State.DISABLING, State.CLOSING)


@dataclass
class Outcome:
    """What came of a session, or of many."""

    sessions: int = 0
    cycles: int = 0
    judged: int = 0
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
        self.judged += other.judged
        self.simulated_s += other.simulated_s
        for mine, its in (
            (self.taken, other.taken), (self.refused, other.refused), (self.happenings, other.happenings),
            (self.states, other.states),
        ):  # fmt: skip
            mine.update(its)
        self.step = max(self.step, other.step)
        self.acceleration = max(self.acceleration, other.acceleration)
        self.failures += other.failures


class Player:
    """Chooses what is done next. Everything follows from the seed."""

    def __init__(self, seed: int, config: ArmConfig | None = None) -> None:
        self.random = random = Random(seed)
        config = configuration() if config is None else config
        self.bounds = bounds_of(config)
        (motion,) = random.choices(MOTIONS, SHARES)
        chosen = with_start(config, random.choice(PERIODS_US), random.choice(("csp", "csp", "csv", "cst")), motion)
        self.driver = driver = Driver(chosen, seed, self._place(random.random() < 0.9))
        self.period_s = chosen.cycle.period_us * 1e-6
        self.deeds = deeds = Deeds(driver, random, self.period_s)
        self.motion = MOTIONS.index(motion) + 1
        self.actions: list[tuple[int, Callable[[], object]]] = [
            (4, self._enable),
            (24, self._begin_motion),
            (5, lambda: deeds.send(Halt())),
            (2, lambda: deeds.send(Disable())),
            (2, lambda: deeds.send(SetDriveMode(random.choice(list(DriveMode))))),
            (4, self._change_motion),
            (2, lambda: deeds.send(SetOutput(deeds.or_odd(random.randrange(0, 18)), random.random() < 0.5))),
            (1, lambda: deeds.send(MoveGripper(random.random() < 0.5))),
            (2, lambda: deeds.send(Reset())),
            (1, lambda: driver.send(random_command(random))),
            (1, lambda: driver.send_raw(self._kind(), [self._number() for _ in range(14)])),
            (1, lambda: driver.send(self._random_move(), lease=random.randrange(3))),
            (1, lambda: driver.fault(random.randrange(6), random.choice(FAULTS))),
            (2, lambda: driver.lose(random.choice((1, 1, 2, 5, 20, 60)), random.random() < 0.5)),
            (1, lambda: driver.drop(random.randrange(1, 8))),
            (2, self._silence),
            (2, self._push),
            (2, deeds.stick),
            (1, deeds.toggle),
            (1, deeds.emergency),
            (3, deeds.limits),
        ]

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
        return self.deeds.or_nonsense(self.random.uniform(-3.0, 3.0))

    def _begin_motion(self) -> None:
        """Mostly one that the control mode takes, now and then another."""
        deeds, motion = self.deeds, self.motion
        if self.random.random() < 0.1:
            motion = self.random.randrange(1, 6)
        if motion == MOTIONS.index("velocity") + 1:
            deeds.velocity()
        elif motion == MOTIONS.index("torque") + 1:
            deeds.torque()
        elif motion == MOTIONS.index("joystick") + 1:
            deeds.stick()
        else:
            self.random.choice(
                (self._move, self._move, deeds.trajectory, deeds.invade, deeds.line, deeds.stream, deeds.jog)
            )()

    def _change_motion(self) -> None:
        (wanted,) = self.random.choices(list(ControlMode), SHARES)
        if self.deeds.send(SetControlMode(wanted)):
            self.motion = wanted

    def _enable(self) -> None:
        if self.random.random() < 0.9:
            self.driver.enable()
        else:
            self.deeds.send(Enable())

    def _random_move(self) -> MoveJoints:
        random, bounds = self.random, self.bounds
        span = random.choice((1.0, 1.0, 0.2, 0.02))
        here = self.driver.commanded
        target = []
        for q, low, high in zip(here, bounds.low, bounds.high, strict=True):
            far = random.uniform(low, high)
            wanted = q + span * (far - q)
            if random.random() < 0.05:
                wanted = random.choice((low, high, low - 1e-3, high + 1e-3))
            target.append(self.deeds.or_nonsense(wanted) if random.random() < 0.1 else wanted)
        if random.random() < 0.2:
            kept = random.randrange(6)
            target = [q if axis != kept else wanted for axis, (q, wanted) in enumerate(zip(here, target, strict=True))]
        speed = random.choice((0.5, 0.5, 0.2, random.uniform(0.0, 0.6)))
        return MoveJoints(tuple(target), self.deeds.or_nonsense(speed), random.random() < 0.5)

    def _move(self) -> None:
        self.deeds.send(self._random_move())

    def _silence(self) -> None:
        self.driver.fall_silent()
        self.driver.wait(int(self.random.uniform(0.0, 0.8) / self.period_s))
        self.driver.acquire()

    def _push(self) -> None:
        axis = self.random.randrange(6)
        self.driver.push(axis, self.random.uniform(-15.0, 15.0))
        self.driver.wait(int(self.random.uniform(0.0, 0.2) / self.period_s))
        self.driver.push(axis, 0.0)

    def play(self) -> Outcome:
        """Play the session to its end and return what came of it."""
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
        judge = driver.judge
        states = Counter({state.name: count for state, count in driver.states.items()})
        return Outcome(
            1, judge.frames, judge.obeyed, judge.frames * self.period_s, driver.taken, driver.refused,
            driver.happenings, states, judge.largest_step, judge.largest_acceleration,
        )  # fmt: skip


def play(seed: int, config: ArmConfig | None = None) -> Outcome:
    """Play the session of `seed`; a failure is in the outcome, with what was done before it."""
    player = None
    try:
        player = Player(seed, config)
        outcome = player.play()
    except Exception as error:
        outcome = Outcome(1)
        outcome.failures.append(
            (seed, [f"{type(error).__name__}: {error}", *(player.driver.log[-12:] if player else ())])
        )
        return outcome
    if player.driver.violations:
        outcome.failures.append((seed, [*player.driver.violations[:4], *player.driver.log[-12:]]))
    return outcome
