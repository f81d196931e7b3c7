"""What a cycle record says was commanded and sent, compared with the frame of that cycle, decoded here."""

from __future__ import annotations

import pytest

from rtcp.ipc.commands import MoveJoints, SetZero
from rtcp.motion.guards.trajectory_guard import GuardResult
from rtcp.motion.state import ArmState, Setpoint

from .rig import COUNTS, CSP, CST, CSV, LoopRig


def sent(rig: LoopRig, name: str) -> list[float]:
    """A field of the last record, one number a joint, in counts."""
    latest = rig.observer.latest()
    assert latest is not None
    return [float(value) * COUNTS for value in latest[0][name]]


@pytest.mark.parametrize("mode", [CSP, CSV, CST])
def test_a_record_says_what_left_on_the_wire(rig: LoopRig, mode: int) -> None:
    rig.set_in_motion(mode)
    for _ in range(50):
        rig.cycle()
        frame = rig.log[-1].drives
        # The frame carries whole counts; velocities and torques are rounded towards zero.
        assert sent(rig, "sent_position") == pytest.approx([drive.target for drive in frame], abs=0.5)
        if mode == CSV:
            assert sent(rig, "sent_velocity") == pytest.approx([drive.speed for drive in frame], abs=1.0)
        if mode == CST:
            assert sent(rig, "sent_torque") == pytest.approx([drive.effort for drive in frame], abs=1.0)


@pytest.mark.interpreted
def test_a_record_says_what_was_commanded_where_the_limiter_sends_less(rig: LoopRig) -> None:
    rig.hold()

    def jump(state: ArmState) -> Setpoint:
        setpoint = Setpoint(2)
        setpoint.position = [0.002, 0.0]
        return setpoint

    def command_far(state: ArmState, target: Setpoint, tolerates_saturation: bool) -> GuardResult:
        state.commanded[0] = 0.1
        return GuardResult.PASS

    rig.arm.trajectory_guard.apply = command_far  # type: ignore[method-assign]
    rig.arm.controllers[MoveJoints].update = jump  # type: ignore[method-assign]
    rig.cycle()
    frame = rig.log[-1].drives[0]
    assert sent(rig, "commanded_position")[0] == pytest.approx(0.1 * COUNTS)
    assert sent(rig, "sent_position")[0] == pytest.approx(frame.target, abs=0.5)
    assert frame.target <= rig.arm.limits.velocity[0] * rig.arm.period_s * COUNTS + 1


@pytest.mark.parametrize("lost", [True, False])
def test_a_record_of_the_cycle_in_which_a_zero_is_set_counts_all_positions_from_it(rig: LoopRig, lost: bool) -> None:
    rig.start().lose_frames(lost)
    rig.do(SetZero(0, 0.3))
    assert sent(rig, "actual_position")[0] == pytest.approx(-0.3 * COUNTS, abs=1)
    assert sent(rig, "sent_position") == pytest.approx(sent(rig, "actual_position"), abs=0.5)
