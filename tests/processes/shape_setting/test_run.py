"""The early end of a run: heat first, then motion, even if a part does not answer."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import struct
import threading
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rtcp.api import RtcpError, State
from rtcp.api.cell import rod_file
from rtcp.config.find import default_config
from rtcp.processes.rod import Rod, integrate
from rtcp.processes.shape_setting import run as module
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.heat_profile import target_ratio
from rtcp.processes.shape_setting.interlocks import Mode
from rtcp.processes.shape_setting.job import read_job
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.processes.shape_setting.run import Outcome, ShapeSettingRun


class FakeRobot:
    """The heater's platform over a connection of its own; it records its calls."""

    def __init__(self, done: list[str], answers: bool, **fields: float) -> None:
        self._done, self._answers, self.fields = done, answers, fields

    def __enter__(self) -> FakeRobot:
        if not self._answers:
            raise RtcpError("lost", "the platform closed the connection")
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def command(self, name: str) -> None:
        self._done.append(name)

    def halt(self) -> None:
        self._done.append("halt")

    def call(self, method: str) -> None:
        assert method == "halt"
        self.halt()

    @property
    def processes(self) -> dict[str, Any]:
        return {"heater": SimpleNamespace(fields={**OFF, **self.fields})}


def connect_by(monkeypatch: pytest.MonkeyPatch, connect: Callable[[str, Path], FakeRobot]) -> None:
    """Connect the run to fake robots, also for its stops, which need no connection to a gateway."""
    monkeypatch.setattr(module, "Robot", connect)
    monkeypatch.setattr(module, "ControlClient", connect)


OFF = {
    "latched": 1 << 10, "forbids": 1 << 3, "gate": 0, "relay": 0, "relay_closed": 0, "gate_sense": 0, "current": 0.01,
    "inputs_alive": 1, "middle_temperature": 0.0,
}  # fmt: skip


@pytest.fixture
def run(tmp_path: Path) -> ShapeSettingRun:
    """A run whose cell has one arm and the heater."""
    run = object.__new__(ShapeSettingRun)
    members = [SimpleNamespace(directory=tmp_path / name) for name in ("left", "heater")]
    run._member = members[1]  # type: ignore[assignment]
    run._cell = SimpleNamespace(config=SimpleNamespace(members=members))  # type: ignore[assignment]
    run._name, run.outcome, run.heat_is_off = "heater", Outcome(), False
    run._lock = module._lock(tmp_path / "shape-set.lock")
    run._config = ShapeSettingConfig("shape_setting", "heater", arms=("left", "right"))
    return run


@pytest.mark.parametrize(
    ("answers", "expected"), [(True, ["stop_heating", "halt", "halt"]), (False, [])], ids=["", "silent"]
)
@pytest.mark.parametrize("ending", [KeyboardInterrupt(), RtcpError("fault", "x"), ValueError()], ids=repr)
def test_what_ends_a_run_turns_the_heat_off_before_it_stops_the_arms(
    run: ShapeSettingRun,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    ending: BaseException,
    answers: bool,
    expected: list[str],
) -> None:
    done: list[str] = []
    connect_by(monkeypatch, lambda name, path: FakeRobot(done, answers))

    def fail(self: ShapeSettingRun) -> None:
        raise ending

    monkeypatch.setattr(ShapeSettingRun, "_steps", fail)
    monkeypatch.setattr(ShapeSettingRun, "_draw", lambda self, path: path.write_text("[]"))
    with pytest.raises(type(ending)):
        run.run()
    assert done == expected
    assert run.heat_is_off is answers
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert not rod_file(tmp_path).exists()
    if answers:
        assert run.outcome.interlocks["arm_lost"] == "latched"
        assert run.outcome.interlocks["arms_permitted"] == "forbids"
        assert run.outcome.interlocks["fuse"] == "good"


@pytest.mark.parametrize(
    "fields",
    [{"relay_closed": 1}, {"gate_sense": 1}, {"current": -30.0}, {"current": float("nan")}, {"inputs_alive": 0}],
    ids=str,
)
def test_heat_counts_as_off_only_by_what_is_measured(
    run: ShapeSettingRun, monkeypatch: pytest.MonkeyPatch, fields: dict[str, float]
) -> None:
    monkeypatch.setattr(module, "_RELAY_S", 0.1)
    connect_by(monkeypatch, lambda name, path: FakeRobot([], True, **fields))
    run._stop()
    assert not run.heat_is_off
    assert run.outcome.interlocks["arm_lost"] == "latched"


