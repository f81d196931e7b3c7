"""`rtcp commission`: calibration is confirmed, then each joint turns for the first time; a record is kept."""

from __future__ import annotations

import contextlib
import io
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.api import Robot, RtcpError, State
from rtcp.cli.arguments import option, positive
from rtcp.cli.output import CommandError, ExitCode, asking, report
from rtcp.cli.platform import stoppable
from rtcp.config.document import read
from rtcp.config.model import VIRTUAL, ArmConfig, EthercatBus, Joint
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_session

LARGEST_ANGLE = 0.2
"""Largest first motion, rad."""
LARGEST_SPEED = 0.2
"""Largest speed of a first motion, rad/s."""
LARGEST_OFFSET = 7.0
"""Largest electrical offset angle, rad: somewhat more than a turn. A larger one is in degrees."""
OTHERS_STAY = 0.01
"""Largest distance by which a joint that was not commanded may have moved, rad."""
LARGEST_PART_MISSED = 0.5
"""Largest part of the commanded angle by which the joint may have turned more or less."""
_ANSWER = "answer it, or pass --answers"

commands = typer.Typer()


@dataclass(frozen=True)
class Answers:
    """The answers to the questions: from a file, else from the terminal."""

    given: dict[str, dict[str, Any]]
    """By joint and question; empty: all are asked."""
    bus: str

    def yes(self, joint: str, key: str, question: str, *, of_motion: bool = False) -> bool:
        """Return whether a question was answered with yes.

        Questions about motion are answered by a person at the terminal, except on the virtual bus.

        Raises:
            CommandError: the file lacks the answer, or it is none.
        """
        if not self.given or (of_motion and self.bus != VIRTUAL):
            with asking("a person answers it at a terminal" if of_motion and self.bus != VIRTUAL else _ANSWER):
                return typer.confirm(question)
        answer = self._of_file(joint, key)
        if not isinstance(answer, bool):
            raise CommandError(f"--answers: {joint}.{key}: found {answer!r}, allowed is true or false")
        report(f"{question} {'yes' if answer else 'no'} (--answers)")
        return answer

    def number(
        self, joint: str, key: str, question: str, largest: float, unit: str, *, of_motion: bool = False
    ) -> float:
        """Return a number from -`largest` to `largest`; raises CommandError as `yes`, and for another number."""
        if not self.given or (of_motion and self.bus != VIRTUAL):
            with asking("a person answers it at a terminal" if of_motion and self.bus != VIRTUAL else _ANSWER):
                answer = typer.prompt(question, type=float)
        else:
            answer = self._of_file(joint, key)
        is_number = isinstance(answer, int | float) and not isinstance(answer, bool)
        if not is_number or not abs(answer) <= largest:
            allowed = f"{-largest:g} to {largest:g} {unit}"
            raise CommandError(f"{joint}.{key}: found {answer!r}, allowed is {allowed}")
        return float(answer)

    def _of_file(self, joint: str, key: str) -> Any:
        answers = self.given.get(joint)
        if not isinstance(answers, dict) or key not in answers:
            raise CommandError(f"--answers: {joint}.{key} is missing")
        return answers[key]


class Record:
    """The record of an arm's commissioning: a file that is replaced as a whole after each joint."""

    def __init__(self, path: Path, arm: str) -> None:
        """Read the file where it is; raises CommandError for another arm's record, ConfigError for a damaged one."""
        self.path, self.arm = path, arm
        self.joints: dict[str, Any] = {}
        if path.exists():
            data = read(path).data
            if data.get("arm") != arm:
                raise CommandError(f"{path}: found the record of {data.get('arm')!r}, this arm is {arm!r}: give --out")
            self.joints = data.get("joints")
            if not isinstance(self.joints, dict):
                raise CommandError(f"{path}: joints: found {self.joints!r}, allowed is a mapping: give --out")

    def passed(self, joint: str) -> bool:
        """Return whether a joint has passed."""
        entry = self.joints.get(joint)
        return isinstance(entry, dict) and entry.get("passed") is True

    def write(self) -> None:
        """Replace the file; raises CommandError where that fails."""
        from ruamel.yaml import YAML

        text = io.StringIO()
        text.write("# Written by `rtcp commission`: angles in rad, torques in Nm, speeds in rad/s.\n")
        YAML().dump({"arm": self.arm, "joints": self.joints}, text)
        new = self.path.with_name(f".{self.path.name}.new")
        try:
            new.write_text(text.getvalue(), encoding="utf-8")
            os.replace(new, self.path)
        except OSError as error:
            raise CommandError(f"{self.path}: {error.strerror}; no record can be written there: give --out") from error


