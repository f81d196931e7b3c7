"""`rtcp enable`, `disable`, `reset`, `halt`, `mode`, `output`, `gripper`, `zero`, `home`: what the machine is told."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from rtcp.cli.connection import ask, connect
from rtcp.cli.errors import CommandError
from rtcp.cli.output import report
from rtcp.cli.progress import stopping

HOMING_S = 200.0
GRIPPER_S = 200.0

Joint = Annotated[str, typer.Argument(metavar="JOINT", help="Its configured name, as joint2, or its number from 1.")]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    for command in (_enable, _disable, _reset, _halt, _mode, _output, _gripper, _zero, _home):
        app.command(command.__name__[1:])(command)


def _enable() -> None:
    """Enable the drives; the arm holds where it is."""
    ask("enable", "enable")
    report("enabled: the drives hold the arm where it is")


def _disable() -> None:
    """Disable the drives; done when they show that they are without torque."""
    unseen = ask("disable", "disable").get("unseen")
    report(
        "disabled: the drives are without torque"
        + (f"; told as well, but not in the cycle's records: {', '.join(unseen)}" if unseen else "")
    )


def _reset() -> None:
    """Reset a fault, an emergency stop or a stop by a limit; enabling is a step of its own."""
    with connect("reset") as client:
        before = str(client.call("status").get("state")).replace("_", " ")
        client.call("reset")
        holds = client.call("status").get("state") == "holding"
    if before == "stopped by limit":
        report("reset: the arm holds and takes commands again")
        return
    # A reset leaves the arm without torque: one that holds had nothing to reset.
    report(
        "nothing to reset: the arm is enabled and holds" if holds else "reset: no fault is left; `rtcp enable` goes on"
    )


def _halt() -> None:
    """Stop a motion in a controlled way, whoever began it; returns when the arm holds."""
    ask("halt", "halt")
    report("halted: the arm holds where it stopped")


def _mode(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="joint, cartesian, joystick, velocity, torque; or csp, csv, cst.")
    ],
) -> None:
    """Choose what the arm takes commands for, or the drives' mode for moves and lines; at standstill."""
    ask("mode", "mode", {"name": name.lower()})
    report(f"mode {name.lower()}")


def _output(
    number: Annotated[int, typer.Argument(metavar="N", help="Output of the IO box, from 1.")],
    value: Annotated[str, typer.Argument(metavar="on|off")],
) -> None:
    """Switch a digital output of the IO box."""
    switched = {"on": True, "1": True, "off": False, "0": False}.get(value.lower())
    if switched is None:
        raise CommandError(f"{value!r} is no state of an output: on or off")
    ask("output", "output", {"number": number, "value": switched})
    report(f"output {number} is {'on' if switched else 'off'}")


def _gripper(value: Annotated[str, typer.Argument(metavar="open|close")]) -> None:
    """Open or close the gripper; one with a drive of its own has then come to rest. Ctrl-C stops it."""
    opened = {"open": True, "close": False}.get(value.lower())
    if opened is None:
        raise CommandError(f"{value!r} is nothing that a gripper does: open or close")
    with stopping(client := connect("gripper")):
        result = client.call("gripper", {"open": opened}, timeout_s=GRIPPER_S)
    if "position" not in result:
        report(f"the gripper is told to {value.lower()}")
    elif result["holds"]:
        report(f"the gripper rests at {result['position']:.4f} rad: it holds something")
    else:
        report(f"the gripper is {'open' if opened else 'closed'}: it rests at {result['position']:.4f} rad")


def _zero(
    joint: Joint,
    at: Annotated[
        float, typer.Option("--at", metavar="RAD", help="What the joint's position now is to be, rad.")
    ] = 0.0,
) -> None:
    """Let a joint stand at 0, or --at, where it is now, kept in a file; only while the drives have no torque."""
    if not math.isfinite(at):
        raise CommandError(f"--at {at} is not allowed: a finite number of rad")
    result = ask("zero", "zero", {"joint": _name(joint), "at": at})
    report(
        f"{result['joint']} is at {at:g} rad here: its zero is at {result['offset']:.6f} rad of the drive "
        f"(before: {result['before']:.6f}); kept in {result['file']}"
    )


def _home(joint: Joint) -> None:
    """Let a joint's drive find its home by itself, as its start-up SDOs say; Ctrl-C stops it."""
    with stopping(client := connect("home")):
        result = client.call("home", {"joint": _name(joint)}, timeout_s=HOMING_S)
    report(f"{result['joint']} is homed and stands at {result['position']:.6f} rad")


def _name(joint: str) -> str:
    """Return the joint's name; a number counts from the base."""
    if not joint.isdecimal():
        return joint
    with connect("status") as client:
        names = client.call("status").get("joint_names") or []
    if not 1 <= int(joint) <= len(names):
        raise CommandError(f"joint {joint} does not exist: 1 to {len(names)}, or one of {', '.join(names)}")
    return str(names[int(joint) - 1])