def test_what_hangs_keeps_neither_heat_nor_arms_from_stopping(
    run: ShapeSettingRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    hang = threading.Event()

    def connect(name: str, path: Path) -> FakeRobot:
        if path.parent.name == "heater":
            hang.wait()
        return FakeRobot(done, True)

    monkeypatch.setattr(module, "_HEAT_FIRST_S", 0.1)
    monkeypatch.setattr(module, "_STOP_S", 0.5)
    connect_by(monkeypatch, connect)
    run._stop()  # it ends, though a part hangs
    assert done == ["halt"]
    assert not run.heat_is_off
    hang.set()


def test_the_arms_stop_once_the_heat_is_commanded_off_while_the_relay_still_opens(
    run: ShapeSettingRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    halted = threading.Event()

    class Arm(FakeRobot):
        def halt(self) -> None:
            super().halt()
            halted.set()

    monkeypatch.setattr(module, "_HEAT_FIRST_S", 3.0)
    connect_by(monkeypatch, lambda name, path: Arm(done, True))
    monkeypatch.setattr(run, "_await_off", lambda heater: halted.wait(1.0))
    run._stop()
    assert done[0] == "stop_heating"
    assert run.heat_is_off


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_keeps_nothing_from_stopping(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with module.undisturbed():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before


# -- what is checked before arms move and heat begins ------------------------------------------------------------------


def with_heater(run: ShapeSettingRun, *events: tuple[str, dict[str, float]], **fields: float) -> list[str]:
    """Add a heater with fields and events to a run; return the list of its commands."""
    commands: list[str] = []

    def command(name: str, **_: float) -> None:
        commands.append(name)

    values = {**OFF, "latched": 0, "busy": 0, "rod_hot_s": 0.0, "mode": Mode.AUTO, **fields}
    run._heater = SimpleNamespace(fields=values, state="armed", command=command)  # type: ignore[assignment]
    run._robot = SimpleNamespace(  # type: ignore[assignment]
        state=State.HOLDING, events=lambda since: [SimpleNamespace(name=name, fields=known) for name, known in events]
    )
    run._member.name = "heater"  # type: ignore[misc]
    return commands


def test_a_second_run_is_refused_while_the_first_one_works(tmp_path: Path) -> None:
    file = tmp_path / "shape-set.lock"
    first = module._lock(file)
    with pytest.raises(RtcpError, match=str(file)) as raised:
        module._lock(file)
    assert raised.value.reason == "shape_set_runs"
    first.close()
    module._lock(file).close()
    with pytest.raises(RtcpError, match="cannot be written"):
        module._lock(tmp_path / "none" / "shape-set.lock")


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"busy": 1}, "heater_in_use"),
        ({"relay": 1}, "heater_in_use"),
        ({"rod_hot_s": 90.0}, "rod_hot"),
        ({"latched": 1 << 12}, "heater_tripped"),
        ({"current": 30.0}, "heater_not_off"),
        ({"relay_closed": 1}, "heater_not_off"),
        ({"inputs_alive": 0}, "heater_not_off"),
        ({}, ""),
    ],
)
def test_nothing_begins_while_another_uses_the_heater_or_the_rod_may_be_hot(
    run: ShapeSettingRun, fields: dict[str, float], reason: str
) -> None:
    commands = with_heater(run, **fields)
    if reason:
        with pytest.raises(RtcpError) as raised:
            run._check_heater()
        assert raised.value.reason == reason
    else:
        run._check_heater()
    assert commands == []


def test_the_heater_has_to_supervise_both_arms(run: ShapeSettingRun) -> None:
    run._config = ShapeSettingConfig("shape_setting", "heater", arms=("left",))
    run._member.config = SimpleNamespace(source="heater.yaml")  # type: ignore[misc, assignment]
    run._job = SimpleNamespace(holders={"left": None})  # type: ignore[assignment]
    run._check_arms()
    run._job.holders["right"] = None
    with pytest.raises(RtcpError, match=r"the arm right .* the heater supervises left: .* heater\.yaml"):
        run._check_arms()


@pytest.mark.parametrize("mode", Mode)
def test_the_heater_is_armed_with_the_key_at_auto_only(run: ShapeSettingRun, mode: Mode) -> None:
    commands = with_heater(run, mode=mode, relay_closed=1)
    if mode is Mode.AUTO:
        run._arm()
        assert commands == ["arm_heater"]
    else:
        with pytest.raises(RtcpError, match=f"the key is at {mode.name.capitalize()}"):
            run._arm()
        assert commands == []


