"""A motion with a target is complete when the measured joints are there, in each drive mode; else it has failed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from rtcp.config.model import SettleConfig
from rtcp.ipc.events import Arrived, NotSettled, Stopped
from rtcp.ipc.states import State
from tests.control.rig import CONFIG, CSP, CST, CSV, LoopRig
from tests.control.test_measurements import FALSE, falsify

TARGET = (0.1234567, -0.2345678)
"""Between two counts of the drives."""


def error(rig: LoopRig) -> float:
    """Return the largest distance of a measured joint from the target."""
    return max(abs(a - b) for a, b in zip(rig.arm.state.actual, TARGET, strict=True))


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
@pytest.mark.parametrize("tolerance", [0.0003, 0.002])
def test_a_motion_is_complete_when_the_measured_joints_are_there(
    new_rig: Callable[..., LoopRig], mode: int, tolerance: float
) -> None:
    rig = new_rig(replace(CONFIG, settle=SettleConfig(tolerance, 20.0))).hold(mode)
    rig.move(*TARGET)
    rig.wait(lambda: rig.state is State.HOLDING, 30.0)
    assert rig.kinds[-1] is Arrived
    assert error(rig) <= tolerance


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_a_motion_whose_joints_do_not_settle_fails_with_joint_distance_and_time(
    new_rig: Callable[..., LoopRig], mode: int
) -> None:
    rig = new_rig(replace(CONFIG, settle=SettleConfig(1e-9, 0.2))).hold(mode)
    rig.move(*TARGET)
    rig.wait(lambda: rig.arm.still)
    assert rig.wait(lambda: rig.state is not State.MOVING) == pytest.approx(0.2, abs=2 * rig.context.period_s)
    assert rig.kinds[-1] is NotSettled
    event = rig.last_of(NotSettled)
    assert (event.axis, event.limit, event.time_s) == (0, 1e-9, 0.2)
    assert 1e-9 < event.distance <= error(rig) + 1e-6
    rig.bring_to(State.HOLDING)
    assert rig.kinds[-1] is Stopped
    assert Arrived not in rig.kinds
    rig.move(0.0, 0.0)  # needs no reset
    assert rig.state is State.MOVING


def test_a_motion_that_follows_while_the_joints_settle_replaces_it(new_rig: Callable[..., LoopRig]) -> None:
    rig = new_rig(replace(CONFIG, settle=SettleConfig(1e-9, 5.0))).hold()
    rig.move(0.1, 0.1)
    rig.wait(lambda: rig.arm.still)
    motions = rig.machine.motions
    rig.move(*TARGET)
    assert (rig.state, rig.machine.motions, rig.arm.still) == (State.MOVING, motions + 1, False)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_motion_is_not_complete_by_a_position_that_was_replaced(new_rig: Callable[..., LoopRig], axis: int) -> None:
    rig = new_rig(CONFIG).hold()
    rig.move(*TARGET)
    cycles = round(rig.wait(lambda: rig.state is State.HOLDING) / rig.context.period_s)
    rig = new_rig(CONFIG).hold()
    rig.move(*TARGET)
    rig.run((cycles - 2) * rig.context.period_s)
    end = falsify(rig, *FALSE["a hundredth of a radian off"], axis)
    rig.run(4 * rig.context.period_s)
    assert rig.state is State.MOVING
    assert error(rig) < 1e-3
    end()
    rig.cycle()
    assert rig.kinds[-1] is Arrived
