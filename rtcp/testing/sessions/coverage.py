"""The coverage of simulated sessions: which commands were sent where, which events and refusals occurred.

A row is a command in a machine state, a control mode and a drive mode, a command during the motion of a controller, an
event, or a refusal. `rows_of` returns the rows that sessions of an arm have to fill. `NOT_REACHED` lists what they
cannot reach, with the reasons.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from rtcp.config.model import ArmConfig, DriveModeName
from rtcp.ipc.commands import COMMANDS, Command
from rtcp.ipc.events import EVENTS, Event
from rtcp.ipc.refusals import REFUSALS, Refusal
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.testing.simulation import Simulation

PLATFORM_COMMANDS = tuple(
    sorted((kind for kind in COMMANDS if kind.__module__ == Command.__module__), key=lambda kind: kind.name)
)
"""All commands of the platform; other packages may register their own."""


def commands_of(simulation: Simulation) -> list[type[Command]]:
    """Return the commands of an arm by name: those of the platform, and those of its processes and controllers."""
    loop = simulation.loop
    kinds = {*PLATFORM_COMMANDS, *loop.arm.controllers}
    for part in loop.parts:
        kinds.update(part.commands)
    return sorted(kinds, key=lambda kind: kind.name)


class NotReached(NamedTuple):
    """An event or a refusal that simulated sessions do not reach."""

    kind: type[Event] | type[Refusal]
    reason: str
    when: Callable[[ArmConfig], bool] = lambda config: True
    """Configurations of which that is so."""


NOT_REACHED: tuple[NotReached, ...] = ()

# -- where a command can be sent --------------------------------------------------------------------------------------


class Place(NamedTuple):
    """Where a command arrives: the machine's state and the modes."""

    state: State
    control_mode: ControlMode
    drive_mode: DriveMode
    """Mode in which the drives hold; they are enabled and homed in CSP."""

    def __str__(self) -> str:
        return " ".join(part.name.lower() for part in self)


_FIXED = {ControlMode.VELOCITY: DriveMode.CSV, ControlMode.TORQUE: DriveMode.CST}
"""Drive modes that control modes set."""


def places_of(config: ArmConfig, drive_modes: Sequence[DriveModeName]) -> list[Place]:
    """Return all places of an arm.

    Without an IO box there is no emergency stop, and without geometry there are no Cartesian modes.
    """
    modes = [
        mode for mode in ControlMode if config.arm is not None or mode.name.lower() in ("joint", "velocity", "torque")
    ]
    chosen = {DriveMode[name.upper()] for name in drive_modes}
    found = []
    for control in modes:
        for drive in sorted(chosen):
            if _FIXED.get(control, drive) is not drive:
                continue
            for state in State:
                homes = drive is DriveMode.CSP and control in (ControlMode.JOINT, ControlMode.CARTESIAN)
                if state is State.OFF or (state is State.HOMING and not homes):
                    continue
                if state is State.EMERGENCY_STOP and config.inputs.emergency_stop is None:
                    continue
                found.append(Place(state, control, drive))
    return found


# -- counts -----------------------------------------------------------------------------------------------------------


@dataclass
class Coverage:
    """Counts of one session, or of many."""

    sent: Counter[str] = field(default_factory=Counter)
    """Command and place, as "halt moving joint csp"."""
    accepted: Counter[str] = field(default_factory=Counter)
    under_way: Counter[str] = field(default_factory=Counter)
    """Command and the controller whose motion was under way, as "halt during jog"."""
    events: Counter[str] = field(default_factory=Counter)
    refusals: Counter[str] = field(default_factory=Counter)

    def command(self, name: str, place: Place, controller: str, refusal: Refusal | None) -> None:
        """Count a command; `controller`: whose motion is under way, or empty."""
        key = f"{name} {place}"
        self.sent[key] += 1
        if controller:
            self.under_way[f"{name} during {controller}"] += 1
        if refusal is None:
            self.accepted[key] += 1
        else:
            self.refusals[refusal.name] += 1

    def add(self, other: Coverage) -> None:
        """Add another's counts."""
        for name, counts in vars(other).items():
            getattr(self, name).update(counts)

    def as_dict(self) -> dict[str, dict[str, int]]:
        """Return the counts for JSON, in the order of the names."""
        return {name: dict(sorted(counts.items())) for name, counts in vars(self).items()}

    def as_json(self) -> str:
        """Return the counts as compact JSON."""
        return json.dumps(self.as_dict(), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Coverage:
        """Return the counts of `as_json`; those of a session without any are empty."""
        return cls(**{name: Counter(counts) for name, counts in json.loads(text or "{}").items()})

    def empty(self, rows: Coverage) -> list[str]:
        """Return the names of the rows that have no count, by the sections of the table."""
        return [
            f"{section}: {name}"
            for section, wanted in vars(rows).items()
            for name in wanted
            if not getattr(self, section)[name]
        ]


def by_state(coverage: Coverage) -> dict[str, dict[State, int]]:
    """Return how often each command was sent in each state: the modes are summed."""
    found: dict[str, dict[State, int]] = {}
    for key, count in coverage.sent.items():
        command, state, *_ = key.split()
        row = found.setdefault(command, {})
        row[State[state.upper()]] = row.get(State[state.upper()], 0) + count
    return dict(sorted(found.items()))


def rows_of(config: ArmConfig, simulation: Simulation, drive_modes: Sequence[DriveModeName]) -> Coverage:
    """Return the rows that sessions of an arm have to fill, each with the count 0."""
    commands = [kind.name for kind in commands_of(simulation)]
    places = places_of(config, drive_modes)
    out_of_reach = {entry.kind for entry in NOT_REACHED if entry.when(config)}
    controllers = {controller.name for controller in simulation.loop.arm.controllers.values()}
    return Coverage(
        sent=_zeros(f"{command} {place}" for command in commands for place in places),
        under_way=_zeros(f"{command} during {name}" for command in commands for name in sorted(controllers)),
        events=_zeros(kind.name for kind in EVENTS if kind not in out_of_reach and kind.__module__ == Event.__module__),
        refusals=_zeros(
            kind.name for kind in REFUSALS if kind not in out_of_reach and kind.__module__ == Refusal.__module__
        ),
    )


def _zeros(names: Iterator[str]) -> Counter[str]:
    return Counter(dict.fromkeys(names, 0))
