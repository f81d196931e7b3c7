"""`rtcp limits show` and `set`."""

from __future__ import annotations

import copy
import io
import json
import sys
from collections.abc import Callable
from typing import Any

import pytest

JOINTS = 6


@pytest.fixture
def limits(platform: Any) -> dict[str, Any]:
    """The answer of the platform: joint 2 narrowed to 1.25 rad, the user's box made higher."""
    numbers = {"min": -3.0, "max": 3.0, "velocity": 0.5, "acceleration": 2.0, "jerk": 20.0, "torque": 49.0}
    configured = {name: [value] * JOINTS for name, value in numbers.items()} | {
        "box": {"min": [-1.2, -1.0, -0.4], "max": [0.8, 1.0, 1.4]},
        "keep_out": {"user": {"min": [0.4, -0.3, -0.1], "max": [1.1, 0.3, 0.85]}},
        "cones": {"cup": {"axis": "z", "direction": [0.0, 0.0, -1.0], "angle": 1.2}},
        "supervision": {"speed": 1.5, "torque": 1.01, "following_error": 0.15},
    }
    now = copy.deepcopy(configured)
    now["max"][1] = 1.25  # type: ignore[index]
    now["keep_out"]["user"]["max"][2] = 0.95  # type: ignore[index]
    now["cones"]["cup"]["angle"] = 0.5  # type: ignore[index]
    now["supervision"]["speed"] = 1.2  # type: ignore[index]
    answer = {
        "joint_names": [f"joint{n}" for n in range(1, JOINTS + 1)],
        "limits": now,
        "configured": configured,
        "cartesian": {
            "speed": 0.25, "acceleration": 0.5, "jerk": 5.0, "angular_speed": 0.5, "angular_acceleration": 1.0,
            "angular_jerk": 10.0, "singularity": {"shoulder": 0.03, "elbow": 0.08, "wrist": 0.07},
        },
    }  # fmt: skip
    platform.answers |= {"limits": answer, "set_limits": answer}
    return answer


def test_all_limits_and_boxes_are_shown_and_what_was_changed_is_marked(
    limits: dict[str, Any], rtcp: Callable[..., Any]
) -> None:
    ended = rtcp("limits", "show")
    rows = {line.split()[0]: line for line in ended.out.splitlines() if line.startswith(" joint")}
    assert "1.25 *" in rows["joint2"]
    assert "*" not in rows["joint1"]
    assert "-0.1 to 0.95 *" in ended.out
    shown = ("tool inside", "-1.2 to 0.8", "keep out: user", "0.25 m/s", "singularity: wrist", "0.07 rad", "0 0 -1")
    for text in (*shown, "0.5 *", "1.2 * times"):
        assert text in ended.out
    assert max(len(line) for line in ended.out.splitlines()) <= 80


def test_limits_are_shown_as_json(limits: dict[str, Any], rtcp: Callable[..., Any]) -> None:
    assert json.loads(rtcp("limits", "show", "--json").out) == limits


def test_all_pairs_are_one_transaction(limits: dict[str, Any], platform: Any, rtcp: Callable[..., Any]) -> None:
    ended = rtcp("limits", "set", "joint2.max", "1.25", "box.min.x", "-0.5")
    assert (ended.code, ended.out) == (0, "2 limits are changed until `rtcp stop`\n")
    assert platform.asked("set_limits") == [{"changes": {"joint2.max": 1.25, "box.min.x": -0.5}, "widen": False}]


def test_limits_are_widened_once_somebody_has_said_yes(
    limits: dict[str, Any], platform: Any, rtcp: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    nobody_answers = rtcp("limits", "set", "joint2.max", "2.5", "--widen")
    assert nobody_answers.code == 2
    assert "standard input has ended at a question: answer it, or pass --yes" in nobody_answers.trouble
    assert platform.asked("set_limits") == []
    assert rtcp("limits", "set", "joint2.max", "2.5", "--widen", "--yes").code == 0
    assert platform.asked("set_limits") == [{"changes": {"joint2.max": 2.5}, "widen": True}]


def test_a_refused_transaction_is_exit_code_3(limits: dict[str, Any], platform: Any, rtcp: Callable[..., Any]) -> None:
    platform.refusals["set_limits"] = (
        "refused",
        "joint2 is at 1.5 rad: nothing was changed",
    )
    ended = rtcp("limits", "set", "joint2.max", "1.25")
    assert (ended.code, ended.out) == (3, "")
    assert "nothing was changed" in ended.trouble


WRONG = {
    "a key without a value": (("joint2.max",), "'joint2.max' has no value"),
    "a value that is none": (("joint2.max", "high", "joint3.max", "nan"), "joint2.max: 'high' is not a number"),
    "a value that is not finite": (("joint2.max", "inf"), "joint2.max: inf is not finite"),
    "a key given twice": (("joint2.max", "1", "joint2.max", "2"), "joint2.max is given twice"),
    "an option that is none": (("joint2.max", "1", "--jsn"), "did you mean --json?"),
}


@pytest.mark.parametrize(("pairs", "sentence"), WRONG.values(), ids=WRONG.keys())
def test_what_is_no_limit_is_refused_before_the_platform_is_asked(
    platform: Any, rtcp: Callable[..., Any], pairs: tuple[str, ...], sentence: str
) -> None:
    ended = rtcp("limits", "set", *pairs)
    assert (ended.code, platform.requests) == (2, [])
    assert sentence in ended.trouble
