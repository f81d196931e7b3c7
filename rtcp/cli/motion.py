"""Commands that reach the arm: `enable` to `halt`, `move`, `run`, `mode`, `output`, `gripper`, `zero`, `home`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rtcp.api import Arrival, State
from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, finite, joint_values, option, pose_values, positive, refuse_options
from rtcp.cli.connection import connect, stoppable
from rtcp.cli.errors import CommandError
from rtcp.cli.output import progress, report

Joint = Annotated[str, typer.Argument(metavar="JOINT", help="Configured name, as joint2, or number from 1.")]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    app.command("enable")(_enable)
    app.command("move", context_settings=NUMBERS_AS_WRITTEN)(_move)
    for command in (_run, _halt, _disable, _reset, _mode, _output, _gripper, _zero, _home):
        app.command(command.__name__[1:])(command)


def _enable() -> None:
    """Enable the drives; the arm holds where it is."""
    with connect("enable") as robot:
        robot.enable()
    report("enabled: the drives hold the arm where it is")


def _disable() -> None:
    """Disable the drives; returns when they report no torque."""
    with connect("disable") as robot:
        unconfirmed = robot.disable()
    others = f"; also disabled, but not observed in the cycle: {', '.join(unconfirmed)}" if unconfirmed else ""
    report(f"disabled: the drives are without torque{others}")


def _reset() -> None:
    """Reset a fault, an emergency stop or a stop by a limit; does not enable the drives."""
    with connect("reset") as robot:
        before = robot.reset()
    if before is State.STOPPED_BY_LIMIT:
        report("reset: the arm holds and accepts commands again")
    elif before is State.HOLDING:
        report("nothing to reset: the arm is enabled and holds")
    else:
        report("reset: no fault is left; next: `rtcp enable`")


def _halt() -> None:
    """Stop the motion in a controlled way, whoever commands it; returns when the arm holds."""
    with connect("halt") as robot:
        robot.halt()
    report("halted: the arm holds where it stopped")


def _mode(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="joint, cartesian, joystick, velocity, torque; or csp, csv, cst.")
    ],
) -> None:
    """Choose the control mode, or the drive mode for moves and lines; at standstill."""
    with connect("mode") as robot:
        robot.mode(name.lower())
    report(f"mode {name.lower()}")


def _output(
    number: Annotated[int, typer.Argument(metavar="N", help="Output of the IO box, from 1.")],
    value: Annotated[str, typer.Argument(metavar="on|off")],
) -> None:
    """Switch a digital output of the IO box."""
    level = {"on": True, "1": True, "off": False, "0": False}.get(value.lower())
    if level is None:
        raise CommandError(f"{value!r} is not a level of an output: on or off")
    with connect("output") as robot:
        robot.set_output(number, level)
    report(f"output {number} is {'on' if level else 'off'}")


def _gripper(value: Annotated[str, typer.Argument(metavar="open|close")]) -> None:
    """Open or close the gripper; one with a drive is at rest on return. Ctrl-C stops it."""
    opened = {"open": True, "close": False}.get(value.lower())
    if opened is None:
        raise CommandError(f"{value!r} is not a command of a gripper: open or close")
    with stoppable("gripper") as robot:
        rest = robot.gripper(opened)
    if rest.position is None:
        report(f"gripper output set to {value.lower()}")
    elif rest.holds:
        report(f"the gripper rests at {rest.position:.4f} rad: it holds an object")
    else:
        report(f"the gripper is {'open' if opened else 'closed'}: it rests at {rest.position:.4f} rad")


def _zero(
    joint: Joint, at: Annotated[float, option("--at", "RAD", "Position of the joint where it is now, rad.")] = 0.0
) -> None:
    """Define the position of a joint as 0, or --at, and save it; only without torque."""
    finite("--at", at, "rad")
    with connect("zero") as robot:
        zero = robot.zero(joint, at)
    report(
        f"{zero.joint} is at {at:g} rad: its zero is at {zero.offset:.6f} rad of the drive "
        f"(before: {zero.before:.6f}), saved in {zero.file}"
    )


def _home(joint: Joint) -> None:
    """Run the homing of a joint's drive, as its start-up SDOs configure it. Ctrl-C stops it."""
    with stoppable("home") as robot:
        position = robot.home(joint)
    report(f"{f'joint {joint}' if joint.isdecimal() else joint} is homed and stands at {position:.6f} rad")


def _move(
    numbers: Annotated[
        list[str],
        typer.Argument(metavar="Q1..Q6", help="Joint positions, rad or as -pi/2, base to tool; see --pose."),
    ],
    pose: Annotated[bool, option("--pose", "The numbers are a tool pose, X Y Z RX RY RZ: m, and rad of Rx Ry Rz.")] = (
        False
    ),
    line: Annotated[bool, option("--line", "With --pose: along a straight line. Default: by the joints.")] = False,
    unsynchronized: Annotated[
        bool, option("--unsynchronized", "Each joint arrives as early as it can. Default: all together.")
    ] = False,
    speed: Annotated[
        float | None,
        option("--speed", help="Limit of the fastest joint, rad/s; on a line of the tool, m/s. Default: configured."),
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
    with stoppable("move") as robot, progress() as shown:
        if pose:
            arrived = robot.move_pose(target, speed, line, shown)
        else:
            arrived = robot.move_joints(target, speed, not unsynchronized, shown)
    report(arrival(arrived))


def _run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A trajectory or a path, in YAML or CSV.")],
    approach: Annotated[bool, option("--approach", "First move to the start of the motion, by the joints.")] = False,
) -> None:
    """Execute a motion file, checked as a whole first; returns when it is done. Ctrl-C stops it."""
    from rtcp.config.motion_file import read_motion

    read_motion(file)  # reports mistakes in the file also without a platform
    with stoppable("run") as robot, progress() as shown:
        arrived = robot.run(str(file.absolute()), approach, shown)
    report(arrival(arrived))


def arrival(arrived: Arrival) -> str:
    """Return the line about a finished motion: largest joint error; length, duration and slowing of a path."""
    line = f"arrived, largest error {arrived.error:.6f} rad"
    if arrived.length_m:
        line += f", {arrived.length_m:.3f} m"
    if arrived.duration_s is not None:
        line += f", in {arrived.duration_s:.1f} s"
    if arrived.slowed is not None and arrived.slowed < 0.995:
        line += f", slowed to {arrived.slowed:.0%} of its speed by the joints' limits"
    return line
