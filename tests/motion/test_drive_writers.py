"""The loops closed here in CSV and CST begin without a jump each time, in both directions and for each joint."""

from __future__ import annotations

from math import exp

import pytest

from rtcp.motion.drive_writers import CstWriter, CsvWriter

from .guard_checker import ARM
from .test_output_limiter import Drive

DT = 0.001
JOINTS = ARM.joints[:3]
SIGNS = pytest.mark.parametrize("sign", [1.0, -1.0])


def drives(*errors: float) -> list[Drive]:
    """Drives that follow targets of 0.1 rad with these errors, rad."""
    return [Drive(position=0.1 - error, target_position=0.1) for error in errors]


@SIGNS
def test_in_csv_each_start_forgets_the_following_error_of_the_drive_and_removes_it_slowly(sign: float) -> None:
    writer = CsvWriter(JOINTS, DT)
    for factor in (1.0, -3.0):
        errors = [sign * factor * error for error in (0.01, -0.02, 0.03)]
        joints = drives(*errors)
        writer.start(joints, [joint.torque for joint in joints])
        kept = 1.0
        for _ in range(500):
            writer.update([0.1] * 3, [0.2] * 3, joints)
            kept *= exp(-DT / 0.3)
            assert [joint.target_velocity for joint in joints] == pytest.approx(
                [0.2 + config.csv_gain * error * (1.0 - kept) for config, error in zip(JOINTS, errors, strict=True)]
            )
        assert [(joint.target_position, joint.target_torque) for joint in joints] == [(0.1, 0.0)] * 3


@SIGNS
def test_in_cst_each_start_holds_with_the_present_torque_inside_its_bound(sign: float) -> None:
    writer = CstWriter(JOINTS, DT, [joint.torque for joint in JOINTS])
    for factor in (0.5, -1.0):
        joints, error = drives(*[sign * 1e-3] * 3), sign * 1e-3
        for joint, share in zip(joints, (0.5, -0.8, 9.0), strict=True):
            joint.torque = sign * factor * share * JOINTS[0].torque
        writer.pass_on([0.2] * 3, [1.0] * 3, [1.0] * 3, joints)  # what came before is forgotten
        writer.start(joints, [joint.torque for joint in joints])
        writer.update([0.1] * 3, [0.0] * 3, joints)
        for drive, config in zip(joints, JOINTS, strict=True):
            most = config.torque
            held = max(-most, min(most, drive.torque)) + config.cst_integral * DT * error
            assert drive.target_torque == pytest.approx(max(-most, min(most, held)))


@SIGNS
def test_in_cst_the_loop_takes_over_from_passed_torques_without_a_step_and_then_acts_on_the_error(sign: float) -> None:
    writer, joints = CstWriter(JOINTS, DT, [joint.torque for joint in JOINTS]), drives(sign * 1e-3, -sign * 2e-3, 0.0)
    joints[2].velocity = sign * 0.01
    for passed in ([sign * 1.0, -sign * 2.0, sign * 3.0], [-sign * 4.0, sign * 5.0, 0.0]):
        weight = [0.5 * torque for torque in passed]
        for _ in range(5):
            writer.pass_on([drive.position for drive in joints], passed, weight, joints)
        assert [drive.target_torque for drive in joints] == passed
        excess = [0.0] * 3
        for cycle, further in enumerate((0.0, 1e-3, 1e-3)):
            writer.update([0.1 + further] * 3, [0.0] * 3, joints)
            for i, (drive, config) in enumerate(zip(joints, JOINTS, strict=True)):
                error = 0.1 + further - drive.position
                loop = config.cst_stiffness * error - config.cst_damping * drive.velocity
                # Of the passed torque the weight stays, and the rest fades out.
                excess[i] = excess[i] * exp(-DT / 0.03) if cycle else passed[i] - weight[i] - loop
                weight[i] += config.cst_integral * DT * error
                assert drive.target_torque == pytest.approx(weight[i] + loop + excess[i]), i


@SIGNS
def test_in_cst_a_passed_torque_and_the_integral_stay_inside_their_bound(sign: float) -> None:
    writer, joints = CstWriter(JOINTS, DT, [joint.torque for joint in JOINTS]), drives(sign * 0.02, -sign * 0.02, 0.0)
    bound = JOINTS[0].torque
    for cycle in range(1, 30):
        writer.pass_on([0.1] * 3, [sign * 1e4, -sign * 1e4, 0.0], [0.0] * 3, joints)
        # From 0 to the bound in 20 ms.
        risen = sign * bound * min(cycle * DT / 0.02, 1.0)
        assert [drive.target_torque for drive in joints] == pytest.approx([risen, -risen, 0.0])
    writer.start(joints, [joint.torque for joint in joints])
    for _ in range(5000):
        writer.update([0.1] * 3, [0.0] * 3, joints)
    assert [drive.target_torque for drive in joints] == pytest.approx([sign * bound, -sign * bound, 0.0])
    # A speed that was hidden by lost frames, or is false, changes the torque no faster.
    joints[0].velocity = sign * 10.0
    writer.update([0.1] * 3, [0.0] * 3, joints)
    assert joints[0].target_torque == pytest.approx(sign * bound * (1.0 - DT / 0.02))
