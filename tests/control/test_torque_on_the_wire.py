"""The control mode `torque` on the wire: the real loop and device models (see tests/control/rig.py)."""

from __future__ import annotations

from rtcp.ipc.commands import ApplyTorque, SetControlMode
from rtcp.ipc.events import CommandExpired, FollowingError, OverSpeed, OverTorque
from rtcp.ipc.refusals import HoldTimeOutOfRange, TorqueOutOfRange, WrongControlMode
from rtcp.ipc.states import ControlMode, State

from .rig import CONFIG, CST, LoopRig

IN_TORQUE_MODE = SetControlMode(ControlMode.TORQUE)


def in_torque_mode(rig: LoopRig) -> LoopRig:
    rig.hold()
    rig.do(IN_TORQUE_MODE)
    rig.wait(lambda: not rig.machine.changing_mode)
    assert all(drive.mode_display == CST for drive in rig.log[-1].drives)
    return rig


def torques(first: float, second: float, hold_s: float = 1.0) -> ApplyTorque:
    return ApplyTorque((first, second), 0.0, 0.0, hold_s)


def push(rig: LoopRig, first: float, second: float, seconds: float) -> None:
    for _ in range(round(seconds / 0.1)):
        rig.do(torques(first, second))
        rig.run(0.1)


def test_the_torque_on_the_wire_is_bounded_and_so_is_the_speed_that_it_makes(rig: LoopRig) -> None:
    in_torque_mode(rig)
    begun = len(rig.log)
    push(rig, 49.0, -49.0, 1.0)
    push(rig, -49.0, 49.0, 1.0)
    push(rig, 4.0, 2.0, 0.3)
    rig.bring_to(State.HOLDING)
    rig.run(1.0)
    for axis, (drive, joint) in enumerate(zip(rig.arm.drives, CONFIG.joints, strict=True)):
        frames = [cycle.drives[axis] for cycle in rig.log[begun:]]
        efforts = [frame.effort for frame in frames]
        one_nm = drive_scale(rig, axis)
        assert max(map(abs, efforts)) <= joint.torque * one_nm + 1
        # It pushed both ways.
        assert max(efforts) > 2.0 * one_nm
        assert min(efforts) < -2.0 * one_nm
        fastest = max(abs(frame.velocity) for frame in frames) / 10000
        assert 0.5 * joint.velocity < fastest <= 1.05 * joint.velocity
        assert abs(drive.velocity) < 0.01
    assert CommandExpired in rig.kinds
    assert not {OverSpeed, OverTorque, FollowingError} & set(rig.kinds)


def drive_scale(rig: LoopRig, axis: int) -> float:
    """Counts that the driver encodes for 1 Nm."""
    drive = rig.arm.drives[axis]
    kept, drive.target_torque = drive.target_torque, 1.0
    unit = abs(effort_of(drive.encode()))
    drive.target_torque = kept
    return unit


def effort_of(output: bytes) -> int:
    return int.from_bytes(output[10:14], "little", signed=True)


def test_a_torque_beyond_the_joints_limit_is_refused_and_one_in_another_mode_too(rig: LoopRig) -> None:
    rig.hold()
    assert isinstance(rig.send(torques(1.0, 0.0)).refusal, WrongControlMode)
    rig.do(IN_TORQUE_MODE)
    rig.wait(lambda: not rig.machine.changing_mode)
    assert isinstance(rig.send(torques(49.5, 0.0)).refusal, TorqueOutOfRange)
    assert isinstance(rig.send(torques(1.0, 0.0, 2.0)).refusal, HoldTimeOutOfRange)
    assert rig.state is State.HOLDING
