"""Commands that reach the arm, from `enable` and `move` to `home`; `rtcp limits`, changed as one transaction."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.api import Arrival, Robot, State
from rtcp.api.results import Channel
from rtcp.cli.arguments import (
    NUMBERS_AS_WRITTEN,
    POSE,
    AsJson,
    as_written,
    check_picture,
    finite,
    joint_values,
    number,
    option,
    pose_values,
    positive,
)
from rtcp.cli.output import CommandError, confirm, emit_json, progress, report, show, table
from rtcp.cli.platform import connect, stoppable
from rtcp.config.model import UNLIMITED_TORQUE, ConfigError
from rtcp.ipc.runtime_directory import runtime_directory
from rtcp.ipc.session import read_session
from rtcp.ipc.stops import requested

Joint = Annotated[str, typer.Argument(metavar="JOINT", help="Configured name, as joint2, or number from 1.")]
PresentIsHome = Annotated[bool, option("--yes", "Do not ask before the present position becomes the home.")]
COLUMNS = (
    ("min", "rad"), ("max", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s^2"), ("jerk", "rad/s^3"),
    ("torque", "Nm"),
)  # fmt: skip
UNITS = {"speed": "m/s", "acceleration": "m/s^2", "jerk": "m/s^3", "angular_speed": "rad/s",
         "angular_acceleration": "rad/s^2", "angular_jerk": "rad/s^3"}  # fmt: skip

_HOLDS = ": the arm holds"

commands = typer.Typer()
limits = typer.Typer(name="limits", help="Show and narrow the limits while the platform runs.", no_args_is_help=True)
commands.add_typer(limits)


@commands.command("enable")
def _enable() -> None:
    """Enable the drives; the arm holds where it is."""
    with connect("enable") as robot:
        robot.enable()
        joints = robot.status().joint_names
    report("enabled: the drives hold the arm where it is" if joints else "enabled: the platform has no arm")


@commands.command("disable")
def _disable() -> None:
    """Disable the drives; returns when they report no torque."""
    with requested(runtime_directory(), "disable") as params, connect("disable") as robot:
        unconfirmed = robot.command("disable", **params)["unconfirmed"]
        by_controller = "power" in robot.status().raw["lacks"]
    unobserved = f"; also disabled, but not observed in the cycle: {', '.join(unconfirmed)}" if unconfirmed else ""
    stands = "the arm stands, held by its robot controller with the motors on"
    report(f"disabled: {stands if by_controller else 'the drives are without torque'}{unobserved}")


@commands.command("reset")
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


@commands.command("halt")
def _halt() -> None:
    """Stop the motion in a controlled way, whoever commands it; returns when the arm holds."""
    with requested(runtime_directory(), "halt") as params, connect("halt") as robot:
        robot.command("halt", **params)
    report("halted: the arm holds where it stopped")


@commands.command("pause")
def _pause() -> None:
    """Bring the motion under way, whoever began it, to rest on its path; Enter continues it."""
    with connect("pause") as robot:
        robot.pause()
        report("paused: Enter continues the motion; Ctrl-C leaves it to who commands it; `rtcp halt` ends it")
        if not sys.stdin.readline():
            return
        robot.resume()
    report("the motion goes on")


@commands.command("mode")
def _mode(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="joint, cartesian, joystick, velocity, torque; or csp, csv, cst.")
    ],
) -> None:
    """Choose the control mode, or the drive mode for moves and lines; at standstill."""
    with connect("mode") as robot:
        robot.mode(name.lower())
    report(f"mode {name.lower()}")


@commands.command("speed")
def _speed(
    percent: Annotated[float | None, typer.Argument(metavar="[PERCENT]", help="1 to 100; without it: show it.")] = None,
) -> None:
    """Set the speed override: the share of its speed at which the arm moves, also in a motion under way."""
    if percent is not None and not 1.0 <= percent <= 100.0:
        raise CommandError(f"PERCENT {percent:g} is not allowed: 1 to 100 % of the speed")
    with connect("speed") as robot:
        if percent is not None:
            robot.set_speed_override(percent / 100.0)
        report(f"the speed override is {100.0 * robot.speed_override:.3g} %")


@commands.command("tool")
def _tool(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="One of the arm's file; without it: list them.")
    ] = None,
) -> None:
    """Choose the tool, at rest: poses, boxes, collisions and gravity are those of it from then on."""
    with connect("tool") as robot:
        if name is not None:
            robot.set_tool(name)
            report(f"the tool is {name}; its payload is {robot.status().payload.mass:g} kg")
            return
        in_use = robot.status().tool
    listed = table(("", "tool", "x y z, m", "rx ry rz, rad"), ("", "tool"))
    for model in read_session(runtime_directory()).config.models:
        numbers = (" ".join(f"{value:g}" for value in vector) for vector in (model.tool.position, model.tool.rpy))
        listed.add_row("*" if model.tool_name == in_use else "", model.tool_name, *numbers)
    show(listed)


@commands.command("payload")
def _payload(
    mass: Annotated[float, typer.Argument(metavar="MASS", help="Of what the tool holds, kg; 0: nothing.")],
    centre: Annotated[
        tuple[float, float, float],
        typer.Option("--centre", metavar="X Y Z", help="Its centre of mass in the frame of the tool, m."),
    ] = (0.0, 0.0, 0.0),
) -> None:
    """Set the payload of the tool, at rest; control mode torque carries its weight."""
    with connect("payload") as robot:
        robot.set_payload(mass, centre)
        report(f"the payload of {robot.status().tool} is {mass:g} kg")


@commands.command("output")
def _output(
    number: Annotated[int, typer.Argument(metavar="N", help="Output of the IO box, from 1.")],
    value: Annotated[str, typer.Argument(metavar="on|off")],
    box: Annotated[str | None, option("--box", "NAME", "The IO box, by its slave; needed with several.")] = None,
) -> None:
    """Switch a digital output of the IO box."""
    level = {"on": True, "1": True, "off": False, "0": False}.get(value.lower())
    if level is None:
        raise CommandError(f"{value!r} is not a level of an output: on or off")
    with connect("output") as robot:
        robot.set_output(number, level, box)
    report(f"output {number} is {'on' if level else 'off'}")


@commands.command("io", context_settings=NUMBERS_AS_WRITTEN)
def _io(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Input, output or SLAVE.CHANNEL; without it: list them.")
    ] = None,
    value: Annotated[str | None, as_written("[VALUE]", "on, off, or a number in its unit.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show inputs, outputs and channels of slaves by name, or set one."""
    with connect("io") as robot:
        if name is not None and value is not None:
            level = {"on": True, "off": False}.get(value.lower())
            robot.set_output(name, number(value, name) if level is None else level)
            report(f"{name} is {value}")
            return
        signals = robot.read_io()
    rows: list[tuple[str, str, str | float, str, str]] = [
        (signal, direction, "on" if high else "off", "", "")
        for direction, levels in (("input", signals.inputs), ("output", signals.outputs))
        for signal, high in levels.items()
    ]
    rows += [
        (channel.name, "output" if channel.is_output else "input", channel.value, channel.unit, _range_text(channel))
        for channel in signals.channels.values()
    ]
    rows = [row for row in rows if name in (None, row[0])]
    if not rows:
        raise CommandError(f"there is no input, output or channel {name}: see `rtcp io`")
    if as_json:
        emit_json({signal: {"direction": kind, "value": value, "unit": unit} for signal, kind, value, unit, _ in rows})
        return
    listed = table(
        ("name", "direction", "value", "unit", "may be set to"), ("name", "direction", "unit", "may be set to")
    )
    for signal, direction, reading, unit, allowed in rows:
        listed.add_row(signal, direction, reading if isinstance(reading, str) else f"{reading:.6g}", unit, allowed)
    show(listed)


