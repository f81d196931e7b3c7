"""Whatever a plug-in returns or raises is a typed fault with its name, and the loop goes on."""

from __future__ import annotations

import asyncio
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config, find, load
from rtcp.config.find import definition_of, made_by
from rtcp.config.model import ArmConfig, InputsConfig, OutputsConfig, PluginError
from rtcp.control.part import Device, PartContext
from rtcp.control.processes import ProcessPart
from rtcp.devices.driver import ENTRY_POINTS, DeviceError, Driver
from rtcp.ipc.commands import Command, Disable, Halt, MotionCommand, Reset, Shutdown
from rtcp.ipc.events import ControllerRaised, DriverFailed, ErrorReported, Event, PluginSlow, ProcessFailed, Stopped
from rtcp.ipc.events import StreamEnded as EndOfMotion
from rtcp.ipc.refusals import ControllerRaised as MotionRefused
from rtcp.ipc.refusals import DriverRaised, Malformed, ProcessRaised, Refusal
from rtcp.ipc.schema import Field
from rtcp.ipc.states import State
from rtcp.ipc.stop_reactions import longest_s
from rtcp.motion.controllers import controller as controllers
from rtcp.motion.controllers.controller import Controller, ControllerSetup
from rtcp.motion.state import ArmState, Setpoint
from rtcp.processes import OutputChannel, Process, ProcessConfig, ProcessSetup
from rtcp.testing.simulation import Simulation
from tests.control.rig import CONFIG, LoopRig


class Poke(Command):
    """A command of the process under test."""

    states = frozenset(State)


class Swing(MotionCommand):
    """A motion of the controller under test."""


class Picky(Command):
    """A command that checks its field with an exception of its own kind."""

    states = frozenset(State)
    most: int

    def __post_init__(self) -> None:
        if self.most > 3:
            raise KeyError(self.most)


class Gone(Refusal):
    """{text}"""

    text: str


def misbehave(what: Any) -> Any:
    """Raise an exception, or return a value."""
    if isinstance(what, BaseException):
        raise what
    return what


WRONG: Any = None
EXCEPTIONS = {
    "an exception": KeyError("heat"),
    "the end of the process": SystemExit(1),
    "a cancelled task": asyncio.CancelledError(),
}
WRONG_EVENTS: dict[str, Any] = {
    "a text": "hot",
    "a number": 5,
    "a class": Stopped,
    "a wrong field": ErrorReported(WRONG),
    "the end of a motion": EndOfMotion(),
}
WRONG_REFUSALS: dict[str, Any] = {"a text": "no", "true": True, "a wrong field": Gone(WRONG), **EXCEPTIONS}
WRONG_VALUES: dict[str, Any] = {
    "none": [None],
    "a text": ["hot"],
    "beyond its type": [300],
    "no number of its type": [math.nan],
    "too many": [1, 2],
    "too few": [],
    **EXCEPTIONS,
}


def cases(*named: tuple[str, dict[str, Any]]) -> pytest.MarkDecorator:
    """Return the parameters of a test: the method that misbehaves, and how."""
    return pytest.mark.parametrize(
        ("method", "what"),
        [pytest.param(method, what, id=f"{method}: {name}") for method, hows in named for name, what in hows.items()],
    )


# -- a platform of one box --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class StoveConfig(ProcessConfig):
    """A process that misbehaves."""

    PROCESS = "tests.control.test_wrong_plugins:Stove"
    COMMANDS = (Poke,)
    outputs: OutputChannel = "io.outputs"


class Stove(Process):
    """See `StoveConfig`."""

    method = ""
    what: Any = None
    takes_ns = 0

    def __init__(self, config: StoveConfig, setup: ProcessSetup) -> None:
        super().__init__(config, setup)
        self._output = setup.signals[config.outputs]
        self.simulation: Simulation

    def fields(self) -> Sequence[Field]:
        return (Field("level", "uint8"),)

    def accept(self, command: Command, lease: int) -> Refusal | None:
        return misbehave(self.what) if self.method == "accept" else None

    def update(self, context: PartContext) -> None:
        if self.takes_ns:
            self.simulation.now_ns += self.takes_ns
        if self.method == "update":
            misbehave(self.what)
        elif self.method == "report":
            context.report(self.what)
        self._output.value = self.what if self.method == "output" else 1.0

    def publish(self, values: list[Any], at: int) -> None:
        values[at : at + 1] = misbehave(self.what) if self.method == "publish" else [7]

    def safe(self) -> None:
        if self.method == "safe":
            misbehave(self.what)


