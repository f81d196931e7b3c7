"""Keys and numbers of limits: one message for each mistake, with key, value and allowed range."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import AbsoluteLimits, AbsoluteSupervision, Cone, Range
from rtcp.gateway.limit_settings import changed
from rtcp.ipc.commands import SetLimits
from rtcp.ipc.errors import Invalid
from rtcp.ipc.refusals import LimitsExcludeJoint
from rtcp.motion.limits import Values, corners
from tests.gateway.fake_platform import fake_platform

CONFIG = load(default_config())
WIDEST = Values.configured(CONFIG)
ONLY_NARROWED = "this limit is only narrowed while running"
WIDENABLE = f"{ONLY_NARROWED}, except with --widen up to its key absolute"
KEYS = (
    "allowed are joint1.KEY or joints.KEY (KEY: min, max, velocity, acceleration, jerk, torque) and chair.min.x "
    "(boxes: box, user, chair), supervision.KEY (KEY: speed, torque, following_error)"
)


def messages(changes: dict[str, float], values: Values = WIDEST) -> list[str]:
    with pytest.raises(Invalid) as raised:
        changed(CONFIG, values, changes)
    return str(raised.value).split("\n")


def test_every_key_that_there_is_changes_what_it_names_and_nothing_else() -> None:
    joint = {"min": "low", "max": "high", **{name: name for name in ("velocity", "acceleration", "jerk", "torque")}}
    for key, name in joint.items():
        before = getattr(WIDEST, name)
        number = 0.9 * before[2]
        after = (*before[:2], number, *before[3:])
        assert changed(CONFIG, WIDEST, {f"joint3.{key}": number}) == replace(WIDEST, **{name: after})
    assert WIDEST.box is not None
    for side, end in (("min", "x"), ("min", "z"), ("max", "y")):
        at = 3 * (side == "max") + "xyz".index(end)
        number = 0.9 * WIDEST.box[at]
        narrower = (*WIDEST.box[:at], number, *WIDEST.box[at + 1 :])
        assert changed(CONFIG, WIDEST, {f"box.{side}.{end}": number}) == replace(
            WIDEST, box=corners(narrower[:3], narrower[3:])
        )
    user, chair = WIDEST.keep_out
    larger = (*chair[:4], 0.7, chair[5])
    assert changed(CONFIG, WIDEST, {"chair.max.y": 0.7}) == replace(WIDEST, keep_out=(user, larger))


def test_joints_stands_for_all_of_them() -> None:
    assert changed(CONFIG, WIDEST, {"joints.velocity": 0.1}).velocity == (0.1,) * 6


def test_what_was_narrowed_may_become_as_wide_as_configured_again() -> None:
    narrowed = changed(CONFIG, WIDEST, {"joint2.max": 1.0, "user.max.z": 1.2})
    assert changed(CONFIG, narrowed, {"joint2.max": 2.0, "user.max.z": 0.85}) == WIDEST


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint2.max": 2.5}, f"joint2.max: found 2.5, allowed is -2 to 2 (joints[1] in {{file}}: {WIDENABLE})"),
        ({"joint4.jerk": -1}, f"joint4.jerk: found -1, allowed is 0.02 to 20 (joints[3] in {{file}}: {ONLY_NARROWED})"),
        (
            {"box.max.z": 1.5},
            f"box.max.z: found 1.5, allowed is at most 1.4 (cartesian.box in {{file}}: {ONLY_NARROWED})",
        ),
        (
            {"user.max.z": 0.8},
            f"user.max.z: found 0.8, allowed is at least 0.85 (cartesian.keep_out in {{file}}: {ONLY_NARROWED})",
        ),
        ({"joint1.min": 1, "joint1.max": 0.5}, "joint1.min: found 1, allowed is less than joint1.max, which is 0.5"),
        ({"box.min.y": 0.5, "box.max.y": 0.5}, "box.min.y: found 0.5, allowed is less than box.max.y, which is 0.5"),
        ({"box.max.x": -1.5}, "box.min.x: found -1.2, allowed is less than box.max.x, which is -1.5"),
        ({"joint1.max": nan}, "joint1.max: found NaN, allowed is a finite number"),
        ({"user.min.x": -inf}, "user.min.x: found -Infinity, allowed is a finite number"),
        ({"joint9.max": 1}, f"joint9.max: there is no such limit; {KEYS}"),
        ({"joint1.speed": 1}, f"joint1.speed: there is no such limit; {KEYS}"),
        ({"box.min": 1}, f"box.min: there is no such limit; {KEYS}"),
        ({"box.min.w": 1}, f"box.min.w: there is no such limit; {KEYS}"),
        ({"box.mid.x": 1}, f"box.mid.x: there is no such limit; {KEYS}"),
        ({"joints.min.x": 1}, f"joints.min.x: there is no such limit; {KEYS}"),
        ({"max": 1}, f"max: there is no such limit; {KEYS}"),
        ({"": 1}, f": there is no such limit; {KEYS}"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_a_wrong_limit_is_named_by_its_key(changes: dict[str, float], message: str) -> None:
    assert messages(changes) == [message.replace("{file}", CONFIG.source.name)]


def test_each_joint_that_joints_makes_wrong_is_named() -> None:
    assert [message.split(",")[0] for message in messages({"joints.torque": 30.0})] == [
        "joint5.torque: found 30", "joint6.torque: found 30"
    ]  # fmt: skip


def test_a_wrong_number_is_named_though_a_later_key_replaces_it() -> None:
    sentences = messages({"joint4.acceleration": 1e18, "joints.acceleration": 1.0})
    assert [sentence.split(",")[0] for sentence in sentences] == ["joint4.acceleration: found 1e+18"]


def test_all_mistakes_are_reported_at_once() -> None:
    changes = {"joint1.max": 9.0, "user.max.z": 0.1, "joint2.velocity": nan, "elbow.max": 1.0, "joint3.max": 1.0}
    assert [message.split(":")[0] for message in messages(changes)] == [
        "joint2.velocity", "elbow.max", "joint1.max", "user.max.z"
    ]  # fmt: skip


def test_a_range_that_becomes_empty_with_a_limit_that_is_in_force_is_named() -> None:
    narrowed = changed(CONFIG, WIDEST, {"joint2.max": 0.5})
    (message,) = messages({"joint2.min": 0.6}, narrowed)
    assert message == "joint2.min: found 0.6, allowed is less than joint2.max, which is 0.5"


def test_an_empty_change_is_refused() -> None:
    (message,) = messages({})
    assert message.startswith("changes: found none, give a key and a number, as joint1.KEY")


def test_an_arm_without_boxes_has_no_keys_for_them() -> None:
    bare = replace(CONFIG, cartesian=replace(CONFIG.cartesian, box=None, keep_out=()))
    values = Values.configured(bare)
    assert changed(bare, values, {"joint1.max": 1.0}).box is None
    with pytest.raises(Invalid) as raised:
        changed(bare, values, {"box.min.x": 0.0})
    joints, thresholds = KEYS.split(" and ", maxsplit=1)[0], KEYS[KEYS.index(", supervision") :]
    assert str(raised.value) == f"box.min.x: there is no such limit; {joints}{thresholds}"


CUP = Cone("cup", (0.0, 0.0, -1.0), 1.2)
WIDER = replace(
    CONFIG,
    joints=(
        replace(CONFIG.joints[0], absolute=AbsoluteLimits(Range(-3.2, 3.1), 0.8, 49.2)), *CONFIG.joints[1:],
    ),
    cartesian=replace(CONFIG.cartesian, cones=(CUP,)),
    supervision=replace(CONFIG.supervision, absolute=AbsoluteSupervision(speed=2.0)),
)  # fmt: skip
"""The arm with a cone, and with room beyond its limits."""


def test_the_angle_of_a_cone_is_narrowed_by_its_name() -> None:
    values = Values.configured(WIDER)
    assert changed(WIDER, values, {"cup.angle": 0.5}).cones == (values.cones[0]._replace(angle=0.5),)
    for number, allowed in ((1.3, "0.05 to 1.2"), (0.01, "0.05 to 1.2")):
        with pytest.raises(Invalid, match=f"cup.angle: found {number:g}, allowed is {allowed} .cartesian.cones in"):
            changed(WIDER, values, {"cup.angle": number})


def test_limits_are_widened_on_purpose_only_up_to_the_absolute_ones_and_then_stay() -> None:
    values = Values.configured(WIDER)
    wider = {"joint1.min": -3.2, "joint1.velocity": 0.8, "joint1.torque": 49.2, "supervision.speed": 2.0}
    for key, number in wider.items():
        with pytest.raises(Invalid, match=f"{key}: found .*: {WIDENABLE}"):
            changed(WIDER, values, {key: number})
        changed(WIDER, values, {key: number}, widen=True)
        with pytest.raises(Invalid, match=f"{key}: found .*absolute in"):
            changed(WIDER, values, {key: 1.01 * number}, widen=True)
    for key, where in (
        ("joint1.max", r"joints\[0\].absolute in"),
        ("joint2.velocity", r"joints\[1\].absolute in"),
        ("supervision.torque", r"supervision.absolute in"),
        ("joint1.jerk", rf"joints\[0\] in .*: {ONLY_NARROWED}\)"),
        ("box.max.x", rf"cartesian.box in .*: {ONLY_NARROWED}\)"),
        ("cup.angle", rf"cartesian.cones in .*: {ONLY_NARROWED}\)"),
    ):
        with pytest.raises(Invalid, match=rf"{key}: found .* \({where}"):
            changed(WIDER, values, {key: 30.0}, widen=True)
    widened = changed(WIDER, values, wider, widen=True)
    # Another change leaves them as they are, and may narrow them.
    assert changed(WIDER, widened, {"joint2.max": 1.0}).velocity[0] == 0.8
    assert changed(WIDER, widened, {"joint1.velocity": 0.6}).velocity[0] == 0.6
    narrow = changed(WIDER, widened, {"joint1.velocity": 0.4})
    with pytest.raises(Invalid, match="joint1"):
        changed(WIDER, narrow, {"joint1.velocity": 0.6})


def test_thresholds_of_the_supervision_are_narrowed() -> None:
    new = changed(CONFIG, WIDEST, {"supervision.following_error": 0.05, "supervision.speed": 1.2})
    assert new.supervision == (1.2, WIDEST.supervision[1], 0.05)
    for key, number in (("supervision.speed", 0.9), ("supervision.torque", 3.0), ("supervision.following_error", 0.2)):
        (message,) = messages({key: number})
        assert message.startswith(f"{key}: found {number:g}, allowed is")


def test_a_change_is_one_transaction_that_the_next_gateway_finds(tmp_path: Path) -> None:
    with fake_platform(tmp_path, [0.0] * 6) as arm:
        before = arm.ask("limits")
        assert before["limits"] == before["configured"]
        arm.ask("set_limits", changes={"joint2.max": 1.0, "joints.velocity": 0.4, "user.max.z": 0.9})
        (rows,) = arm.loop.plans
        assert arm.loop.commands == [SetLimits(0, len(rows))]
        joints, boxes = rows[1:7], rows[7:]
        assert [joint[1] for joint in joints] == [3.1, 1.0, 2.4, 3.1, 2.0, 3.1]
        assert [joint[2] for joint in joints] == [0.4] * 6
        assert boxes[1][:6] == [0.42, -0.35, -0.1, 1.1, 0.35, 0.9]
        # `ask` makes new methods each time, as a gateway that was started again.
        assert arm.ask("limits")["limits"]["max"][1] == 1.0


def test_a_change_that_the_loop_refuses_is_not_in_force(tmp_path: Path) -> None:
    with fake_platform(tmp_path, [0.0] * 6) as arm:
        before = arm.ask("limits")
        arm.loop.refusals[SetLimits] = LimitsExcludeJoint(1, 0.3, 0.1)
        error = arm.error("set_limits", changes={"joint2.max": 0.1})
        assert (error.kind, error.reason) == ("refused", "limits_exclude_joint")
        assert arm.ask("limits") == before
        assert arm.error("set_limits", changes=[]).message == "changes: found an empty list, allowed is a mapping"
