"""The coverage of sessions: its rows, their counts, the visits that fill them, and the commands of plug-ins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint
from random import Random
from typing import Any

import pytest

from rtcp.config.model import ProcessConfig
from rtcp.control.part import PartContext
from rtcp.ipc.commands import Command, Halt, MotionCommand, MoveJoints
from rtcp.ipc.events import EVENTS
from rtcp.ipc.refusals import REFUSALS, Refusal, WrongState
from rtcp.ipc.schema import Field
from rtcp.ipc.states import ControlMode, DriveMode, State
from rtcp.motion.controllers import controller
from rtcp.motion.controllers.controller import Controller
from rtcp.motion.state import ArmState, Phase, Setpoint
from rtcp.processes import Process
from rtcp.testing import Simulation
from rtcp.testing.sessions.coverage import NOT_REACHED, Coverage, Place, by_state, places_of, rows_of
from rtcp.testing.sessions.session import Session
from rtcp.testing.sessions.visits import place_of
from tests.sessions.oracle import configuration, reading

CONFIG = replace(configuration(), cycle=replace(configuration().cycle, period_us=4000))
HERE = Place(State.MOVING, ControlMode.JOINT, DriveMode.CSP)


def test_what_is_not_reached_exists_is_named_once_and_has_a_reason() -> None:
    known = {*EVENTS, *REFUSALS}
    named = [kind for entry in NOT_REACHED for kind in entry.kinds]
    assert [kind.__name__ for kind in named if kind not in known] == []
    assert len(set(named)) == len(named)
    assert all(entry.reason for entry in NOT_REACHED)


def test_the_rows_of_an_arm_without_geometry_box_and_gripper_are_fewer() -> None:
    bare = replace(CONFIG, arm=None, gripper=None, inputs=replace(CONFIG.inputs, emergency_stop=None, joystick=None))
    assert "stop cartesian csp" not in " ".join(map(str, places_of(bare)))
    assert {place.state for place in places_of(CONFIG)} - {place.state for place in places_of(bare)} == {
        State.EMERGENCY_STOP
    }
    left_out = [{k for entry in NOT_REACHED if entry.when(config) for k in entry.kinds} for config in (CONFIG, bare)]
    names = [{kind.name for kind in kinds} for kinds in left_out]
    assert {"box_reached", "gripper_opens", "emergency_stop_activated"} <= names[1] - names[0]
    assert {"no_geometry", "no_gripper"} <= names[0] - names[1]


def test_counts_are_added_written_as_json_and_read_again() -> None:
    one, other = Coverage(), Coverage()
    one.command("halt", HERE, "jog", None)
    other.command("halt", HERE._replace(state=State.READY), "", None)
    other.command("enable", HERE, "", WrongState(1, State.MOVING))
    other.events["ready"] += 1
    one.add(Coverage.from_json(other.as_json()))
    assert one.as_dict() == {
        "sent": {"enable moving joint csp": 1, "halt moving joint csp": 1, "halt ready joint csp": 1},
        "accepted": {"halt moving joint csp": 1, "halt ready joint csp": 1},
        "under_way": {"halt during jog": 1},
        "events": {"ready": 1},
        "refusals": {"wrong_state": 1},
    }
    assert by_state(one) == {"enable": {State.MOVING: 1}, "halt": {State.MOVING: 1, State.READY: 1}}
    assert Coverage.from_json("") == Coverage()


def test_a_row_without_a_count_is_named() -> None:
    with Simulation(CONFIG) as simulation:
        rows = rows_of(simulation)
    coverage = Coverage(**{name: Counter(dict.fromkeys(counts, 1)) for name, counts in vars(rows).items()})
    assert coverage.empty(rows) == []
    del coverage.sent["halt moving joint csp"], coverage.events["arrived"]
    assert coverage.empty(rows) == ["sent: halt moving joint csp", "events: arrived"]


def test_consecutive_sessions_visit_all_places_and_then_all_commands_of_each() -> None:
    places = places_of(CONFIG)
    visits = [place_of(number, places) for number in range(2 * len(places))]
    assert {place for place, _ in visits[: len(places)]} == set(places)
    assert {round_ for _, round_ in visits[len(places) :]} == {1}


@pytest.mark.parametrize(
    "place",
    [
        Place(State.STARTING, ControlMode.JOINT, DriveMode.CSP),
        Place(State.ENABLING, ControlMode.TORQUE, DriveMode.CST),
        Place(State.MOVING, ControlMode.JOYSTICK, DriveMode.CSV),
        Place(State.STOPPED_BY_LIMIT, ControlMode.CARTESIAN, DriveMode.CSV),
        Place(State.RESETTING, ControlMode.CARTESIAN, DriveMode.CST),
        Place(State.HOMING, ControlMode.JOINT, DriveMode.CSP),
        Place(State.CLOSING, ControlMode.TORQUE, DriveMode.CST),
    ],
    ids=str,
)
def test_a_visit_sends_commands_at_its_place(place: Place) -> None:
    places = places_of(CONFIG)
    number = next(number for number in range(len(places)) if place_of(number, places)[0] == place)
    session = Session(Random(1), CONFIG, reading(), number=number)
    try:
        session.visit.run(5.0)
        session.visit.end()
        assert sum(count for key, count in session.commander.coverage.sent.items() if key.endswith(f" {place}")) > 0
        assert session.commander.checker.violations == []
    finally:
        session.commander.close()


def test_a_stop_overtakes_a_command_that_waits() -> None:
    session = Session(Random(1), CONFIG, reading(), number=0)
    commander = session.commander
    try:
        commander.start()
        commander.enable()
        assert commander.simulation.until(lambda: commander.state is State.HOLDING, 1.0)
        commander.overtake(MoveJoints(tuple(commander.commanded), 0.1, True), Halt)
        assert (commander.refused["move_joints"], commander.taken["halt"]) == (1, 1)
        assert commander.coverage.refusals["superseded"] == 1
    finally:
        commander.close()


# -- a plug-in --------------------------------------------------------------------------------------------------------


class Nod(MotionCommand):
    """A motion of a plug-in: the joints rest for some cycles."""

    cycles: int
    text: str


class Tick(Command):
    """A command of a plug-in's process."""

    states = frozenset(State)