@pytest.fixture
def config(tmp_path: Path) -> ArmConfig:
    (tmp_path / "segment.yaml").write_text("slaves: [{model: diewu-io}]\n")
    box = load(default_config())
    slave = replace(box.slaves[0], device=replace(box.slaves[0].device, kind="generic"))
    platform = replace(box, joints=(), slaves=(slave,), arm=None, source=tmp_path / "stove.yaml", gripper=None)
    return replace(platform, inputs=InputsConfig(), outputs=OutputsConfig(), processes=(StoveConfig("stove", "stove"),))


@pytest.fixture
def running(config: ArmConfig) -> Iterator[Simulation]:
    with Simulation(config) as made:
        made.bring_to(State.READY)
        made.acquire()
        yield made


def count(simulation: Simulation, kind: type[Event]) -> int:
    return sum(isinstance(record.event, kind) for record in simulation.events)


def recovers(simulation: Simulation) -> bool:
    """Return whether the machine, which is in fault, is ready after a reset."""
    simulation.run(0.05)
    assert simulation.state is State.FAULT
    simulation.do(Reset())
    simulation.bring_to(State.READY)
    simulation.run(0.05)
    return simulation.state is State.READY


@cases(
    ("update", EXCEPTIONS),
    ("report", WRONG_EVENTS),
    ("output", {"none": None, "a text": "on", "not a number": math.nan, "infinite": math.inf}),
    ("publish", WRONG_VALUES),
    ("accept", WRONG_REFUSALS),
)
def test_a_process_that_misbehaves_is_a_fault_of_that_process(running: Simulation, method: str, what: Any) -> None:
    part = next(part for part in running.loop.parts if isinstance(part, ProcessPart))
    assert isinstance(part.process, Stove)
    part.process.method, part.process.what = method, what
    if method == "accept":
        assert running.send(Poke()).refusal == ProcessRaised(0)
    running.bring_to(State.FAULT, 0.1)
    assert count(running, ProcessFailed) == 1
    part.process.method = ""
    assert recovers(running)
    latest = running.observer.latest()
    assert latest is not None
    assert int(latest["stove_level"][0]) == 7


class Meter(Driver):
    """A driver that misbehaves."""

    method = ""
    what: Any = None
    commands = ()

    def accept(self, command: Command) -> Refusal | None:
        return misbehave(self.what) if self.method == "accept" else None

    def update(self, state: State, now_ns: int) -> Event | None:
        return misbehave(self.what) if self.method == "update" else None

    def encode(self) -> bytes:
        return misbehave(self.what) if self.method == "encode" else super().encode()

    def fields(self) -> Sequence[Field]:
        return (Field("level", "uint8"),)

    def publish(self, values: list[Any], at: int) -> None:
        values[at : at + 1] = misbehave(self.what) if self.method == "publish" else [7]


