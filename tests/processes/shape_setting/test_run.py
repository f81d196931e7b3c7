"""The end of a run before its time: heat first, then motion, whatever does not answer."""

from __future__ import annotations

import signal
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

    def __init__(self, done: list[str], answers: bool) -> None:
        self._done, self._answers = done, answers

    def __enter__(self) -> FakeRobot:
        if not self._answers:
            raise RtcpError("lost", "the platform closed the connection")
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def command(self, name: str) -> None:
        self._done.append(name)

    @property
    def processes(self) -> dict[str, Any]:
        self._done.append("interlocks")

        class Heater:
            fields = {"latched": 1 << 10, "forbids": 1 << 3, "gate": 0, "relay": 0}

        return {"heater": Heater()}


class FakeCell:
    def __init__(self, done: list[str]) -> None:
        self._done = done

    def halt(self) -> None:
        self._done.append("halt")


@pytest.mark.parametrize(
    ("answers", "expected"), [(True, ["stop_heating", "halt", "interlocks"]), (False, ["halt"])], ids=["", "silent"]
)
@pytest.mark.parametrize("ending", [KeyboardInterrupt(), RtcpError("fault", "x"), ValueError()], ids=repr)
def test_what_ends_a_run_turns_the_heat_off_before_it_stops_the_arms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: BaseException, answers: bool, expected: list[str]
) -> None:
    done: list[str] = []
    monkeypatch.setattr(module, "Robot", lambda name, path: FakeRobot(done, answers))
    monkeypatch.setattr(ShapeSettingRun, "_socket", lambda self: None)

    def fail(self: ShapeSettingRun) -> None:
        raise ending

    monkeypatch.setattr(ShapeSettingRun, "_steps", fail)
    monkeypatch.setattr(ShapeSettingRun, "_draw", lambda self, path: path.write_text("[]"))
    run = object.__new__(ShapeSettingRun)
    run._member = SimpleNamespace(directory=tmp_path / "heater")  # type: ignore[assignment]
    run.heat_is_off = False
    run._cell, run._name, run.outcome = FakeCell(done), "heater", Outcome()  # type: ignore[assignment]
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