class Nodding(Controller):
    """Accepts `Nod`."""

    name = "nodding"
    commands = (Nod,)

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        assert isinstance(command, Nod)
        self.begin()
        self._left = min(command.cycles, 100)
        return None

    def advance(self, state: ArmState) -> Setpoint:
        self._left -= 1
        if self._left <= 0:
            self.phase = Phase.HOLD
        return self.rest(state)


@dataclass(frozen=True)
class TickingConfig(ProcessConfig):
    """A process that counts its commands."""

    PROCESS = "tests.sessions.test_coverage:Ticking"
    COMMANDS = (Tick,)


class Ticking(Process):
    """See `TickingConfig`."""

    def fields(self) -> Sequence[Field]:
        return (Field("ticks", "uint8"),)

    def accept(self, command: Command, lease: int) -> Refusal | None:
        return None

    def update(self, context: PartContext) -> None:
        pass

    def publish(self, values: list[Any], at: int) -> None:
        values[at] = 0

    def safe(self) -> None:
        pass


def test_the_commands_of_a_plug_in_are_sent_and_are_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    installed = controller.installed()
    added = (EntryPoint("nodding", "tests.sessions.test_coverage:Nodding", "rtcp.controllers"), Nodding)
    monkeypatch.setattr(controller, "installed", lambda: (*installed, added))
    config = replace(CONFIG, processes=(TickingConfig("ticking", "ticking"),))
    session = Session(Random(2), config, reading(), number=0)
    commander = session.commander
    try:
        assert {Nod, Tick} <= set(commander.kinds)
        rows = rows_of(commander.simulation)
        assert {"nod moving joint csp", "tick closing torque cst"} <= set(rows.sent)
        assert {"tick during nodding", "nod during jog"} <= set(rows.under_way)
        commander.start()
        for kind in (Nod, Tick):
            session.send_likely(kind)
        assert {key.split()[0] for key in commander.coverage.sent} == {"nod", "tick"}
        assert commander.taken["tick"] == 1
    finally:
        commander.close()