def install_meter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every kind of device have the driver that misbehaves, as if a package had registered it."""
    registered = find.installed(ENTRY_POINTS)
    meters = EntryPoints(EntryPoint(entry.name, f"{__name__}:{Meter.__name__}", entry.group) for entry in registered)
    installed = find.installed
    monkeypatch.setattr(find, "installed", lambda group: meters if group == ENTRY_POINTS else installed(group))


@cases(
    ("update", WRONG_EVENTS | EXCEPTIONS),
    ("encode", {"none": None, "a text": "on", "too short": b"", "too long": bytes(99), **EXCEPTIONS}),
    ("publish", WRONG_VALUES),
    ("accept", WRONG_REFUSALS),
)
def test_a_driver_that_misbehaves_is_a_fault_of_its_slave(
    config: ArmConfig, monkeypatch: pytest.MonkeyPatch, method: str, what: Any
) -> None:
    install_meter(monkeypatch)
    with Simulation(replace(config, processes=())) as running:
        running.bring_to(State.READY)
        running.acquire()
        device = next(part for part in running.loop.parts if isinstance(part, Device))
        assert isinstance(device.driver, Meter)
        device.driver.method, device.driver.what = method, what
        if method == "accept":
            assert device.accept(Poke(), 0) == DriverRaised(1)
        running.bring_to(State.FAULT, 0.1)
        assert count(running, DriverFailed) == 1
        device.driver.method = ""
        assert recovers(running)


def test_a_plug_in_that_takes_too_long_is_named_and_not_in_every_cycle(running: Simulation) -> None:
    part = next(part for part in running.loop.parts if isinstance(part, ProcessPart))
    assert isinstance(part.process, Stove)
    part.process.simulation = running
    part.process.takes_ns = running.period_ns // 2
    running.run(0.1)
    assert count(running, PluginSlow) == 0
    part.process.takes_ns += 1000
    running.run(0.1)
    (slow,) = [record.event for record in running.events if isinstance(record.event, PluginSlow)]
    assert slow == PluginSlow("stove", part.process.takes_ns * 1e-3, running.period_ns * 0.5e-3)


# -- controllers ------------------------------------------------------------------------------------------------------


class Swinger(Controller):
    """A controller that misbehaves while it moves the first joint slowly."""

    name = "swinger"
    commands = (Swing,)
    method = ""
    what: Any = None

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        if self.method == "accept":
            return misbehave(self.what)
        self.begin()
        self._position = list(state.commanded)
        return None

    def advance(self, state: ArmState) -> Setpoint:
        setpoint, n = self.setpoint, len(state.commanded)
        self._position[0] += 1e-7
        setpoint.position, setpoint.velocity = list(self._position), [0.0] * n
        if self.method == "advance":
            return misbehave(self.what)
        setpoint.direct = self.method in ("torque", "weight")
        if self.method in ("position", "velocity", "torque", "weight"):
            setattr(setpoint, self.method, self.what)
        elif self.method in ("ended", "duration_s", "held"):
            setattr(self, self.method, self.what)
        return setpoint

    def stop(self, state: ArmState) -> None:
        if self.method == "stop":
            misbehave(self.what)
        else:
            super().stop(state)

    def hold(self) -> None:
        super().hold()
        self.ended, self.duration_s, self.held = None, 0.0, 0


def swinger(rig: LoopRig) -> Swinger:
    """Return the controller, which the arm then has."""
    arm = rig.arm
    setup = ControllerSetup(CONFIG, arm.limits, arm.trajectory_guard, rig.context.period_s, rig.board.plan)
    made = arm.controllers[Swing] = Swinger(setup)
    return made


NUMBERS: dict[str, Any] = {"none": None, "a text": "ab", "too few": [0.0], "too many": [0.0] * 3, "texts": ["a", "b"]}


@cases(
    ("accept", WRONG_REFUSALS),
    ("advance", {"none": None, "a text": "ab", **EXCEPTIONS}),
    ("position", NUMBERS),
    ("velocity", NUMBERS),
    ("torque", NUMBERS | {"not a number": [0.0, math.nan]}),
    ("weight", NUMBERS | {"infinite": [math.inf, 0.0]}),
    ("ended", {"a text": "done", "another event": Stopped()}),
    ("duration_s", {"none": None, "a text": "long"}),
    ("held", {"none": None, "a text": "all"}),
)
def test_a_controller_that_misbehaves_is_a_fault_of_that_controller(rig: LoopRig, method: str, what: Any) -> None:
    rig.hold()
    controller = swinger(rig)
    if method != "accept":
        rig.do(Swing())
        rig.run(0.02)
        assert rig.state is State.MOVING
    controller.method, controller.what = method, what
    if method == "accept":
        assert rig.send(Swing()).refusal == MotionRefused("swinger")
    rig.wait(lambda: rig.state is State.FAULT, 0.1)
    assert rig.kinds.count(ControllerRaised) == 1
    assert rig.last_of(ControllerRaised) == ControllerRaised("swinger")
    controller.method = ""
    rig.recover()
    rig.do(Swing())
    rig.run(0.02)
    assert rig.state is State.MOVING
    assert rig.longest_step(0) <= 1


STOPS: dict[str, Callable[[LoopRig], object]] = {
    "halt": lambda rig: rig.do(Halt()),
    "disable": lambda rig: rig.do(Disable()),
    "shutdown": lambda rig: rig.do(Shutdown()),
    "the lease ends": lambda rig: rig.observer.release(rig.lease),
    "its own end": lambda rig: setattr(rig.arm.active, "ended", EndOfMotion()),
}


@pytest.mark.parametrize("stop", STOPS.values(), ids=STOPS.keys())
@pytest.mark.parametrize("what", [None, *EXCEPTIONS.values()], ids=["nothing", *EXCEPTIONS])
def test_the_arm_stops_whatever_the_stop_of_a_controller_does(
    rig: LoopRig, stop: Callable[[LoopRig], object], what: Any
) -> None:
    rig.hold()
    controller = swinger(rig)
    rig.do(Swing())
    rig.run(0.02)
    controller.method, controller.what = "stop", what
    stop(rig)
    rig.wait(lambda: ControllerRaised in rig.kinds, 2.5 * longest_s(CONFIG))
    assert rig.last_of(ControllerRaised) == ControllerRaised("swinger")
    rig.run(0.2)
    stands = list(rig.arm.state.commanded)
    if rig.state is not State.OFF:
        assert rig.state is State.FAULT
        rig.run(0.2)
    assert rig.arm.state.commanded == stands
    assert rig.longest_step(0) <= 1


def test_a_controller_may_take_longer_to_stop_under_lower_accelerations(rig: LoopRig) -> None:
    rig.hold()
    controller = swinger(rig)
    rig.arm.limits.acceleration[0] /= 3.0
    rig.do(Swing())
    rig.run(0.02)
    controller.method = "stop"
    rig.do(Halt())
    rig.run(2.5 * longest_s(CONFIG))
    assert rig.state is State.STOPPING
    rig.wait(lambda: rig.state is State.FAULT, 4.0 * longest_s(CONFIG))


def test_a_setpoint_that_is_no_number_ends_the_motion_at_a_guard(rig: LoopRig) -> None:
    rig.hold()
    controller = swinger(rig)
    rig.do(Swing())
    rig.run(0.02)
    controller.method, controller.what = "position", [math.nan, math.nan]
    rig.run(0.1)
    assert rig.state is State.STOPPED_BY_LIMIT


# -- at load ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [KeyError("heat"), SystemExit(1), ValueError("5"), TypeError("no argument")])
def test_a_plug_in_that_cannot_be_made_is_refused_at_load_with_file_and_line(error: BaseException) -> None:
    entry = EntryPoint("stove", "tests.control.test_wrong_plugins:Stove", "rtcp.processes")
    message = rf"stove.*{type(error).__name__}.*{Path(__file__).name}, line \d+"
    with pytest.raises(PluginError, match=message), made_by(entry):
        raise error
    with pytest.raises(DeviceError, match="a channel is missing"), made_by(entry):
        raise DeviceError("a channel is missing")


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        *[("name", None), ("name", ""), ("commands", None), ("commands", (Poke,)), ("commands", ["swing"])],
        *[("control_modes", None), ("control_modes", frozenset()), ("control_modes", {"joint"})],
    ],
)
def test_a_controller_with_a_wrong_attribute_is_refused_at_load_with_file_and_line(
    rig: LoopRig, monkeypatch: pytest.MonkeyPatch, attribute: str, value: Any
) -> None:
    kind = type("Wrong", (Swinger,), {"__module__": __name__, attribute: value})
    monkeypatch.setattr(f"{__name__}.Wrong", kind, raising=False)
    entry = EntryPoint("wrong", f"{__name__}:Swinger", "rtcp.controllers")
    monkeypatch.setattr(controllers, "installed", lambda: ((entry, kind),))
    arm = rig.arm
    setup = ControllerSetup(CONFIG, arm.limits, arm.trajectory_guard, rig.context.period_s, rig.board.plan)
    with pytest.raises(PluginError, match=rf"wrong.*`{attribute}` is .*allowed is.*Wrong"):
        controllers.load_controllers(setup)


def test_a_finding_about_a_class_names_its_file_and_line() -> None:
    assert definition_of(Stove) == f"{__file__}, line {inspect.getsourcelines(Stove)[1]}"


def test_a_command_whose_check_raises_is_malformed(rig: LoopRig) -> None:
    rig.start()
    command = Picky(1)
    object.__setattr__(command, "most", 5)
    assert rig.send(command).refusal == Malformed(Picky.number)
    rig.enable()


def test_fields_that_are_none_are_refused_at_load(config: ArmConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    install_meter(monkeypatch)
    monkeypatch.setattr(Meter, "fields", lambda meter: ["level"])
    with pytest.raises(PluginError, match="allowed are fields of the record"):
        Simulation(replace(config, processes=()))
