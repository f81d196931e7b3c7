"""`rtcp device try`: one axis turns on the bench, and what was commanded, reported and seen is compared."""

from __future__ import annotations

import math
from enum import Enum
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from rtcp.api import Robot, RtcpError
from rtcp.cli import device
from rtcp.cli.arguments import option, positive
from rtcp.cli.commission import Answers, require_ready
from rtcp.cli.output import CommandError, ExitCode, report
from rtcp.cli.platform import stoppable
from rtcp.config.document import read
from rtcp.config.model import ArmConfig, EthercatBus, Joint
from rtcp.config.scaling import DriveScaling
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_session

LARGEST_ANGLE_DEG = 30.0
SPEED_DEG_S = 1.0
_LARGEST_SEEN_DEG = 36_000.0
_SMALLEST_ANGLE_DEG = 0.5
_NOTHING_SEEN_DEG = 0.1
"""Angle that nobody sees, degrees."""
_NOTHING_REPORTED = 0.01
"""Part of the commanded angle below which the drive reports no motion."""
_REPORTED_WITHIN, _SEEN_WITHIN = 0.1, 0.3
"""Largest relative difference of the reported angle, and of an angle that a person has estimated."""
_INCREMENTS_PER_LINE = 4
"""Increments that a drive counts for one line of an incremental encoder."""


class Cause(Enum):
    """What is wrong with an axis."""

    SCALING = "scaling"
    SIGN = "sign"
    GEAR = "gear"
    ENCODER = "encoder"
    NO_MOTION = "no motion"


class Diagnosis(NamedTuple):
    """A cause, and what to do."""

    cause: Cause
    remedy: str


def diagnose(
    commanded: float, reported: float, seen: float, scaling: DriveScaling | None, *, ended_early: bool = False
) -> list[Diagnosis]:
    """Return what is wrong with an axis; empty: nothing.

    Args:
        commanded: angle by which the joint was to turn; not 0.
        reported: angle by which it turned by the drive's own position.
        seen: angle by which a person saw its shaft turn; all three in degrees, positive in the joint's sense.
        scaling: of the axis, in the device's file.
        ended_early: a fault or a stop ended the motion, so that less was turned than commanded.
    """
    by_drive, by_eye = reported / commanded, seen / commanded
    unseen = abs(seen) < _NOTHING_SEEN_DEG
    if unseen and abs(reported) < 2 * _NOTHING_SEEN_DEG:
        remedy = "too little was turned to be compared: check the brake, the motor's phases and 0x6072"
        return [Diagnosis(Cause.NO_MOTION, remedy)]
    if abs(by_drive) < _NOTHING_REPORTED:
        remedy = (
            "the shaft turned, and the drive reports none of it: its `position` is not that of this shaft's encoder"
        )
        return [Diagnosis(Cause.ENCODER, remedy)]
    found = []
    if by_drive < 0:
        remedy = "the drive reports a motion against the commanded one: its encoder counts against the motor's sense"
        found.append(Diagnosis(Cause.ENCODER, f"{remedy}; correct it in the drive (phases, or 0x607E)"))
    elif not _near(by_drive, 1.0, _REPORTED_WITHIN) and not (ended_early and by_drive < 1.0):
        remedy = (
            f"the drive reports {by_drive:.3g} times the commanded angle: its `position` (0x6064) counts in another "
            "unit than `target_position` (0x607A)"
        )
        found.append(Diagnosis(Cause.ENCODER, remedy))
    if found and _near(by_eye, 1.0, _SEEN_WITHIN):
        return found  # the drive turned the shaft as commanded, and reports something else
    if unseen:
        remedy = (
            "the drive reports a motion that the shaft did not make: check the coupling between motor and shaft; or "
            "`gear_ratio` is far too small, so that the turn was too small to be seen"
        )
        return [*found, Diagnosis(Cause.GEAR, remedy)]
    times = seen / reported
    if times < 0:
        remedy = "the shaft turned the other way: change the sign of `external_gear_ratio`"
        found.append(Diagnosis(Cause.SIGN, remedy))
    if not _near(abs(times), 1.0, _SEEN_WITHIN):
        found.append(_wrong_scale(abs(times), scaling))
    return found


