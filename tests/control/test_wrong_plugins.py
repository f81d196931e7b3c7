"""Whatever a plug-in returns or raises is a typed fault with its name, and the loop goes on."""

from __future__ import annotations

import asyncio
import inspect
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any, cast

import pytest

from rtcp.config import default_config, find, load
from rtcp.config.find import definition_of, made_by
from rtcp.config.model import ArmConfig, InputsConfig, OutputsConfig, PluginError, SlaveConfig
from rtcp.control.part import Device, PartContext, PluginTimer
from rtcp.control.processes import ProcessPart
from rtcp.devices.cia402 import DISABLE_VOLTAGE, QUICK_STOP, Cia402Drive
from rtcp.devices.drive import Drive, TargetState
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
from tests.control.rig import CONFIG, LONGEST_STEP, LoopRig


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
    slow_method = "update"
    takes_ns = 0

    def __init__(self, config: StoveConfig, setup: ProcessSetup) -> None:
        super().__init__(config, setup)
        self._output = setup.signals[config.outputs]
        self.simulation: Simulation

    def _take_time(self, method: str) -> None:
        if self.takes_ns and self.slow_method == method:
            self.simulation.now_ns += self.takes_ns

    def fields(self) -> Sequence[Field]:
        return (Field("level", "uint8"),)

    def accept(self, command: Command, lease: int) -> Refusal | None:
        self._take_time("accept")
        return misbehave(self.what) if self.method == "accept" else None

    def update(self, context: PartContext) -> None:
        self._take_time("update")
        if self.method == "update":
            misbehave(self.what)
        elif self.method == "report":
            context.report(self.what)
        self._output.value = self.what if self.method == "output" else 1.0

    def publish(self, values: list[Any], at: int) -> None:
        self._take_time("publish")
        values[at : at + 1] = misbehave(self.what) if self.method == "publish" else [7]

    def safe(self) -> None:
        self._take_time("safe")
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

    def decode(self, data: bytes) -> None:
        super().decode(data)
        if self.method == "decode":
            self.values[next(iter(self.values))] = misbehave(self.what)

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


def install(monkeypatch: pytest.MonkeyPatch, driver: type[Driver], only: str = "") -> None:
    """Let every kind of device, or one, have a driver of this module, as if a package had registered it."""
    registered = find.installed(ENTRY_POINTS)
    entries = EntryPoints(
        EntryPoint(entry.name, f"{__name__}:{driver.__name__}", entry.group) if only in ("", entry.name) else entry
        for entry in registered
    )
    installed = find.installed
    monkeypatch.setattr(find, "installed", lambda group: entries if group == ENTRY_POINTS else installed(group))


@cases(
    ("update", WRONG_EVENTS | EXCEPTIONS),
    ("encode", {"none": None, "a text": "on", "too short": b"", "too long": bytes(99), **EXCEPTIONS}),
    ("publish", WRONG_VALUES),
    ("accept", WRONG_REFUSALS),
    ("decode", {"none": None, "a text": "on", **EXCEPTIONS}),
)
def test_a_driver_that_misbehaves_is_a_fault_of_its_slave(
    config: ArmConfig, monkeypatch: pytest.MonkeyPatch, method: str, what: Any
) -> None:
    install(monkeypatch, Meter)
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


# -- drives -----------------------------------------------------------------------------------------------------------


class Servo(Drive):
    """A driver of a drive that misbehaves; else it does what the driver of this package does."""

    REQUIRED_OUTPUTS = Cia402Drive.REQUIRED_OUTPUTS
    REQUIRED_INPUTS = Cia402Drive.REQUIRED_INPUTS
    method = ""
    what: Any = None
    takes_ns = 0
    _MEASURED = ("position", "velocity", "torque", "state", "mode_display", "statusword", "target_position")
    _COMMANDED = ("mode", "target_position", "target_velocity", "target_torque", "speed_limit", "low", "high", "zero")

    def __init__(self, slave: SlaveConfig, period_s: float) -> None:
        super().__init__(slave, period_s)
        self._right = Cia402Drive(slave, period_s)
        self.simulation: Simulation

    def supports(self, mode: int) -> bool:
        return self._right.supports(mode)

    def _do(self, method: str, *arguments: Any) -> Any:
        if self.method == method:
            return misbehave(self.what)
        if self.takes_ns:
            self.simulation.now_ns += self.takes_ns
        for name in self._COMMANDED:
            setattr(self._right, name, getattr(self, name))
        result = getattr(self._right, method)(*arguments)
        for name in self._MEASURED:
            setattr(self, name, getattr(self._right, name))
        if method == "decode" and self.method in self._MEASURED:
            setattr(self, self.method, self.what)
        return result

    def decode(self, data: bytes) -> None:
        self._do("decode", data)

    def advance(self, target: TargetState) -> bool:
        return bool(self._do("advance", target))

    def encode(self) -> bytes:
        return cast(bytes, self._do("encode"))


