"""`rtcp demo`: start the platform, move the arm, stop, and show how well the cycle held."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli.arguments import BusName, ConfigFile, check_picture, positive
from rtcp.cli.connection import connect
from rtcp.cli.errors import SUSPENDING, CommandError, ExitCode, interruption_code, signals_raise
from rtcp.cli.motion import MOVE_TIMEOUT_S, arrival, move_joints
from rtcp.cli.output import ABSENT, report, show, table
from rtcp.cli.platform import launch, refuse_second_platform
from rtcp.cli.status import CYCLE_TIMES, quantiles, realtime_line
from rtcp.ipc.client import ControlClient
from rtcp.launch import offline

if TYPE_CHECKING:
    from rich.table import Table

    from rtcp.config.model import ArmConfig, Joint
    from rtcp.launch.launcher import StartOptions
    from rtcp.telemetry.square import Driven, Square

REACH = 0.35
"""Distance of each joint of a pose from the start, rad; less near a limit."""
POSES = ((1, -1, 1, 1, -1, 1), (-1, 1, 1, -1, 1, -1), (1, 1, -1, 1, 1, 1), (-1, -1, -1, -1, -1, 1))
"""Directions of the poses, joint by joint."""
MARGIN = 0.05
"""Part of a joint's range that the poses keep from each end."""
LOCK_TIMEOUT_S = 10.0
LONGEST_S = 3600.0
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *SUSPENDING)


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("demo")(_demo)


def _demo(
    config: ConfigFile = None,
    bus: BusName = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="N", help="Duration of the motion, s.")] = 6.0,
    square: Annotated[
        str | None, typer.Option("--square", metavar="xy|yz|xz", help="Drive a square of 200 mm in this plane instead.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Picture of the square: PNG, SVG or PDF.")
    ] = None,
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
    try:
        with signals_raise(*SUSPENDING), _platform(options) as started_s, connect("demo") as client:
            status, mean_ns = _run(client, arm.joints, seconds, drive)
    except KeyboardInterrupt as interruption:
        raise CommandError("interrupted: the platform has been stopped", interruption_code(interruption)) from None
    show(figures(status, status.get("start_to_op_s", started_s), mean_ns))
    if drive is not None:
        drive.report()


@contextmanager
def _platform(options: StartOptions) -> Iterator[float]:
    """Run a platform and yield the duration of its start, s; stop it on exit, also on a second Ctrl-C."""
    begun = time.monotonic()
    running = launch(options)
    try:
        yield time.monotonic() - begun
    finally:
        handlers = {number: signal.signal(number, signal.SIG_IGN) for number in _ENDING}
        try:
            problems = running.stop(report)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        if not problems:
            report("stopped")


def _run(
    client: ControlClient, joints: Sequence[Joint], seconds: float, drive: SquareDrive | None
) -> tuple[dict[str, Any], float | None]:
    """Enable, move, return; give the last status with the drives enabled and the mean cycle, ns."""
    _wait_for_clocks(client)
    client.call("enable")
    report("enabled: the drives hold the arm where it is")
    before, since_ns = client.call("status"), time.monotonic_ns()
    home = [
        min(joint.position.max, max(joint.position.min, float(position)))
        for joint, position in zip(joints, before["joints"]["position"], strict=True)
    ]
    if drive is not None:
        drive.run(client)
    else:
        until, number = time.monotonic() + seconds, 0
        while number == 0 or time.monotonic() < until:
            target = pose(home, joints, POSES[number % len(POSES)])
            number += 1
            report(f"pose {number}: {arrival(move_joints(client, target))}")
    report(f"back: {arrival(move_joints(client, home))}")
    after, passed_ns = client.call("status"), time.monotonic_ns() - since_ns
    client.call("disable")
    report("disabled")
    cycles = int(after["cycles"]) - int(before["cycles"])
    if isinstance(before.get("time_ns"), int) and isinstance(after.get("time_ns"), int):
        passed_ns = after["time_ns"] - before["time_ns"]  # of the cycles themselves, where they are reported
    return after, passed_ns / cycles if cycles > 0 else None