def _range_text(channel: Channel) -> str:
    return "{:.6g} to {:.6g}".format(*channel.range) if channel.settable else ""


@commands.command("gripper")
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


@commands.command("zero")
def _zero(
    joint: Joint, at: Annotated[float, option("--at", "RAD", "Position of the joint where it is now, rad.")] = 0.0
) -> None:
    """Define the position of a joint as 0, or --at, and save it; only without torque."""
    finite("--at", at, "rad")
    with connect("zero") as robot:
        zero = robot.zero(joint, at)
    unit = zero.unit
    report(
        f"{zero.joint} is at {at:g} {unit}: its zero is at {zero.offset:.6f} {unit} of the drive "
        f"(before: {zero.before:.6f}), saved in {zero.file}"
    )


def announce_homing(robot: Robot, joint: str, yes: bool) -> str:
    """Report what the homing of a drive will do; ask where it declares the present position to be its home, unless
    `yes`. Return the name of the joint or axis."""
    method = robot.homing_method(joint)
    number = "" if method.method is None else f", by method {method.method} (0x6098)"
    count = f"{method.home_offset:.6g} {method.unit}"
    report(f"the drive of {method.joint} {method.text}{number}; there it counts {count} (0x607C)")
    if method.declares_present and not yes:
        confirm(f"Is {method.joint} where its drive shall count {count}?")
    return method.joint


