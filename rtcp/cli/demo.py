"""`rtcp demo`: start the platform, move the arm, stop, and show how well the cycle held."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.api import Robot
from rtcp.cli.arguments import BusName, ConfigFile, check_picture, option, positive
from rtcp.cli.motion import arrival
from rtcp.cli.output import SUSPENDING, CommandError, ExitCode, interruptible, report, show, table
from rtcp.cli.platform import connect, refuse_second_platform, running_platform
from rtcp.cli.status import CYCLE_TIMES, clock_state, quantiles, realtime_line
from rtcp.launch import offline

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.config.model import ArmConfig, Joint
    from rtcp.telemetry.square import Driven, Square

REACH = 0.35
"""Distance of each joint of a pose from the start, rad; less near a limit."""
POSES = ((1, -1, 1, 1, -1, 1), (-1, 1, 1, -1, 1, -1), (1, 1, -1, 1, 1, 1), (-1, -1, -1, -1, -1, 1))
"""Directions of the poses, joint by joint."""
MARGIN = 0.05
"""Part of a joint's range that the poses keep from each end."""
LOCK_TIMEOUT_S = 10.0
LONGEST_S = 3600.0

commands = typer.Typer()


@commands.command("demo")
def _demo(
    config: ConfigFile = None,
    bus: BusName = None,
    seconds: Annotated[float, option("--seconds", "N", "Duration of the motion, s.")] = 6.0,
    square: Annotated[
        str | None, option("--square", "xy|yz|xz", "Drive a square of 200 mm in this plane instead.")
    ] = None,
    picture: Annotated[Path | None, option("--picture", "FILE", "Picture of the square: PNG, SVG or PDF.")] = None,
) -> None:
    """Start, enable, move, return, stop, and show how well the cycle held.

    The motion is a few poses, or with --square a square of straight lines at 50 mm/s and a picture of it: path,
    deviation, joint angles, speeds and torques.
    """
    positive("--seconds", seconds, "s", LONGEST_S)
    if picture is not None and square is None:
        raise CommandError("--picture needs --square xy, yz or xz")
    refuse_second_platform()
    arm = offline.configuration(config)
    drive = _prepare(arm, square.lower(), picture) if square is not None else None
    from rtcp.launch.launcher import StartOptions

    options = StartOptions(config=config, bus=bus, mode="csp")
    stoppable = interruptible("interrupted: the platform has been stopped", *SUSPENDING)
    with stoppable, running_platform(options) as started_s, connect("demo") as robot:
        status, mean_ns = _run(robot, arm.joints, seconds, drive)
    show(figures(status, started_s, mean_ns))
    if drive is not None:
        drive.report()


def _run(
    robot: Robot, joints: Sequence[Joint], seconds: float, drive: SquareDrive | None
) -> tuple[Mapping[str, Any], float]:
    """Enable, move, return; give the last status with the drives enabled and the mean cycle, ns."""
    _wait_for_clocks(robot)
    robot.enable()
    report("enabled: the drives hold the arm where it is")
    before = robot.status().raw
    home = [
        min(joint.position.max, max(joint.position.min, float(position)))
        for joint, position in zip(joints, before["joints"]["actual_position"], strict=True)
    ]
    if drive is not None:
        drive.run(robot)
    else:
        until, number = time.monotonic() + seconds, 0
        while number == 0 or time.monotonic() < until:
            target = pose(home, joints, POSES[number % len(POSES)])
            number += 1
            report(f"pose {number}: {arrival(robot.move_joints(target))}")
    report(f"back: {arrival(robot.move_joints(home))}")
    after = robot.status().raw
    robot.disable()
    report("disabled")
    return after, (after["time_ns"] - before["time_ns"]) / max(1, after["cycles"] - before["cycles"])


def pose(home: Sequence[float], joints: Sequence[Joint], directions: Sequence[int]) -> list[float]:
    """Return a pose `REACH` away from `home`, rad, inside the limits of every joint."""
    target = []
    for number, (start, joint) in enumerate(zip(home, joints, strict=True)):
        margin = MARGIN * (joint.position.max - joint.position.min)
        wanted = start + math.copysign(REACH, directions[number % len(directions)])
        target.append(min(joint.position.max - margin, max(joint.position.min + margin, wanted)))
    return target


def _wait_for_clocks(robot: Robot) -> None:
    """Return when the master is locked to the reference clock; raises CommandError."""
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        clocks = robot.status().raw["dc"]
        if clocks is None:
            return
        if clocks["locked"]:
            report("clocks locked")
            return
        if time.monotonic() > deadline:
            raise CommandError(f"the clocks have not locked within {LOCK_TIMEOUT_S:g} s", ExitCode.FAULT)
        time.sleep(0.05)


