"""Commands that reach the arm: `enable` to `halt`, `move`, `run`, `mode`, `output`, `gripper`, `zero`, `home`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, joint_values, pose_values, positive, refuse_options
from rtcp.cli.connection import ask, connect, stopping
from rtcp.cli.errors import CommandError
from rtcp.cli.output import Progress, progress, report
from rtcp.ipc.client import ControlClient

MOVE_TIMEOUT_S = 10.0
"""Longest silence during a move; progress comes several times a second."""
PLANNING_TIMEOUT_S = 60.0
"""Longest silence of `run`: a file is checked and planned first."""
ACTION_TIMEOUT_S = 200.0
"""Longest homing, and longest motion of a gripper."""

Joint = Annotated[str, typer.Argument(metavar="JOINT", help="Configured name, as joint2, or number from 1.")]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("move", context_settings=NUMBERS_AS_WRITTEN)(_move)
    for command in (_run, _enable, _disable, _reset, _halt, _mode, _output, _gripper, _zero, _home):
        app.command(command.__name__[1:])(command)


def _enable() -> None:
    """Enable the drives; the arm holds where it is."""
    ask("enable", "enable")
    report("enabled: the drives hold the arm where it is")


def _disable() -> None:
    """Disable the drives; returns when they report no torque."""
    unseen = ask("disable", "disable").get("unseen")
    others = f"; also disabled, but not observed in the cycle: {', '.join(unseen)}" if unseen else ""
    report(f"disabled: the drives are without torque{others}")


def _reset() -> None:
    """Reset a fault, an emergency stop or a stop by a limit; does not enable the drives."""
    with connect("reset") as client:
        before = client.call("status").get("state")
        client.call("reset")
        after = client.call("status").get("state")
    if before == "stopped_by_limit":
        report("reset: the arm holds and accepts commands again")
    elif after == "holding":  # a reset of a fault leaves the arm without torque
        report("nothing to reset: the arm is enabled and holds")
    else:
        report("reset: no fault is left; next: `rtcp enable`")


def _halt() -> None:
    """Stop the motion in a controlled way, whoever commands it; returns when the arm holds."""
    ask("halt", "halt")
    report("halted: the arm holds where it stopped")


def _mode(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="joint, cartesian, joystick, velocity, torque; or csp, csv, cst.")
    ],
) -> None:
    """Choose the control mode, or the drives' mode for moves and lines; at standstill."""
    ask("mode", "mode", {"name": name.lower()})
    report(f"mode {name.lower()}")


def _output(
    number: Annotated[int, typer.Argument(metavar="N", help="Output of the IO box, from 1.")],
    value: Annotated[str, typer.Argument(metavar="on|off")],
) -> None:
    """Switch a digital output of the IO box."""
    level = {"on": True, "1": True, "off": False, "0": False}.get(value.lower())
    if level is None:
        raise CommandError(f"{value!r} is not a level of an output: on or off")
    ask("output", "output", {"number": number, "value": level})
    report(f"output {number} is {'on' if level else 'off'}")


def _gripper(value: Annotated[str, typer.Argument(metavar="open|close")]) -> None:
    """Open or close the gripper; one with a drive is at rest on return. Ctrl-C stops it."""
    opened = {"open": True, "close": False}.get(value.lower())
    if opened is None:
        raise CommandError(f"{value!r} is not a command of a gripper: open or close")
    with stopping(client := connect("gripper")):
        result = client.call("gripper", {"open": opened}, timeout_s=ACTION_TIMEOUT_S)
    if "position" not in result:
        report(f"gripper output set to {value.lower()}")
    elif result["holds"]:
        report(f"the gripper rests at {result['position']:.4f} rad: it holds an object")
    else:
        report(f"the gripper is {'open' if opened else 'closed'}: it rests at {result['position']:.4f} rad")


def _zero(
    joint: Joint,
    at: Annotated[float, typer.Option("--at", metavar="RAD", help="Position of the joint where it is now, rad.")] = 0.0,
) -> None:
    """Set the zero of a joint so that it stands at 0, or --at, and save it; only while the drives have no torque."""
    if not math.isfinite(at):
        raise CommandError(f"--at {at} is not allowed: a finite number of rad")
    result = ask("zero", "zero", {"joint": _joint_name(joint), "at": at})
    report(
        f"{result['joint']} is at {at:g} rad: its zero is at {result['offset']:.6f} rad of the drive "
        f"(before: {result['before']:.6f}), saved in {result['file']}"
    )