@commands.command("home")
def _home(joint: Joint, yes: PresentIsHome = False) -> None:
    """Run the homing of a joint's drive, as its object 0x6098 says. Ctrl-C stops it.

    It says first what the drive will do, and asks where the drive declares its present position to be the home.
    """
    with stoppable("home") as robot:
        name = announce_homing(robot, joint, yes)
        position = robot.home(joint)
    report(f"{name} is homed and stands at {position:.6f} rad")


@commands.command("move", context_settings=NUMBERS_AS_WRITTEN)
def _move(
    numbers: Annotated[
        list[str] | None,
        as_written("Q1..Q6", "Joint positions, rad or as -pi/2, base to tool; see --pose."),
    ] = None,
    rest_pose: Annotated[bool, option("--rest-pose", "Instead of numbers: to `rest_pose` of the arm's file.")] = False,
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
    if rest_pose == bool(numbers) or (rest_pose and (pose or unsynchronized)):
        raise CommandError("give joint positions, or --pose X Y Z RX RY RZ, or --rest-pose alone")
    target = pose_values(numbers or ()) if pose else joint_values(numbers or ())
    with stoppable("move") as robot, progress() as show_progress:
        if rest_pose:
            arrived = robot.move_to_rest_pose(speed, show_progress)
        elif pose:
            arrived = robot.move_pose(target, speed, line, show_progress)
        else:
            arrived = robot.move_joints(target, speed, not unsynchronized, show_progress)
    report(arrival(arrived))


@commands.command("step", context_settings=NUMBERS_AS_WRITTEN)
def _step(
    axis: Annotated[str, typer.Argument(metavar="AXIS", help="x, y, z, rx, ry, rz, or a joint's name or number.")],
    amount: Annotated[str, as_written("AMOUNT", "With its unit: 1mm, -10mm, 0.01m, 1deg, -0.1rad.")],
    tool: Annotated[bool, option("--tool", "Along the axes of the tool. Default: of the base.")] = False,
    speed: Annotated[
        float | None, option("--speed", help="Of the tool, m/s, or of the joint, rad/s. Default: configured.")
    ] = None,
) -> None:
    """Move one step along or about an axis, or of one joint; returns on arrival. Ctrl-C stops the arm."""
    by_joint = axis not in POSE
    positive("--speed", speed, "rad/s" if by_joint else "m/s")
    unit = "m" if axis in POSE[:3] else "rad"
    size = _amount(amount, unit)
    with stoppable("step") as robot, progress() as show_progress:
        names = robot.status().joint_names
        known = [*POSE] if not by_joint else [*names, *(str(number) for number in range(1, len(names) + 1))]
        if axis not in known:
            raise CommandError(f"{axis!r} is no axis: {', '.join((*POSE, *names))}, or the number of a joint")
        count = len(names) if by_joint else len(POSE)
        offset = [size if at == known.index(axis) % count else 0.0 for at in range(count)]
        frame = "joints" if by_joint else "tool" if tool else "base"
        arrived = robot.move_by(offset, frame, speed, show_progress)
    report(arrival(arrived))


def _amount(text: str, unit: str) -> float:
    """Return a length in m or an angle in rad."""
    factors = {"mm": 1e-3, "m": 1.0} if unit == "m" else {"deg": math.pi / 180.0, "rad": 1.0}
    for ending, factor in factors.items():
        if text.endswith(ending):
            return factor * number(text.removesuffix(ending), "AMOUNT", ending)
    raise CommandError(f"{text!r} is not an amount for this axis: a number with {' or '.join(factors)}, as 1{unit}")


@commands.command("guide")
def _guide(
    seconds: Annotated[float | None, option("--seconds", "S", "How long, s, at most 3600. Default: until Ctrl-C.")] = (
        None
    ),
) -> None:
    """Let the arm be guided by hand: it carries its weight and follows. Ctrl-C ends it, and the arm holds."""
    positive("--seconds", seconds, "s", 3600.0)
    with stoppable("guide") as robot:
        report("the arm follows the hand; Ctrl-C ends it")
        ended = robot.guide(seconds or 0.0)
    report({"done": "the time is over", "halted": "halted"}.get(ended, "the enabling switch was released") + _HOLDS)


@commands.command("arc", context_settings=NUMBERS_AS_WRITTEN)
def _arc(
    pose: Annotated[list[str], as_written("X Y Z RX RY RZ", "Its end: m, and rad of Rx Ry Rz.")],
    via: Annotated[tuple[float, float, float], typer.Option("--via", metavar="X Y Z", help="A place on it, m.")],
    angle: Annotated[
        str | None, option("--angle", "RAD", "Travel so far on the circle, as 2*pi. Default: up to the end.")
    ] = None,
    speed: Annotated[float | None, option("--speed", help="Of the tool, m/s. Default: configured.")] = None,
) -> None:
    """Move the tool on an arc, or a circle; returns on arrival. Ctrl-C stops the arm."""
    positive("--speed", speed, "m/s")
    angle_rad = None if angle is None else number(angle, "--angle", "rad")
    with stoppable("arc") as robot, progress() as show_progress:
        arrived = robot.move_arc(via, pose_values(pose), angle_rad, speed, show_progress)
    report(arrival(arrived))


@commands.command("run")
def _run(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="A trajectory, a path or a program: docs/motion.md.")
    ] = None,
    approach: Annotated[bool, option("--approach", "First move to the start of the motion, by the joints.")] = False,
    dry: Annotated[bool, option("--dry", "Plan it from where the arm is, and move nothing.")] = False,
    picture: Annotated[Path | None, option("--picture", "FILE", "With --dry: draw the way of the tool.")] = None,
    first: Annotated[int, option("--from", "N", "First step of a program, from 1; the arm begins where it is.")] = 1,
    schema: Annotated[bool, option("--schema", "Print the JSON schema of motion files, for editors.")] = False,
) -> None:
    """Execute a motion file, checked as a whole first; returns when it is done. Ctrl-C stops it."""
    from rtcp.config.motion_file import json_schema, read_motion

    if schema:
        emit_json(json_schema())
        return
    if file is None:
        raise CommandError("FILE is missing: a motion file, docs/motion.md")
    motion = read_motion(file)  # reports mistakes in the file also without a platform
    if picture is not None:
        check_picture("--picture", picture)
        if not dry:
            raise CommandError("--picture is for a plan: give --dry too")
    if motion.program and approach:
        raise CommandError("--approach is for trajectories and paths: a program begins where the arm is")
    if first != 1 and not 1 <= first <= len(motion.program):
        raise CommandError(
            f"--from {first} is not allowed: 1 to {len(motion.program)}, the steps of the program in {file}"
        )
    if dry:
        _dry(file, bool(motion.program), approach, picture, first - 1)
    elif motion.program:
        from rtcp.api.program import Program

        program = Program(file)
        with stoppable("run") as robot:
            program.run(robot, lambda begun: report(f"{file}:{begun.line}: {begun.text}"), start=first - 1)
        report("the program is complete")
    else:
        with stoppable("run") as robot, progress() as show_progress:
            arrived = robot.run(str(file.absolute()), approach, show_progress)
        report(arrival(arrived))