@pytest.mark.parametrize(
    ("heated", "is_right"),
    [
        ([(510.0, 1.0)], True),
        ([(592.0, 1.0)], False),
        ([(510.0, 1.02)], False),
        ([(510.0, 1.0)] * 2, True),
        ([], False),
    ],
)
def test_a_heating_to_another_profile_ends_the_run_with_an_error(
    run: ShapeSettingRun, heated: list[tuple[float, float]], is_right: bool
) -> None:
    run._profile = read_profile(default_config().parent / "shape_setting" / "nitinol.yaml")
    assert run._profile.target_c == 510.0
    ratio = target_ratio(run._profile)
    with_heater(run, *(("heating_started", {"target_c": target, "ratio": by * ratio}) for target, by in heated))
    if is_right:
        run._check_target(0)
    else:
        with pytest.raises(RtcpError, match="510 C") as raised:
            run._check_target(0)
        assert raised.value.reason == "profile_changed"


@pytest.mark.parametrize(
    ("middle_c", "text"),
    [(396.2, "its middle has 396 C: HOT, do not touch it"), (48.0, "its middle has 48 C"), (None, "is not known")],
)
def test_a_rod_that_is_released_is_said_to_be_as_hot_as_it_is(
    run: ShapeSettingRun, middle_c: float | None, text: str
) -> None:
    run.outcome.samples["middle_temperature"] = [] if middle_c is None else [510.0, middle_c, 0.0]
    assert run.middle_c == middle_c
    assert text in module._warmth(run.middle_c)
    assert ("HOT" in module._warmth(run.middle_c)) is (middle_c == 396.2)


# -- what follows one another, and what is made of the measurements ---------------------------------------------------


@pytest.mark.parametrize(("factor", "is_refused"), [(0.79, True), (0.81, False), (1.19, False), (1.21, True)])
def test_an_initial_resistance_that_alloy_and_dimensions_do_not_explain_ends_the_run(
    run: ShapeSettingRun, factor: float, is_refused: bool
) -> None:
    run._job, run._profile = read_job(default_config().parent / "shape_setting" / "arc.yaml")
    area = math.pi * 0.0005**2
    expected = float(run._profile.alloy.resistivity(run._profile.initial_c)) * 0.3 / area
    run.outcome.initial_resistance = factor * expected
    if is_refused:
        with pytest.raises(RtcpError, match="20 % off at most") as raised:
            run._check_resistance()
        assert raised.value.reason == "implausible_resistance"
    else:
        run._check_resistance()


@pytest.mark.parametrize(("closed", "verb"), [(True, "close"), (False, "open")])
def test_a_relay_that_does_not_follow_ends_the_run(
    run: ShapeSettingRun, monkeypatch: pytest.MonkeyPatch, closed: bool, verb: str
) -> None:
    monkeypatch.setattr(module, "_RELAY_S", 0.01)
    with_heater(run, relay_closed=closed)
    run._await_relay(closed)
    with_heater(run, relay_closed=not closed)
    with pytest.raises(RtcpError, match=f"did not {verb} within"):
        run._await_relay(closed)


class Script:
    """A cell, a heater and people that note what a run does with them."""

    def __init__(self, run: ShapeSettingRun, virtual: bool) -> None:
        self.done: list[str] = []
        self.states = {"left": State.READY, "right": State.HOLDING}
        self.heater_fields = {
            **OFF, "latched": 0, "forbids": 0, "busy": 0, "rod_hot_s": 0.0, "mode": Mode.AUTO, "energy": 812.5,
            "initial_resistance": 0.34, "relay_closed": 0,
        }  # fmt: skip
        self.approach: str | None = "the approach"
        arms = {name: self._arm(name) for name in self.states}
        run._cell = SimpleNamespace(  # type: ignore[assignment]
            config=SimpleNamespace(members=[]), arms=arms, run_trajectory=lambda path: self.done.append(f"run {path}")
        )
        run._job, run._profile = read_job(default_config().parent / "shape_setting" / "arc.yaml")
        run._say, run._confirm = (lambda step: None), (lambda text: self.done.append(f"confirm {text.split(',')[0]}"))
        run._began = time.monotonic()
        curve = np.zeros((2, 3))
        last = SimpleNamespace(p=curve, s=np.array([0.0, 0.3]), largest_strain=0.0015)
        run.plan = SimpleNamespace(steps=[last], begin={"left": 1, "right": 2}, trajectory="the bend")  # type: ignore[assignment]
        run._heater = SimpleNamespace(fields=self.heater_fields, state="off", command=self._command)  # type: ignore[assignment]
        robot_of_heater = SimpleNamespace(
            state=State.READY, enable=lambda: self.done.append("enable heater"),
            events=lambda since=0: [SimpleNamespace(number=number) for number in (3, 7)],
        )  # fmt: skip
        run._robot = robot_of_heater  # type: ignore[assignment]
        bus = SimpleNamespace(interface="virtual" if virtual else "eth1")
        run._member.config = SimpleNamespace(bus=bus)  # type: ignore[misc, assignment]

    def _arm(self, name: str) -> SimpleNamespace:
        status = SimpleNamespace(commanded_positions=name)
        return SimpleNamespace(
            state=self.states[name], enable=lambda: self.done.append(f"enable {name}"), status=lambda: status
        )

    def _command(self, name: str, **_: object) -> None:
        self.done.append(name)
        self.heater_fields["relay_closed"] = int(name == "arm_heater")