def _wrong_scale(times: float, scaling: DriveScaling | None) -> Diagnosis:
    """Return why the shaft turned `times` as far as the drive reports."""
    seen = f"the shaft turned {times:.3g} times as far as the drive reports"
    if scaling is None:
        factors = "the factors of the channels `position` and `target_position`"
        return Diagnosis(Cause.SCALING, f"{seen}: multiply {factors} by {times:.3g}")
    for key, ratio in (("gear_ratio", scaling.gear_ratio), ("external_gear_ratio", abs(scaling.external_gear_ratio))):
        if ratio != 1.0 and _near(times, ratio, _SEEN_WITHIN):
            remedy = f"which is `{key}`: the drive's counts are already those behind this gear, so `{key}` is 1"
            return Diagnosis(Cause.GEAR, f"{seen}, {remedy}")
        if ratio != 1.0 and _near(times, 1.0 / ratio, _SEEN_WITHIN):
            return Diagnosis(
                Cause.GEAR, f"{seen}, which is 1 / `{key}`: this gear is there twice, or `{key}` is inverted"
            )
    if scaling.gear_ratio == 1.0 and times < 1.0 and not _near(times, 1.0 / _INCREMENTS_PER_LINE, _SEEN_WITHIN):
        remedy = f"a gear of about {1.0 / times:.3g}:1 is between motor and shaft, and `gear_ratio` is 1"
        return Diagnosis(Cause.GEAR, f"{seen}: {remedy}")
    wanted = scaling.encoder_increments / times
    for factor in (_INCREMENTS_PER_LINE, 1.0 / _INCREMENTS_PER_LINE):
        if _near(times, factor, _SEEN_WITHIN):
            remedy = f"`encoder_increments` is {scaling.encoder_increments:g}, and about {wanted:.6g} fits"
            return Diagnosis(Cause.ENCODER, f"{seen}: {remedy} (a line of an encoder is 4 increments)")
    product = "`encoder_increments` times `gear_ratio` times `external_gear_ratio`"
    remedy = (
        f"{product} is {times:.3g} times too large" if times > 1 else f"{product} is {1 / times:.3g} times too small"
    )
    return Diagnosis(Cause.SCALING, f"{seen}: {remedy}")


def _near(value: float, wanted: float, within: float) -> bool:
    return abs(value - wanted) <= within * wanted


@device.device.command("try")
def _try(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the drive under `slaves` of the arm's file.")],
    axis: Annotated[int, option("--axis", "N", "Axis of the drive, from 1.")] = 1,
    angle: Annotated[float, option("--angle", "DEG", "How far the shaft turns, and back.")] = 1.0,
    answers: Annotated[
        Path | None, option("--answers", "FILE", "Answers by drive. On a network interface: not those of motion.")
    ] = None,
) -> None:
    """Turn one axis on the bench, with a free shaft, by 1 degree and back, and say what is wrong with its scaling.

    The platform runs with an arm's file that has this one joint; the drive is disabled. Afterwards it is disabled
    again. Ctrl-C stops and disables it.
    """
    positive("--angle", angle, "degrees", LARGEST_ANGLE_DEG)
    if angle < _SMALLEST_ANGLE_DEG:
        raise CommandError(f"--angle {angle:g} is not allowed: at least {_SMALLEST_ANGLE_DEG:g} degrees, to be seen")
    with stoppable("device try", "the shaft comes to a stop, and the drive is disabled") as robot:
        config = read_session(runtime_directory()).config
        joint = _joint(config, name, axis)
        asked = Answers({} if answers is None else read(answers).data, robot.status().raw["bus"])
        require_ready(robot)
        _turn_and_compare(robot, config, joint, angle, asked)


