"""`rtcp move` and `rtcp run`: motions that have an end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, joint_values, pose_values, positive, refuse_options
from rtcp.cli.connection import connect
from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import report
from rtcp.cli.progress import progress, stopping
from rtcp.ipc.client import ControlClient

SILENCE_S = 10.0
"""A move that says nothing for so long is given up; progress comes several times a second."""
PLANNING_S = 60.0
"""So long a path or a trajectory may be looked at before it begins."""


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("move", context_settings=NUMBERS_AS_WRITTEN)(_move)
    app.command("run")(_run)


def _move(
    numbers: Annotated[
        list[str],
        typer.Argument(metavar="Q1..Q6", help="Joint positions, rad, base to tool; with --pose X Y Z RX RY RZ."),
    ],
    pose: Annotated[
        bool, typer.Option("--pose", help="The numbers are a tool pose: m, and rad (or as -pi/2) of Rx Ry Rz.")
    ] = False,
    line: Annotated[
        bool, typer.Option("--line", help="With --pose: on a straight line; else the joints move, nearest solution.")
    ] = False,
    unsynchronized: Annotated[
        bool, typer.Option("--unsynchronized", help="Each joint arrives as early as it can; else all arrive together.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option("--speed", help="Bound of the fastest joint, rad/s; on a line of the tool, m/s; else configured."),
    ] = None,
) -> None:
    """Move the joints or the tool and return when they are there; Ctrl-C stops the arm."""
    positive("--speed", speed, "m/s" if line else "rad/s")
    if line and not pose:
        raise CommandError("--line is for a pose: give --pose X Y Z RX RY RZ --line")
    if unsynchronized and pose:
        raise CommandError("--unsynchronized is for joint positions, not for --pose")
    known = ("--pose", "--line", "--unsynchronized", "--speed", "--help", "-h")
    if pose:
        from rtcp.config.geometry import angle

        refuse_options([value for value in numbers if angle(value) == value], known)
        verb, target = "move_pose", pose_values(numbers)
        arguments: dict[str, Any] = {"pose": target, "speed": speed, "line": line}
    else:
        refuse_options(numbers, known)
        verb, target = "move", joint_values(numbers)
        arguments = {"q": target, "speed": speed} | ({"each": True} if unsynchronized else {})
    with stopping(client := connect("move")):
        if not pose:
            _same_number(target, client.call("status"))
        with progress() as follow:
            result = client.call(verb, arguments, follow, timeout_s=SILENCE_S)
    report(arrival(result))


def _run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A trajectory or a path, in YAML or CSV.")],
    approach: Annotated[
        bool, typer.Option("--approach", help="First move to where the motion begins, by the joints.")
    ] = False,
) -> None:
    """Carry out a motion file: checked whole first; returns when it is done; Ctrl-C stops the arm."""
    from rtcp.config.motion_file import read_motion

    read_motion(file)  # what is wrong in it is told whether or not a platform runs
    with stopping(client := connect("run")), progress() as follow:
        arguments = {"file": str(file.absolute()), "approach": approach}
        result = client.call("run", arguments, follow, timeout_s=PLANNING_S)
    report(arrival(result))


def move(
    client: ControlClient,
    target: Sequence[float],
    speed: float | None,
    follow: Callable[[Mapping[str, Any]], None],
) -> dict[str, Any]:
    """Move to `target`, rad, over an open connection and return the result once the joints are there.

    Raises:
        RtcpError: as the platform ended the move.
    """
    return client.call("move", {"q": list(target), "speed": speed}, follow, timeout_s=SILENCE_S)


def arrival(result: Mapping[str, Any]) -> str:
    """Return the sentence on a finished move: the largest error of a joint, and what a path had to say."""
    error = result.get("error")
    said = f"there, largest error {error:.6f} rad" if isinstance(error, int | float) else "there"
    duration, length, slowed = (result.get(name) for name in ("duration_s", "length_m", "slowed"))
    if isinstance(length, int | float) and length > 0:
        said += f", {length:.3f} m"
    if isinstance(duration, int | float):
        said += f", in {duration:.1f} s"
    if isinstance(slowed, int | float) and slowed < 0.995:
        said += f", slowed to {slowed:.0%} of its speed by the joints' limits"
    return said


def _same_number(target: Sequence[float], status: Mapping[str, Any]) -> None:
    positions = status.get("joint_names")
    if isinstance(positions, list) and positions and len(positions) != len(target):
        raise CommandError(
            f"{len(target)} positions for an arm of {len(positions)} joints: give {len(positions)} numbers, rad",
            ExitCode.USAGE,
        )