@pytest.mark.parametrize("virtual", [False, True], ids=["real", "virtual"])
def test_a_run_bends_a_rod_without_heat_and_heats_a_rod_that_nothing_moves(
    run: ShapeSettingRun, monkeypatch: pytest.MonkeyPatch, virtual: bool
) -> None:
    script = Script(run, virtual)
    held = SimpleNamespace(p=np.ones((2, 3)))
    for name, note in (("_check_heater", "check"), ("_check_resistance", "check resistance")):
        monkeypatch.setattr(run, name, partial(script.done.append, note))
    monkeypatch.setattr(run, "_await_relay", lambda closed: script.done.append(f"relay {closed}"))
    monkeypatch.setattr(run, "_held", lambda: held)
    monkeypatch.setattr(run, "_sampling", contextlib.nullcontext)
    monkeypatch.setattr(run, "_check_target", lambda since: script.done.append(f"check target since {since}"))
    monkeypatch.setattr(run, "_finish", lambda shape, rod: script.done.append(f"finish {shape is held} {rod}"))
    monkeypatch.setattr(module, "plan_approach", lambda *given: given[2] == {"left": "left", "right": "right"} and "x")

    class FakeRod:
        def __init__(self, robot: object) -> None:
            assert robot is run._robot

        def renew(self) -> None:
            script.done.append("renew")

        def bend(self, shape: object) -> None:
            script.done.append(f"impose {shape is held}")

        def __repr__(self) -> str:
            return "virtual"

    monkeypatch.setattr(module, "VirtualRod", FakeRod)
    run._steps()
    expected = [
        "confirm the chucks hold nothing", "check", "enable left", "run x", "confirm grip the rod", "renew",
        "enable heater", "arm_heater", "relay True", "set_heat_profile", "measure_resistance", "stop_heating",
        "check resistance", "relay False", "check", "run the bend", "impose True", "enable heater", "arm_heater",
        "relay True", "set_heat_profile", "start_heating", "check target since 7",
        f"finish True {'virtual' if virtual else None}", "confirm open the chucks and take the rod out",
    ]  # fmt: skip
    assert script.done == [step for step in expected if virtual or step not in ("renew", "impose True")]
    outcome = run.outcome
    assert (outcome.initial_resistance, outcome.energy, outcome.strain) == (0.34, 812.5, 0.0015)
    assert outcome.held is held.p
    assert outcome.wanted is run.plan.steps[-1].p
    assert outcome.interlocks["fuse"] == "good"
    assert [step.split()[0] for _, step in outcome.steps] == ["arms", "the", "the", "heating", "release:"]