@commands.command("commission")
def _commission(
    joint: Annotated[
        str | None, typer.Argument(metavar="[JOINT]", help="Its name. Default: each that has not passed yet.")
    ] = None,
    angle: Annotated[float, option("--angle", "RAD", "How far a joint turns, and back.")] = 0.02,
    speed: Annotated[float, option("--speed", "RAD/S", "How fast it turns.")] = 0.05,
    answers: Annotated[
        Path | None, option("--answers", "FILE", "Answers by joint. On a network interface: not those of motion.")
    ] = None,
    out: Annotated[
        Path | None, option("--out", "FILE", "The record. Default: NAME.commissioning.yaml beside the arm's file.")
    ] = None,
) -> None:
    """Lead through the first motion of each joint; asks before each, and keeps a record. Ctrl-C stops the arm.

    The platform runs and its drives are disabled. All drives get torque, one joint turns; then all are disabled again.
    """
    positive("--angle", angle, "rad", LARGEST_ANGLE)
    positive("--speed", speed, "rad/s", LARGEST_SPEED)
    with stoppable("commission") as robot:
        config = read_session(runtime_directory()).config
        joints = _chosen(config, joint)
        record = Record(out or config.source.with_suffix(".commissioning.yaml"), config.name)
        record.write()  # a place where nothing can be written is noticed before anything moves
        asked = Answers({} if answers is None else read(answers).data, robot.status().raw["bus"])
        for place, chosen in joints:
            if joint is None and record.passed(chosen.name):
                report(f"{chosen.name} has passed already: `rtcp commission {chosen.name}` repeats it")
                continue
            require_ready(robot)
            entry: dict[str, Any] = {
                "at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
                "slave": chosen.slave,
                "bus": asked.bus,
            }
            record.joints[chosen.name] = entry
            entry["passed"] = False
            try:
                _first_motion(robot, place, angle, speed, asked, entry)
                entry["passed"] = True
            finally:
                record.write()
            report(f"{chosen.name} has passed: {entry['moved']:+.4f} rad, {entry['torque']:.2f} Nm held there")
    report(f"record: {record.path}; next: `rtcp enable`")


def _chosen(config: ArmConfig, name: str | None) -> list[tuple[int, Joint]]:
    """Return the joints to commission, and their places among all; raises CommandError where there are none."""
    if not isinstance(config.bus, EthercatBus):
        raise CommandError("commissioning is for EtherCAT drives: a robot controller does it for its own arm")
    joints = [(at, joint) for at, joint in enumerate(config.joints) if name in (None, joint.name)]
    if not joints:
        known = ", ".join(joint.name for joint in config.joints) or "this platform has none"
        raise CommandError(f"there is no joint {name}: {known}")
    return joints


def require_ready(robot: Robot) -> None:
    """Raise CommandError unless the platform is in state ready."""
    if (state := robot.status().state) is not State.READY:
        raise CommandError(
            f"the state is {state.name.lower().replace('_', ' ')}: the first motion begins in state ready, with the "
            "drives disabled (`rtcp disable`, after a fault `rtcp reset`)",
            ExitCode.REFUSED,
        )


def _first_motion(robot: Robot, place: int, angle: float, speed: float, asked: Answers, entry: dict[str, Any]) -> None:
    """Ask, turn one joint within the limits in force and turn it back, and write what was found into the entry.

    Raises:
        CommandError: an answer is no, or the joint did not move as commanded; the drives are disabled.
        RtcpError: the platform refused, or a fault ended the motion.
    """
    limits = robot.joint_limits()[place]
    name, speed = limits.name, min(speed, limits.velocity)
    if not asked.yes(name, "encoder_calibrated", f"{name}: was the encoder calibrated in the drive's own tool?"):
        raise CommandError(f"{name}: calibrate its encoder first: docs/commissioning.md", ExitCode.REFUSED)
    entry["encoder_calibrated"] = True
    entry["electrical_offset"] = asked.number(
        name, "electrical_offset", f"{name}: electrical offset angle that the tool shows, rad", LARGEST_OFFSET, "rad"
    )

    start = robot.status().positions
    if start[place] + angle > limits.max:
        angle = -angle
    question = (
        f"{name}: all drives get torque, and {name} turns by {angle:+g} rad at {speed:g} rad/s and back. "
        "Is nobody in reach, and the emergency stop in your hand?"
    )
    if not asked.yes(name, "clear", question, of_motion=True):
        raise CommandError(f"{name}: nothing has moved", ExitCode.REFUSED)
    entry.update(start=start[place], angle=angle, speed=speed)
    try:
        robot.enable()
        there = _turn(robot, place, angle, speed)
        back = _turn(robot, place, -angle, speed)
    except RtcpError:
        with contextlib.suppress(RtcpError):
            robot.disable()
        raise
    robot.disable()
    entry.update(moved=there[0] - start[place], torque=there[1], returned=back[0] - start[place])
    final = robot.status().positions
    strayed = [
        other
        for at, other in enumerate(robot.status().joint_names)
        if at != place and abs(final[at] - start[at]) > OTHERS_STAY
    ]
    if strayed:
        raise CommandError(f"{name} was to turn alone, but so did {', '.join(strayed)}", ExitCode.FAULT)
    if abs(entry["moved"] - angle) > LARGEST_PART_MISSED * abs(angle):
        raise CommandError(
            f"{name} was to turn by {angle:+g} rad, but turned by {entry['moved']:+.4f} rad: check its brake, and the "
            "sign and the gear ratio in the device file, docs/drives.md",
            ExitCode.FAULT,
        )
    sense = "positive" if angle > 0 else "negative"
    if not asked.yes(name, "direction", f"{name}: did it turn in its {sense} direction and back?", of_motion=True):
        raise CommandError(
            f"{name} turned the wrong way or not as far: check the sign and the gear ratio in the device file, "
            "docs/drives.md",
            ExitCode.FAULT,
        )


def _turn(robot: Robot, place: int, angle: float, speed: float) -> tuple[float, float]:
    """Turn one joint by an angle; return where it is then, rad, and the torque that holds it there, Nm."""
    status = robot.status()
    robot.move_by([angle if at == place else 0.0 for at in range(len(status.joint_names))], "joints", speed)
    status = robot.status()
    return status.positions[place], status.torques[place]
