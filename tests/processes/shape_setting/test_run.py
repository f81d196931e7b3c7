"""The end of a run before its time: heat first, then motion, whatever does not answer."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.api import RtcpError
from rtcp.api.cell import rod_file
from rtcp.processes.shape_setting import run as module
from rtcp.processes.shape_setting.run import Outcome, ShapeSettingRun


class FakeRobot:
    """The heater's platform over a connection of its own; it notes what it is asked."""

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
    began = time.monotonic()
    run._stop()
    assert time.monotonic() - began < 2.0
    assert done == ["halt"]
    assert not run.heat_is_off
    hang.set()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_keeps_nothing_from_stopping(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with module.undisturbed():
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) is before