def _dry(file: Path, is_program: bool, approach: bool, picture: Path | None, start: int) -> None:
    """Plan a file and show what would be done."""
    with connect("run --dry") as robot:
        tool = robot.status().tool
        if is_program:
            from rtcp.api.program import Program

            planned = [(step.line, step.plan) for step in Program(file).check(robot, start)]
        else:
            planned = [(1, robot.preview(file=str(file.absolute()), approach=approach))]
    listed = table(("line", "duration, s", "length, m", "part of the speed"))
    for line, plan in planned:
        length = "" if not plan.length_m else f"{plan.length_m:.3f}"
        listed.add_row(str(line), f"{plan.duration_s:.2f}", length, "" if plan.slowed is None else f"{plan.slowed:.0%}")
    show(listed)
    report(f"{len(planned)} motions in {sum(plan.duration_s for _, plan in planned):.1f} s; nothing has moved")
    if picture is not None:
        from rtcp.cli.arm_plot import draw

        model = read_session(runtime_directory()).config.model_of(tool)
        if model is None:
            raise CommandError(
                "--picture: the geometry of the arm is unknown: the key kinematics is missing in its file"
            )
        draw(model, planned[0][1].path[0], picture, [plan.path for _, plan in planned])
        report(f"picture: {picture}")


@commands.command("teach")
def _teach(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A motion file with a program, new or not.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="By which steps name the pose.")],
    pose: Annotated[bool, option("--pose", "Keep the pose of the tool. Default: the joint positions.")] = False,
    step: Annotated[str | None, option("--step", "move|line", "Also append a step that leads there.")] = None,
    speed: Annotated[float | None, option("--speed", help="Of that step: rad/s, of a line m/s.")] = None,
    blend: Annotated[float | None, option("--blend", "M", "Of that step: radius of the corner behind it, m.")] = None,
) -> None:
    """Keep where the arm is under a name, in a motion file; nothing moves."""
    from rtcp.config.program_file import ProgramFile

    if step not in (None, "move", "line"):
        raise CommandError(f"--step {step!r} is not allowed: move or line")
    if step is None and (speed, blend) != (None, None):
        raise CommandError("--speed and --blend are of a step: give --step move or --step line too")
    taught = ProgramFile(file)
    with connect("teach") as robot:
        status = robot.status()
    if pose and status.commanded_pose is None:
        raise CommandError("--pose: the geometry of the arm is unknown: the key kinematics is missing in its file")
    if pose:
        taught.keep(name, pose=status.commanded_pose)
    else:
        taught.keep(name, q=status.commanded_positions)
    if step is not None:
        keys = {step: name, "speed": speed, "blend": blend}
        try:
            taught.insert(len(taught.motion.program), {key: value for key, value in keys.items() if value is not None})
        except ConfigError:
            taught.undo()
            raise
    report(f"{file}: {name} is kept{'' if step is None else f', and step {len(taught.motion.program)} leads there'}")


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