def _home(joint: Joint) -> None:
    """Run the homing of a joint's drive, as its start-up SDOs configure it; Ctrl-C stops it."""
    with stopping(client := connect("home")):
        result = client.call("home", {"joint": _joint_name(joint)}, timeout_s=ACTION_TIMEOUT_S)
    report(f"{result['joint']} is homed and stands at {result['position']:.6f} rad")


def _joint_name(joint: str) -> str:
    """Return the configured name of a joint given by name or by number, from 1 at the base."""
    if not joint.isdecimal():
        return joint
    names = ask("status", "status").get("joint_names") or []
    if not 1 <= int(joint) <= len(names):
        raise CommandError(f"joint {joint} does not exist: 1 to {len(names)}, or one of {', '.join(names)}")
    return str(names[int(joint) - 1])


def _move(
    numbers: Annotated[
        list[str],
        typer.Argument(metavar="Q1..Q6", help="Joint positions, rad or as -pi/2, base to tool; see --pose."),
    ],
    pose: Annotated[
        bool, typer.Option("--pose", help="The numbers are a tool pose, X Y Z RX RY RZ: m, and rad of Rx Ry Rz.")
    ] = False,
    line: Annotated[
        bool, typer.Option("--line", help="With --pose: along a straight line. Default: by the joints, nearest way.")
    ] = False,
    unsynchronized: Annotated[
        bool, typer.Option("--unsynchronized", help="Each joint arrives as early as it can. Default: all together.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(
            "--speed", help="Limit of the fastest joint, rad/s; on a line of the tool, m/s. Default: configured."
        ),
    ] = None,
) -> None:
    """Move the joints or the tool; returns on arrival. Ctrl-C stops the arm."""
    positive("--speed", speed, "m/s" if line else "rad/s")
    if line and not pose:
        raise CommandError("--line is for a pose: give --pose X Y Z RX RY RZ --line")
    if unsynchronized and pose:
        raise CommandError("--unsynchronized is for joint positions, not for --pose")
    refuse_options(numbers, ("--pose", "--line", "--unsynchronized", "--speed"))
    target = pose_values(numbers) if pose else joint_values(numbers)
    with stopping(client := connect("move")), progress() as shown:
        if pose:
            arguments = {"pose": target, "speed": speed, "line": line}
            result = client.call("move_pose", arguments, shown, timeout_s=MOVE_TIMEOUT_S)
        else:
            result = move_joints(client, target, speed, shown, unsynchronized=unsynchronized)
    report(arrival(result))


def _run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A trajectory or a path, in YAML or CSV.")],
    approach: Annotated[
        bool, typer.Option("--approach", help="First move to the start of the motion, by the joints.")
    ] = False,
) -> None:
    """Execute a motion file: checked as a whole first; returns when it is done. Ctrl-C stops the arm."""
    from rtcp.config.motion_file import read_motion

    read_motion(file)  # reports mistakes in the file also without a platform
    with stopping(client := connect("run")), progress() as shown:
        arguments = {"file": str(file.absolute()), "approach": approach}
        result = client.call("run", arguments, shown, timeout_s=PLANNING_TIMEOUT_S)
    report(arrival(result))


def move_joints(
    client: ControlClient,
    target: Sequence[float],
    speed: float | None = None,
    shown: Progress | None = None,
    *,
    unsynchronized: bool = False,
) -> dict[str, Any]:
    """Move to `target`, rad, and return the result on arrival; raises RtcpError as the platform ended the move."""
    arguments = {"q": list(target), "speed": speed} | ({"each": True} if unsynchronized else {})
    return client.call("move", arguments, shown, timeout_s=MOVE_TIMEOUT_S)


def arrival(result: Mapping[str, Any]) -> str:
    """Return the line about a finished motion: largest joint error; length, duration and slowing of a path."""
    error, duration, length, slowed = (result.get(name) for name in ("error", "duration_s", "length_m", "slowed"))
    line = "arrived"
    if isinstance(error, int | float):
        line += f", largest error {error:.6f} rad"
    if isinstance(length, int | float) and length > 0:
        line += f", {length:.3f} m"
    if isinstance(duration, int | float):
        line += f", in {duration:.1f} s"
    if isinstance(slowed, int | float) and slowed < 0.995:
        line += f", slowed to {slowed:.0%} of its speed by the joints' limits"
    return line