def _joint(config: ArmConfig, name: str, axis: int) -> Joint:
    """Return the joint that an axis of a drive moves, which is the only one; raises CommandError."""
    joints, axes = config.joints, config.axes
    if not isinstance(config.bus, EthercatBus):
        raise CommandError("`rtcp device try` is for EtherCAT drives: a robot controller moves its own arm")
    found = [joint for joint in joints if (joint.slave, joint.axis) == (name, axis)]
    if not found:
        known = "; ".join(f"{joint.slave} --axis {joint.axis}" for joint in joints) or "none"
        raise CommandError(f"no joint of {config.source} is moved by {name}, axis {axis}: found are {known}")
    if len(axes) > 1:
        others = ", ".join(joint.name for joint in axes if joint is not found[0])
        raise CommandError(
            f"{config.source} has further drives, which would get torque too: {others}. Start the platform with a file "
            "of this one joint, as `rtcp arm new --joints 1` writes it, and with this drive alone on the cable",
            ExitCode.REFUSED,
        )
    return found[0]


def _turn_and_compare(robot: Robot, config: ArmConfig, joint: Joint, angle: float, asked: Answers) -> None:
    """Ask whether the shaft is free, turn it there and back, ask what was seen, and report what is wrong.

    Raises:
        CommandError: the answer is no, or something is wrong; the drive is disabled.
        RtcpError: the platform refused before anything moved.
    """
    (limits,) = robot.joint_limits()
    speed = min(math.radians(SPEED_DEG_S), limits.velocity)
    (start,) = robot.status().positions
    if start + math.radians(angle) > limits.max:
        angle = -angle
    place = joint.place
    question = (
        f"{place}: the drive gets torque, and the shaft turns by {angle:+g} degrees at {math.degrees(speed):.3g} "
        "degrees/s and back; with a wrong gear ratio further and faster. Is the shaft free (no arm, no load, no tool "
        "on it), is nobody in reach, and is the emergency stop in your hand?"
    )
    if not asked.yes(joint.slave, "free_shaft", question, of_motion=True):
        raise CommandError(f"{place}: nothing has moved", ExitCode.REFUSED)
    report(f"watch the shaft: a pointer of 30 cm moves by {5.2 * abs(angle):.3g} mm at its tip")
    reached, failure = _there_and_back(robot, math.radians(angle), speed)
    turned = math.degrees(reached[0] - start)
    back = f", and {math.degrees(reached[-1] - start):+.3f} after the way back" if len(reached) > 1 else ""
    report(f"commanded {angle:+.3f} degrees, reported {turned:+.3f}{back}")
    if failure:
        report(f"the motion ended with: {failure}")
    seen = asked.number(
        joint.slave, "seen_deg",
        f"{place}: by how many degrees did you see the shaft turn before it turned back (positive: as the joint)",
        _LARGEST_SEEN_DEG, "degrees", of_motion=True,
    )  # fmt: skip
    slave = next(slave for slave in config.slaves if slave.name == joint.slave)
    found = diagnose(angle, turned, seen, slave.device.scaling_of(joint.axis), ended_early=bool(failure))
    for cause, remedy in found:
        report(f"{cause.value}: {remedy}")
    if found or failure:
        causes = ", ".join(dict.fromkeys(cause.value for cause, _ in found)) or failure
        raise CommandError(f"{place} did not turn as commanded: {causes}; see docs/drives.md#scaling", ExitCode.FAULT)
    report(f"{place}: commanded, reported and seen motion agree")


def _there_and_back(robot: Robot, angle: float, speed: float) -> tuple[list[float], str]:
    """Enable, turn by `angle`, rad, and back; return the position after each motion, and what ended one early.

    The drive is disabled afterwards, also after Ctrl-C: an axis whose scaling is unknown does not stay enabled.

    Raises:
        RtcpError: the drive cannot be enabled, or the motion was refused.
        CommandError: the drive cannot be disabled.
    """
    reached: list[float] = []
    try:
        robot.enable()
        try:
            for turn in (angle, -angle):
                robot.move_by([turn], "joints", speed)
                reached.append(robot.status().positions[0])
        except RtcpError as error:
            if error.kind in ("refused", "invalid"):
                raise
            return [*reached, robot.status().positions[0]], error.message
    finally:
        try:
            robot.disable()
        except RtcpError as error:
            problem = f"the drive may still have torque, it could not be disabled: {error.message}"
            raise CommandError(problem, ExitCode.FAULT) from error
    return reached, ""