# -- limits ---------------------------------------------------------------------------------------------------------


@limits.command("show")
def _show(as_json: AsJson = False) -> None:
    """Show the limits of joints, tool and boxes; a star marks a changed value."""
    with connect("limits show") as robot:
        answer = robot.limits()
    if as_json:
        emit_json(answer)
    else:
        show(*_tables(answer))


@limits.command("set", context_settings=NUMBERS_AS_WRITTEN)
def _set(
    pairs: Annotated[
        list[str],
        as_written(
            "KEY VALUE..",
            "joint2.max, joints.velocity, box.min.x, user.max.z, cup.angle, supervision.torque, ...: rad, m, s, Nm; "
            "all apply, or none.",
        ),
    ],
    widen: Annotated[
        bool,
        option(
            "--widen",
            "Allow more than the limits of the file, up to its keys `absolute`. The drives must have no torque.",
        ),
    ] = False,
    yes: Annotated[bool, option("--yes", "Do not ask.")] = False,
    as_json: AsJson = False,
) -> None:
    """Change limits within the configured ones; refused as a whole where the arm would be outside."""
    changes = _changes(pairs)
    if widen and not yes:
        _confirm_widening(changes)
    with connect("limits set") as robot:
        answer = robot.set_limits(changes, widen=widen)
    if as_json:
        emit_json(answer)
    else:
        report(f"{len(changes)} {'limit is' if len(changes) == 1 else 'limits are'} changed until `rtcp stop`")


