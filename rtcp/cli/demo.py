"""`rtcp demo`: the whole platform once through, from nothing to a table of figures and back to nothing."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rtcp.cli import demo_square
from rtcp.cli.connection import connect
from rtcp.cli.errors import SUSPENDING, CommandError, ExitCode, interruption_code, orderly_signals
from rtcp.cli.launch import launch, refuse_a_second_platform
from rtcp.cli.motion import arrival, move
from rtcp.cli.options import BusName, ConfigFile
from rtcp.cli.output import report, show
from rtcp.ipc.client import ControlClient
from rtcp.launch import offline

if TYPE_CHECKING:
    from rtcp.config.model import Joint
    from rtcp.launch.launcher import StartOptions

REACH = 0.35
"""How far a pose lies from where the arm stood, rad; less where a limit is nearer."""

POSES = ((1, -1, 1, 1, -1, 1), (-1, 1, 1, -1, 1, -1), (1, 1, -1, 1, 1, 1), (-1, -1, -1, -1, -1, 1))
"""Directions of the poses, joint by joint."""

MARGIN = 0.05
"""Part of a joint's range that the demo keeps away from each end."""

ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, *SUSPENDING)
LOCK_TIMEOUT_S = 10.0
LONGEST_S = 3600.0


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("demo")(_demo)


def _demo(
    config: ConfigFile = None,
    bus: BusName = None,
    seconds: Annotated[float, typer.Option("--seconds", metavar="N", help="How long to move, s.")] = 6.0,
    square: Annotated[
        str | None, typer.Option("--square", metavar="xy|yz|xz", help="Drive a square of 200 mm in this plane instead.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Where the square's picture goes; PNG, SVG or PDF.")
    ] = None,
) -> None:
    """Start, enable, move, come back, stop, and show how well the cycle held.

    The motion is a few poses, or with --square a square of straight lines at 50 mm/s, of which a picture is drawn:
    path, deviation, joint angles, speeds and torques.
    """
    if not 0 < seconds <= LONGEST_S:
        raise CommandError(f"--seconds {seconds:g} is not allowed: above 0, at most {LONGEST_S:g}")
    if picture is not None and square is None:
        raise CommandError("--picture needs --square xy, yz or xz: it is the square's")
    refuse_a_second_platform()
    arm = offline.configuration(config)
    drive = demo_square.prepare(arm, square, picture) if square is not None else None
    from rtcp.launch.launcher import StartOptions

    options = StartOptions(config=config, bus=bus, mode="csp")
    try:
        with orderly_signals(*SUSPENDING), _platform(options) as started_s, connect("demo") as client:
            status, mean_ns = _run(client, arm.joints, seconds, drive)
    except KeyboardInterrupt as interruption:
        raise CommandError("interrupted: the platform has been stopped", interruption_code(interruption)) from None
    given = status.get("start_to_op_s")
    from rtcp.cli.demo_view import table

    show(table(status, given if isinstance(given, int | float) else started_s, mean_ns))
    if drive is not None:
        drive.tell()


def _run(
    client: ControlClient, joints: Sequence[Joint], seconds: float, drive: demo_square.SquareDrive | None
) -> tuple[dict[str, Any], float | None]:
    """Enable, move, come back, and return the last status with the drives enabled and the mean cycle, ns."""
    _wait_for_the_clocks(client)
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
        _poses(client, joints, home, seconds)
    report(f"back: {arrival(move(client, home, None, _unseen))}")
    after, passed_ns = client.call("status"), time.monotonic_ns() - since_ns
    client.call("disable")
    report("disabled")
    return after, _mean_cycle_ns(before, after, passed_ns)


def pose(home: Sequence[float], joints: Sequence[Joint], directions: Sequence[int]) -> list[float]:
    """Return a pose `REACH` away from `home`, rad, well inside the limits of every joint."""
    target = []
    for number, (start, joint) in enumerate(zip(home, joints, strict=True)):
        margin = MARGIN * (joint.position.max - joint.position.min)
        wanted = start + math.copysign(REACH, directions[number % len(directions)])
        target.append(min(joint.position.max - margin, max(joint.position.min + margin, wanted)))
    return target


def _poses(client: ControlClient, joints: Sequence[Joint], home: Sequence[float], seconds: float) -> None:
    until = time.monotonic() + seconds
    number = 0
    while number == 0 or time.monotonic() < until:
        target = pose(home, joints, POSES[number % len(POSES)])
        number += 1
        report(f"pose {number}: {arrival(move(client, target, None, _unseen))}")


def _wait_for_the_clocks(client: ControlClient) -> None:
    """Return when the master follows the reference clock, or at once on a bus without distributed clocks."""
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        clocks = client.call("status").get("dc")
        if not isinstance(clocks, dict) or clocks.get("locked") is None:
            report("no distributed clocks on this bus")
            return
        if clocks["locked"]:
            report("clocks locked")
            return
        if time.monotonic() > deadline:
            raise CommandError(f"the clocks have not locked within {LOCK_TIMEOUT_S:g} s", ExitCode.FAULT)
        time.sleep(0.05)


def _mean_cycle_ns(before: Mapping[str, Any], after: Mapping[str, Any], passed_ns: int) -> float | None:
    """Return the mean cycle by the records' own instants where they are told, else by those of the two questions."""
    cycles = int(after["cycles"]) - int(before["cycles"])
    if cycles <= 0:
        return None
    instants = (before.get("time_ns"), after.get("time_ns"))
    if isinstance(instants[0], int) and isinstance(instants[1], int):
        passed_ns = instants[1] - instants[0]
    return passed_ns / cycles


def _unseen(progress: Mapping[str, Any]) -> None:
    """Take progress that a line a pose makes superfluous."""


@contextmanager
def _platform(options: StartOptions) -> Iterator[float]:
    """Run a platform and give the seconds that its start took; it is stopped on the way out, whatever the way.

    A second Ctrl-C does not leave half of it behind.
    """
    begun = time.monotonic()
    running = launch(options, report)
    try:
        yield time.monotonic() - begun
    finally:
        kept = {number: signal.signal(number, signal.SIG_IGN) for number in ENDING_SIGNALS}
        try:
            left = running.stop(report)
        finally:
            for number, handler in kept.items():
                signal.signal(number, handler)
        if not left:
            report("stopped")