def figures(status: Mapping[str, Any], started_s: float, mean_ns: float) -> Table:
    """Return the figures of a run.

    Args:
        status: the platform's last status with the drives enabled.
        started_s: duration of the start, s, where the platform does not report it.
        mean_ns: mean cycle, ns.
    """
    rows = table(("figure", "value"), ("figure", "value"), title="rtcp demo", fill="value")
    target, clocks = status["cycle_ns"], status["dc"]
    rows.add_row("state", status["state"])
    rows.add_row("cycle, target", f"{target / 1000:.3f} us")
    rows.add_row("cycle, mean", f"{mean_ns / 1000:.3f} us ({(mean_ns / target - 1) * 100:+.4f} %)")
    rows.add_row("cycles, missed", f"{status['cycles']}, {status['missed']}")
    for label, key in CYCLE_TIMES:
        rows.add_row(f"{label} p50 / p99 / max", f"{' / '.join(quantiles(status[key]))} us")
    if clocks is not None:
        filtered, raw = (quantiles(clocks[key])[1] for key in ("filtered_us", "offset_us"))
        rows.add_row("clock offset", f"{clock_state(clocks)}, filtered p99 {filtered} us, raw p99 {raw} us")
    rows.add_row("start to OP", f"{status['start_to_op_s'] or started_s:.2f} s")
    rows.add_row("real time", realtime_line(status["realtime"]))
    if skipped := status.get("skipped_ticks"):
        rows.add_row("skipped ticks", f"{skipped['message']}; {skipped['remedy']}")
    return rows


# -- the square -----------------------------------------------------------------------------------------------------


def _prepare(config: ArmConfig, plane: str, picture: Path | None) -> SquareDrive:
    """Find a place for the square and its picture, before anything is started; raises CommandError."""
    from rtcp.telemetry.square import PLANES, NoSquare, place

    if plane not in PLANES:
        raise CommandError(f"--square {plane} is not known: {', '.join(PLANES)}")
    out = Path(f"square-{plane}.png") if picture is None else picture
    check_picture("--picture", out)
    if not out.absolute().parent.is_dir():
        raise CommandError(f"--picture {out}: there is no folder {out.absolute().parent}")
    try:
        return SquareDrive(config, place(config, plane), out)
    except NoSquare as error:
        raise CommandError(str(error), ExitCode.REFUSED) from error


class SquareDrive:
    """Drives a square once and reports the deviation.

    Args:
        config: the arm.
        square: its place.
        out: file of the picture.
    """

    def __init__(self, config: ArmConfig, square: Square, out: Path) -> None:
        self._config = config
        self._square = square
        self._out = out
        self._driven: Driven | None = None

    def run(self, robot: Robot) -> None:
        """Move to the first corner, then along the four sides, while every cycle is recorded.

        Raises:
            RtcpError: the platform ended a motion.
            CommandError: nothing moved.
        """
        from rtcp.telemetry.reading import read
        from rtcp.telemetry.square import SPEED_M_S, NoSquare, judge

        square, model = self._square, self._config.arm
        report(f"first corner: {arrival(robot.move_joints(square.start))}")
        if model is None:
            raise CommandError("the arm has no geometry (key kinematics)")
        with TemporaryDirectory() as folder:
            begun = robot.record_start(path := Path(folder) / "square.mcap")
            arrived = robot.move_line(square.poses, SPEED_M_S)
            robot.record_stop(begun.pid)
            recorded = read(path)
        report(f"square in {square.plane}: {arrival(arrived)}")
        try:
            self._driven = judge(model, square, recorded)
        except NoSquare as error:
            raise CommandError(str(error), ExitCode.FAULT) from error

    def report(self) -> None:
        """Print how far the tool was from the square, and draw the picture."""
        from rtcp.telemetry.square import draw

        if self._driven is None:
            return
        commanded, actual = (1e3 * worst for worst in self._driven.worst)
        report(f"largest deviation from the square: {commanded:.3f} mm commanded, {actual:.2f} mm actual")
        if self._driven.missing:
            report(f"{self._driven.missing} cycle records are missing in the recording")
        try:
            draw(self._driven, self._out)
        except OSError as error:
            raise CommandError(f"the picture {self._out} cannot be written: {error.strerror}") from error
        report(f"picture: {self._out}")