def _confirm_widening(changes: Mapping[str, float]) -> None:
    named = ", ".join(f"{key} {value:g}" for key, value in changes.items())
    confirm(f"Allow {named} beyond the limits of the file until `rtcp stop`?")


def _changes(pairs: Sequence[str]) -> dict[str, float]:
    if len(pairs) % 2:
        raise CommandError(f"{pairs[-1]!r} has no value: give KEY VALUE, as joint2.max 1.2")
    changes: dict[str, float] = {}
    wrong = []
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        if key in changes:
            wrong.append(f"{key} is given twice")
        try:
            changes[key] = number(value, key)
        except CommandError as error:
            wrong.append(error.message)
    if wrong:
        raise CommandError("\n".join(wrong))
    return changes


def _tables(answer: Mapping[str, Any]) -> list[Any]:
    from rich.table import Table

    now, configured = answer["limits"], answer["configured"]
    joints = table(("joint", *(f"{name}\n{unit}" for name, unit in COLUMNS)), ("joint",))
    for at, joint in enumerate(answer["joint_names"]):
        joints.add_row(joint, *(_marked(now[name][at], configured[name][at]) for name, _ in COLUMNS))
    boxes = table(("box", "x m", "y m", "z m"), ("box",))
    rows = [("tool inside", now["box"], configured["box"])]
    rows += [(f"keep out: {name}", box, configured["keep_out"].get(name)) for name, box in now["keep_out"].items()]
    for name, box, before in rows:
        if box is not None:
            before = before or box  # noqa: PLW2901
            spans = zip(box["min"], box["max"], before["min"], before["max"], strict=True)
            boxes.add_row(name, *(f"{_marked(low, was)} to {_marked(high, had)}" for low, high, was, had in spans))
    cones = table(("cone", "axis", "direction", "angle rad"), ("cone", "axis"))
    for name, cone in now["cones"].items():
        angle = _marked(cone["angle"], configured["cones"][name]["angle"])
        cones.add_row(name, cone["axis"], " ".join(f"{part:g}" for part in cone["direction"]), angle)
    tool = Table.grid(padding=(0, 2))
    for name, unit in UNITS.items():
        tool.add_row(f"tool: {name.replace('_', ' ')}", f"{answer['cartesian'][name]:g} {unit}")
    for name, value in now["supervision"].items():
        unit = "rad" if name == "following_error" else "times the limit"
        tool.add_row(
            f"supervision: {name.replace('_', ' ')}", f"{_marked(value, configured['supervision'][name])} {unit}"
        )
    for name, value in answer["cartesian"]["singularity"].items():
        tool.add_row(f"singularity: {name}", f"{value:g} {'m' if name == 'shoulder' else 'rad'}")
    return [joints, "", boxes, "", *((cones, "") if now["cones"] else ()), tool]


def _marked(value: float, configured: float) -> str:
    if value >= UNLIMITED_TORQUE:
        return "none"
    return f"{value:g}" if value == configured else f"{value:g} *"
