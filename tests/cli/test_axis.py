"""`rtcp axis`: what is asked of the platform, and the sentences for its answers."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from typing import Any

import pytest

RAIL = {
    "unit": "m", "position": 0.31, "velocity": 0.0, "target_position": 0.3, "target_velocity": 0.0, "mode": 1,
    "drive_state": "operation enabled", "moving": False, "homed": True,
}  # fmt: skip


@pytest.fixture(autouse=True)
def rail(platform: Any) -> None:
    platform.status["axes"] = {"rail": RAIL}


@pytest.mark.parametrize(
    ("arguments", "method", "params", "said"),
    [
        (("move", "rail", "-0.3", "--speed", "0.1"), "move_axis", {"axis": "rail", "position": -0.3, "speed": 0.1},
         "rail is at 0.25 m\n"),
        (("move", "rail", "0.3"), "move_axis", {"axis": "rail", "position": 0.3, "speed": None}, "rail is at 0.25 m\n"),
        (("stop", "rail"), "stop_axis", {"axis": "rail"}, "rail rests\n"),
    ],
)  # fmt: skip
def test_a_command_is_passed_on_and_answered_with_the_unit_of_the_axis(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...], method: str, params: dict[str, Any], said: str
) -> None:
    platform.answers[method] = {"position": 0.25}
    ended = rtcp("axis", *arguments)
    assert (ended.code, ended.out) == (0, said)
    assert platform.asked(method) == [params]


@pytest.mark.parametrize(("method", "arguments", "answer", "homed"), [
    (33, (), "", True), (35, (), "n\n", False), (35, (), "y\n", True), (35, ("--yes",), "", True),
])  # fmt: skip
def test_homing_says_what_the_drive_will_do_and_asks_before_the_present_position_becomes_the_home(
    platform: Any, rtcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, method: int, arguments: tuple[str, ...],
    answer: str, homed: bool,
) -> None:  # fmt: skip
    monkeypatch.setattr(sys, "stdin", io.StringIO(answer))
    platform.answers["homing_method"] = {
        "joint": "rail", "method": method, "text": "homes", "declares_present": method == 35, "home_offset": 0.1,
        "unit": "m",
    }  # fmt: skip
    platform.answers["home_axis"] = {"position": 0.25}
    ended = rtcp("axis", "home", "rail", *arguments)
    assert f"the drive of rail homes, by method {method} (0x6098); there it counts 0.1 m (0x607C)\n" in ended.out
    assert platform.asked("homing_method") == [{"joint": "rail"}]
    assert bool(platform.asked("home_axis")) is (ended.code == 0) is homed
    assert ended.out.endswith("rail is homed and stands at 0.25 m\n") is homed


def test_a_run_is_renewed_until_its_time_has_passed_and_then_stopped(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.answers["run_axis"] = platform.answers["stop_axis"] = {}
    assert rtcp("axis", "run", "rail", "-0.1", "--for", "1").out == "rail rests at 0.31 m\n"
    runs = platform.asked("run_axis")
    assert len(runs) >= 2
    assert {(run["axis"], run["velocity"], run["hold_s"]) for run in runs} == {("rail", -0.1, 0.5)}
    assert platform.asked("stop_axis") == [{"axis": "rail"}]


@pytest.mark.parametrize("arguments", [("move", "rail", "nan"), ("move", "rail", "0.1", "--speed", "0"),
                                       ("run", "rail", "fast"), ("run", "rail", "0.1", "--for", "-1")])  # fmt: skip
def test_what_is_no_number_is_not_passed_on(
    platform: Any, rtcp: Callable[..., Any], arguments: tuple[str, ...]
) -> None:
    assert rtcp("axis", *arguments).code == 2
    assert not platform.asked("move_axis") + platform.asked("run_axis")


def test_the_status_has_a_line_for_each_axis(platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.status["axes"] = {"rail": {**RAIL, "homed": False}}
    assert "rail" in (shown := rtcp("status").out)
    assert "+0.3100 m, +0.0000 m/s, at rest, not homed" in shown