@pytest.fixture
def servo(monkeypatch: pytest.MonkeyPatch, new_rig: Callable[..., LoopRig]) -> tuple[LoopRig, Servo]:
    """A rig whose drives have the driver that misbehaves, and that of the first joint."""
    install(monkeypatch, Servo, "cia402")
    rig = new_rig()
    drive = rig.arm.drives[0]
    assert isinstance(drive, Servo)
    return rig, drive


@cases(
    ("decode", EXCEPTIONS),
    ("advance", EXCEPTIONS),
    ("encode", {"none": None, "a text": "on", "too short": b"", "too long": bytes(99), **EXCEPTIONS}),
    ("position", {"none": None, "a text": "ab"}),
    ("velocity", {"none": None}),
    ("torque", {"none": None}),
    ("target_position", {"none": None}),
    ("statusword", {"beyond its type": 70000, "none": None}),
    ("mode_display", {"none": None}),
    ("state", {"none": None, "a number": 3}),
)
def test_a_driver_of_a_drive_that_misbehaves_is_a_fault_of_its_slave(
    servo: tuple[LoopRig, Servo], method: str, what: Any
) -> None:
    rig, drive = servo
    rig.set_in_motion()
    if method == "advance":
        rig.do(Disable())
    drive.method, drive.what = method, what
    rig.wait(lambda: rig.state is State.FAULT, 2.0)
    assert rig.kinds.count(DriverFailed) == 1
    assert rig.last_of(DriverFailed) == DriverFailed(2)
    rig.run(0.5)
    first, second = rig.log[-1].drives
    # Disabling continues without torque at standstill.
    assert first.controlword == second.controlword == (DISABLE_VOLTAGE if method == "advance" else QUICK_STOP)
    assert rig.models[0].mechanics.velocity == pytest.approx(0.0, abs=1e-3)
    rig.do(Disable())
    rig.run(0.1)
    assert not any(rig.powered)
    drive.method = ""
    rig.recover()
    rig.move(0.5, 0.5)
    rig.run(0.1)
    assert rig.state is State.MOVING
    assert rig.longest_step(0) <= LONGEST_STEP


def test_a_driver_of_a_drive_that_still_raises_in_the_reset_is_a_fault_again(servo: tuple[LoopRig, Servo]) -> None:
    rig, drive = servo
    rig.hold()
    drive.method, drive.what = "decode", KeyError("heat")
    rig.wait(lambda: rig.state is State.FAULT, 0.1)
    rig.do(Reset())
    rig.run(0.05)
    assert rig.state is State.FAULT
    assert rig.kinds.count(DriverFailed) == 2


# -- time -------------------------------------------------------------------------------------------------------------


def slow_plugins(simulation: Simulation) -> list[str]:
    """Return the plug-ins that were named as slow."""
    return [record.event.plugin for record in simulation.events if isinstance(record.event, PluginSlow)]


def test_a_slow_driver_of_a_drive_is_named_by_its_slave(servo: tuple[LoopRig, Servo]) -> None:
    rig, drive = servo
    rig.start()
    drive.simulation, drive.takes_ns = rig, rig.period_ns * 3 // 4
    rig.run(0.02)
    assert slow_plugins(rig) == [CONFIG.slaves[1].name]


@pytest.mark.parametrize("method", ["accept", "publish", "safe"])
def test_each_call_of_a_slow_process_is_timed(running: Simulation, method: str) -> None:
    part = next(part for part in running.loop.parts if isinstance(part, ProcessPart))
    assert isinstance(part.process, Stove)
    part.process.simulation, part.process.slow_method = running, method
    part.process.takes_ns = running.period_ns * 3 // 4
    if method == "accept":
        running.do(Poke())
    elif method == "safe":
        running.loop.machine.context.report(DriverFailed(1))
    running.run(0.02)
    assert slow_plugins(running) == ["stove"]


def test_a_controller_that_is_slow_to_accept_is_named(rig: LoopRig) -> None:
    rig.hold()
    controller = swinger(rig)
    controller.simulation, controller.takes_ns = rig, rig.period_ns * 3 // 4
    rig.do(Swing())
    assert slow_plugins(rig) == ["controller swinger"]


def test_every_slow_plug_in_is_named_although_another_was_named_just_before() -> None:
    named: list[Event] = []
    timer = PluginTimer(lambda: 600_000, 1_000_000, named.append)
    for plugin in ("stove", "meter", "stove", "meter"):
        timer.check(plugin, 0)
    assert named == [PluginSlow("stove", 600.0, 500.0), PluginSlow("meter", 600.0, 500.0)]


# -- controllers ------------------------------------------------------------------------------------------------------


class Swinger(Controller):
    """A controller that misbehaves while it moves the first joint slowly."""

    name = "swinger"
    commands = (Swing,)
    method = ""
    what: Any = None
    simulation: Simulation
    takes_ns = 0

    def accept(self, command: Command, state: ArmState, continues: bool) -> Refusal | None:
        if self.takes_ns:
            self.simulation.now_ns += self.takes_ns
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
    install(monkeypatch, Meter)
    monkeypatch.setattr(Meter, "fields", lambda meter: ["level"])
    with pytest.raises(PluginError, match="allowed are fields of the record"):
        Simulation(replace(config, processes=()))
