"""`rtcp axis`: motions of external axes, those that are no joints of the arm."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, as_written, number, option, positive
from rtcp.cli.motion import PresentIsHome, announce_homing
from rtcp.cli.output import report
from rtcp.cli.platform import connect, stoppable

_HOLD_S, _AGAIN_S = 0.5, 0.1
"""Hold time of each command of a run, s, and the interval between them."""
_ENDS = "the connection is closed, the axis comes to rest"

commands = typer.Typer()
axis = typer.Typer(name="axis", help="Move axes that are no joints of the arm.", no_args_is_help=True)
commands.add_typer(axis)

Axis = Annotated[str, typer.Argument(metavar="AXIS", help="Name under external_axes.")]


@axis.command("move", context_settings=NUMBERS_AS_WRITTEN)
def _move(
    name: Axis,
    position: Annotated[str, as_written("POSITION", "m or rad, in the unit of the axis.")],
    speed: Annotated[float | None, option("--speed", help="m/s or rad/s. Default: the limit of the axis.")] = None,
) -> None:
    """Move an axis to a position; returns on arrival. Ctrl-C stops it."""
    positive("--speed", speed, "m/s or rad/s")
    target = number(position, "POSITION")
    with stoppable("axis move", _ENDS) as robot:
        arrived = robot.move_axis(name, target, speed)
        unit = robot.status().axes[name].unit
    report(f"{name} is at {arrived:.6g} {unit}")


@axis.command("run", context_settings=NUMBERS_AS_WRITTEN)
def _run(
    name: Axis,
    velocity: Annotated[str, as_written("VELOCITY", "m/s or rad/s, in the unit of the axis.")],
    seconds: Annotated[float | None, option("--for", "S", "How long, s. Default: until Ctrl-C.")] = None,
) -> None:
    """Run an axis at a velocity; Ctrl-C stops it."""
    positive("--for", seconds, "s")
    speed = number(velocity, "VELOCITY")
    with stoppable("axis run", _ENDS) as robot:
        end = None if seconds is None else time.monotonic() + seconds
        while (remaining_s := _AGAIN_S if end is None else end - time.monotonic()) > 0.0:
            robot.run_axis(name, speed, _HOLD_S)
            time.sleep(min(_AGAIN_S, remaining_s))
        robot.stop_axis(name)
        status = robot.status().axes[name]
    report(f"{name} rests at {status.position:.6g} {status.unit}")


@axis.command("home")
def _home(name: Axis, yes: PresentIsHome = False) -> None:
    """Let the drive of an axis search its home, as its object 0x6098 says. Ctrl-C stops it.

    It says first what the drive will do, and asks where the drive declares its present position to be the home.
    """
    with stoppable("axis home", _ENDS) as robot:
        announce_homing(robot, name, yes)
        position = robot.home_axis(name)
        unit = robot.status().axes[name].unit
    report(f"{name} is homed and stands at {position:.6g} {unit}")


@axis.command("stop")
def _stop(name: Axis) -> None:
    """Halt an axis; its drive stays enabled."""
    with connect("axis stop") as robot:
        robot.stop_axis(name)
    report(f"{name} rests")