def pose(home: Sequence[float], joints: Sequence[Joint], directions: Sequence[int]) -> list[float]:
    """Return a pose `REACH` away from `home`, rad, inside the limits of every joint."""
    target = []
    for number, (start, joint) in enumerate(zip(home, joints, strict=True)):
        margin = MARGIN * (joint.position.max - joint.position.min)
        wanted = start + math.copysign(REACH, directions[number % len(directions)])
        target.append(min(joint.position.max - margin, max(joint.position.min + margin, wanted)))
    return target


def _wait_for_clocks(client: ControlClient) -> None:
    """Return when the master is locked to the reference clock, or at once on a bus without distributed clocks."""
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        clocks = client.call("status").get("dc") or {}
        if clocks.get("locked") is None:
            report("no distributed clocks on this bus")
            return
        if clocks["locked"]:
            report("clocks locked")
            return
        if time.monotonic() > deadline:
            raise CommandError(f"the clocks have not locked within {LOCK_TIMEOUT_S:g} s", ExitCode.FAULT)
        time.sleep(0.05)


def figures(status: Mapping[str, Any], start_to_op_s: float | None, mean_ns: float | None) -> Table:
    """Return the figures of a run; an unknown one is a dash.

    Args:
        status: the platform's last status with the drives enabled.
        start_to_op_s: from the command to all slaves in OP, s.
        mean_ns: mean cycle, ns.
    """
    rows = table(("figure", "value"), ("figure", "value"), title="rtcp demo", fill="value")
    target = status.get("cycle_ns")
    deviation = f" ({(mean_ns / target - 1) * 100:+.4f} %)" if mean_ns and target else ""
    rows.add_row("state", str(status.get("state", ABSENT)))
    rows.add_row("cycle, target", f"{target / 1000:.3f} us" if target else ABSENT)
    rows.add_row("cycle, mean", f"{mean_ns / 1000:.3f} us{deviation}" if mean_ns else ABSENT)
    rows.add_row("cycles, missed", f"{status.get('cycles', ABSENT)}, {status.get('missed', ABSENT)}")
    for label, key in CYCLE_TIMES:
        rows.add_row(f"{label} p50 / p99 / max", f"{' / '.join(quantiles(status, key))} us")
    clocks = status.get("dc") or {}
    offsets = [
        f"{label} p99 {quantiles(clocks, key)[1]} us"
        for key, label in (("filtered_us", "filtered"), ("offset_us", "raw"))
        if key in clocks
    ]
    rows.add_row("clock offset", ", ".join(["locked" if clocks.get("locked") else "not locked", *offsets]))
    rows.add_row("start to OP", ABSENT if start_to_op_s is None else f"{start_to_op_s:.2f} s")
    rows.add_row("real time", realtime_line(status.get("realtime") or {}))
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

    def run(self, client: ControlClient) -> None:
        """Move to the first corner, then along the four sides, while every cycle is recorded.

        Raises:
            RtcpError: as the platform ended a motion.
            CommandError: nothing moved.
        """
        from rtcp.ipc.runtime_directory import blackboard_file, runtime_directory
        from rtcp.telemetry.recording import recording
        from rtcp.telemetry.square import SPEED_M_S, NoSquare, judge

        square, model = self._square, self._config.arm
        report(f"first corner: {arrival(move_joints(client, square.start))}")
        with recording(blackboard_file(runtime_directory())) as recorded:
            arguments = {"poses": square.poses, "speed": SPEED_M_S}
            result = client.call("line", arguments, timeout_s=MOVE_TIMEOUT_S)
        report(f"square in {square.plane}: {arrival(result)}")
        if model is None:
            raise CommandError("the arm has no geometry (key kinematics)")
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
        if self._driven.lost:
            report(f"{self._driven.lost} cycle records are missing in the recording")
        try:
            draw(self._driven, self._out)
        except OSError as error:
            raise CommandError(f"the picture {self._out} cannot be written: {error.strerror}") from error
        report(f"picture: {self._out}")