def test_samples_are_taken_while_the_rod_is_heated_and_end_with_it(
    run: ShapeSettingRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SAMPLE_S", 0.005)
    fields: dict[str, Any] = dict.fromkeys(Outcome().samples, 1.5) | {"ratio": None}
    connect_by(monkeypatch, lambda name, path: FakeRobot([], True, **fields))
    with run._sampling():
        while len(run.outcome.times) < 3:
            time.sleep(0.001)
    count = len(run.outcome.times)
    time.sleep(0.02)
    assert len(run.outcome.times) == count
    assert run.outcome.samples["energy"] == [1.5] * count
    assert run.outcome.samples["ratio"] == [0.0] * count
    assert all(later > time for time, later in pairwise(run.outcome.times))


HELD = integrate(Rod(0.3, 1e-3), [0.5, 1.0, 3.0, -10.0, 4.0, 2.0])


def test_the_released_shape_follows_from_the_temperatures_and_is_not_made_up_without_them(run: ShapeSettingRun) -> None:
    run._profile = read_profile(default_config().parent / "shape_setting" / "nitinol.yaml")
    outcome = run.outcome
    outcome.wanted = HELD.p
    outcome.times, outcome.samples["middle_temperature"] = [0.0], [20.0]
    run._finish(HELD, None)
    assert outcome.released is None
    outcome.times, outcome.samples["middle_temperature"] = [0.0, 1.0, 61.0], [20.0, 510.0, 510.0]
    run._finish(HELD, None)
    assert outcome.highest[30] == pytest.approx(510.0, abs=1.0)
    # The chucks stay cold, and so do the ends.
    assert outcome.highest[0] < 100.0
    assert outcome.fraction[0] < 0.01
    assert outcome.fraction[30] > 0.95
    assert 0.0 < outcome.straight[0] < 0.05
    assert outcome.straight[1] == pytest.approx(outcome.straight[0])
    assert 0.0 < outcome.error[1] < outcome.error[0] < 0.05


class Box:
    """A control box with a virtual rod behind SDOs: the inputs of its cells are 1 + number, and it must be disabled."""

    def __init__(self) -> None:
        self.state = State.HOLDING
        self.written: list[tuple[int, int, int, bytes]] = []
        self.disabled = 0

    def scan(self) -> list[dict[str, int]]:
        return [
            {"position": 1, "vendor_id": 0xA55, "product_code": 0x11},
            {"position": 4, "vendor_id": 0xA55, "product_code": 0x10},
        ]

    def disable(self) -> None:
        self.state, self.disabled = State.READY, self.disabled + 1

    def sdo_read(self, slave: int, index: int, number: int) -> bytes:
        assert slave == 4
        return struct.pack("<f", {0x2025: 0.3 * (number - 1) / 47, 0x2021: 0.5, 0x2026: 300.0 + number}[index])

    def sdo_write(self, slave: int, index: int, number: int, data: bytes) -> None:
        assert self.state is State.READY
        self.written.append((slave, index, number, data))


def test_a_virtual_rod_gets_what_the_arms_do_to_it_and_tells_what_it_became(run: ShapeSettingRun) -> None:
    box = Box()
    rod = module.VirtualRod(box)  # type: ignore[arg-type]
    rod.renew()
    assert (box.written, box.disabled) == ([(4, 0x2013, 1, b"\x03")], 1)
    box.written, box.state = [], State.HOLDING
    rod.bend(HELD)
    assert box.written.pop() == (4, 0x2013, 1, b"\x01")
    assert [entry[:3] for entry in box.written] == [(4, 0x2010 + axis, n) for axis in range(3) for n in range(1, 49)]
    curvatures = np.array([struct.unpack("<f", entry[3])[0] for entry in box.written]).reshape(3, 48)
    at = np.linspace(0.0, 0.3, 48)
    assert curvatures == pytest.approx(np.array([np.interp(at, HELD.s, u) for u in HELD.u.T]), abs=1e-6)
    at, fraction, highest = rod.read()
    assert (at[-1], fraction[0], highest[-1]) == (pytest.approx(0.3), 0.5, 348.0)
    box.written = []
    run.outcome.wanted = HELD.p
    run._finish(HELD, rod)
    assert box.written == [(4, 0x2013, 1, b"\x02")]
    assert run.outcome.fraction == pytest.approx(np.full(len(HELD.s), 0.5))
    assert run.outcome.highest[-1] == pytest.approx(348.0)


def test_panels_get_four_curves_of_the_bend_with_the_process_that_draws_them(
    run: ShapeSettingRun, tmp_path: Path
) -> None:
    curves = np.arange(10 * 9 * 3, dtype=np.float64).reshape(10, 9, 3) / 3.0
    run.plan = SimpleNamespace(curves=curves)  # type: ignore[assignment]
    run._draw(tmp_path / "rod.json")
    content = json.loads((tmp_path / "rod.json").read_text())
    assert content == {"pid": os.getpid(), "curves": curves[[0, 3, 6, 9]][:, [0, 4, 8]].round(4).tolist()}
    run._draw(tmp_path / "none" / "rod.json")


def test_a_cell_without_a_heater_is_refused() -> None:
    heater = ShapeSettingConfig("shape_setting", "heater")
    members = [SimpleNamespace(config=SimpleNamespace(processes=processes)) for processes in ([], ["other", heater])]
    cell = SimpleNamespace(config=SimpleNamespace(name="lab", processes=members))
    assert module._heater_of(cell) == (members[1], "heater")  # type: ignore[arg-type]
    del members[1]
    with pytest.raises(RtcpError, match="the cell lab has no process of kind shape_setting") as raised:
        module._heater_of(cell)  # type: ignore[arg-type]
    assert raised.value.reason == "no_heater"
