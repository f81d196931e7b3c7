"""The early end of a run: heat first, then motion, even if a part does not answer."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.api import RtcpError, State
from rtcp.api.cell import rod_file
from rtcp.config.find import default_config
from rtcp.processes.shape_setting import run as module
from rtcp.processes.shape_setting.config import ShapeSettingConfig
from rtcp.processes.shape_setting.interlocks import Mode
from rtcp.processes.shape_setting.profile import read_profile, target_ratio
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

    @property
    def processes(self) -> dict[str, Any]:
        return {"heater": SimpleNamespace(fields={**OFF, **self.fields})}


OFF = {
    "latched": 1 << 10, "forbids": 1 << 3, "gate": 0, "relay": 0, "relay_closed": 0, "gate_sense": 0, "current": 0.01,
    "inputs_alive": 1, "middle_temperature": 0.0,
}  # fmt: skip


def make_run(tmp_path: Path) -> ShapeSettingRun:
    """Return a run whose cell has one arm and the heater."""
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: BaseException, answers: bool, expected: list[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr(module, "Robot", lambda name, path: FakeRobot(done, answers))

    def fail(self: ShapeSettingRun) -> None:
        raise ending

    monkeypatch.setattr(ShapeSettingRun, "_steps", fail)
    monkeypatch.setattr(ShapeSettingRun, "_draw", lambda self, path: path.write_text("[]"))
    run = make_run(tmp_path)
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fields: dict[str, float]
) -> None:
    monkeypatch.setattr(module, "_RELAY_S", 0.1)
    monkeypatch.setattr(module, "Robot", lambda name, path: FakeRobot([], True, **fields))
    run = make_run(tmp_path)
    run._stop()
    assert not run.heat_is_off
    assert run.outcome.interlocks["arm_lost"] == "latched"


def test_what_hangs_keeps_neither_heat_nor_arms_from_stopping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    hang = threading.Event()

    def connect(name: str, path: Path) -> FakeRobot:
        if path.parent.name == "heater":
            hang.wait()
        return FakeRobot(done, True)

    monkeypatch.setattr(module, "_HEAT_FIRST_S", 0.1)
    monkeypatch.setattr(module, "_STOP_S", 0.5)
    monkeypatch.setattr(module, "Robot", connect)
    run = make_run(tmp_path)
    run._stop()  # it ends, though a part hangs
    assert done == ["halt"]
    assert not run.heat_is_off
    hang.set()


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
    tmp_path: Path, fields: dict[str, float], reason: str
) -> None:
    run = make_run(tmp_path)
    commands = with_heater(run, **fields)
    if reason:
        with pytest.raises(RtcpError) as raised:
            run._check_heater()
        assert raised.value.reason == reason
    else:
        run._check_heater()
    assert commands == []


def test_the_heater_has_to_supervise_both_arms(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    run._config = ShapeSettingConfig("shape_setting", "heater", arms=("left",))
    run._member.config = SimpleNamespace(source="heater.yaml")  # type: ignore[misc, assignment]
    run._job = SimpleNamespace(holders={"left": None})  # type: ignore[assignment]
    run._check_arms()
    run._job.holders["right"] = None
    with pytest.raises(RtcpError, match=r"the arm right .* the heater supervises left: .* heater\.yaml"):
        run._check_arms()


@pytest.mark.parametrize("mode", Mode)
def test_the_heater_is_armed_with_the_key_at_auto_only(tmp_path: Path, mode: Mode) -> None:
    run = make_run(tmp_path)
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
    tmp_path: Path, heated: list[tuple[float, float]], is_right: bool
) -> None:
    run = make_run(tmp_path)
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
    tmp_path: Path, middle_c: float | None, text: str
) -> None:
    run = make_run(tmp_path)
    run.outcome.samples["middle_temperature"] = [] if middle_c is None else [510.0, middle_c, 0.0]
    assert run.middle_c == middle_c
    assert text in module._warmth(run.middle_c)
    assert ("HOT" in module._warmth(run.middle_c)) is (middle_c == 396.2)
