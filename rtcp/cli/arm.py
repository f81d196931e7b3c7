"""`rtcp arm`: where the tool is, which joints bring it somewhere, a picture, a URDF file. No platform is needed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.cli.arguments import NUMBERS_AS_WRITTEN, refuse_options
from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import emit, emit_json, report, show
from rtcp.config.plain_number import plain_number

if TYPE_CHECKING:
    from kinematics.model import ArmModel

JOINTS = 6
POSE = ("x", "y", "z", "rx", "ry", "rz")
PICTURES = (".png", ".svg", ".pdf")

ArmFile = Annotated[
    str | None,
    typer.Option(
        "--arm", metavar="FILE", help="An arm's file, or the name of one that comes along; else the platform's."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object, SI units.")]
Positions = Annotated[
    list[str], typer.Argument(metavar="Q1..Q6", help="Joint positions, rad or as -pi/2, base to tool.")
]
Near = Annotated[
    tuple[str, str, str, str, str, str] | None,
    typer.Option("--near", metavar="Q1..Q6", help="Joint positions, rad, that free joints keep on a singularity."),
]


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    arm = typer.Typer(help="Compute with an arm: forward and inverse kinematics, picture, URDF.", no_args_is_help=True)
    arm.command("fk", context_settings=NUMBERS_AS_WRITTEN)(_fk)
    arm.command("ik", context_settings=NUMBERS_AS_WRITTEN)(_ik)
    arm.command("plot", context_settings=NUMBERS_AS_WRITTEN)(_plot)
    arm.command("urdf")(_urdf)
    app.add_typer(arm, name="arm")


def _fk(positions: Positions, arm: ArmFile = None, as_json: AsJson = False) -> None:
    """Show where joint positions bring the tool, and every frame."""
    q = _joints(positions, ("--arm", "--json"))
    model = _model(arm)
    from kinematics.forward import forward

    if as_json:
        pose = forward(model, q)
        # The sums take the sign from a zero, which only round-off gave it.
        emit_json({"position": [value + 0.0 for value in pose.position], "rpy": [value + 0.0 for value in pose.rpy]})
        return
    from rtcp.cli.arm_view import forward_picture

    show(*forward_picture(model, q))


def _ik(
    pose: Annotated[
        list[str],
        typer.Argument(
            metavar="X Y Z RX RY RZ", help="Tool pose: m, and rad (or as -pi/2) of R = Rx(rx) Ry(ry) Rz(rz)."
        ),
    ],
    near: Near = None,
    arm: ArmFile = None,
    as_json: AsJson = False,
) -> None:
    """Show all joint positions that bring the tool to a pose; exit code 3 when there are none."""
    _refuse_options(pose, ("--near", "--arm", "--json", "--help", "-h"))
    if len(pose) != len(POSE):
        raise CommandError(f"{len(pose)} numbers for a pose of {len(POSE)}: give {' '.join(map(str.upper, POSE))}")
    wanted = _numbers(pose, POSE)
    q_near = None if near is None else _numbers(near, [f"--near, joint {joint}" for joint in range(1, JOINTS + 1)])
    model = _model(arm)
    from kinematics.inverse import InverseKinematics
    from kinematics.pose import Pose

    found = InverseKinematics(model).solve(Pose.from_xyzrpy(*wanted), q_near)
    if as_json:
        solutions = [
            {
                "q": list(one.q),
                "branch": None if one.branch is None else str(one.branch),
                "within_limits": one.within_limits,
            }
            for one in found.solutions
        ]
        emit_json({"solutions": solutions, "reason": found.reason})
    if not found.solutions:
        raise CommandError(found.reason or "there is no solution", ExitCode.REFUSED)
    if not as_json:
        from rtcp.cli.arm_view import inverse_picture

        show(*inverse_picture(model, found.solutions))


def _plot(
    positions: Positions,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help=f"Where the picture goes: {', '.join(PICTURES)}.")
    ] = Path("arm.png"),
    arm: ArmFile = None,
) -> None:
    """Draw the arm and its frames."""
    q = _joints(positions, ("--out", "--arm"))
    if out.suffix.lower() not in PICTURES:
        raise CommandError(f"--out {out}: the ending must be one of {', '.join(PICTURES)}")
    model = _model(arm)
    from rtcp.cli.arm_plot import draw

    _write(out, lambda: draw(model, q, out))


def _urdf(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Where it goes; else to standard output.")
    ] = None,
    arm: ArmFile = None,
) -> None:
    """Give the arm as URDF, for viewers, simulators and planners."""
    from kinematics.urdf import to_urdf
    from rtcp.config import find_arm, load_kinematics
    from rtcp.config.kinematics import torque_limits

    file = find_arm(arm)
    text = to_urdf(load_kinematics(file), torque_limits(file))
    if out is None:
        emit(text.rstrip("\n"))
        return
    _write(out, lambda: out.write_text(text, encoding="utf-8"))


def _model(arm: str | None) -> ArmModel:
    from rtcp.config import find_arm, load_kinematics

    return load_kinematics(find_arm(arm))


def _joints(positions: Sequence[str], options: Sequence[str]) -> list[float]:
    _refuse_options(positions, (*options, "--help", "-h"))
    if len(positions) != JOINTS:
        raise CommandError(f"{len(positions)} positions for an arm of {JOINTS} joints: give {JOINTS} numbers, rad")
    return _numbers(positions, [f"joint {joint}" for joint in range(1, JOINTS + 1)])


def _refuse_options(values: Sequence[str], known: Sequence[str]) -> None:
    """Refuse what was meant as an option; the minus sign of a fraction of pi is none of an option."""
    from rtcp.config.geometry import angle

    refuse_options([value for value in values if angle(value) == value], known)


def _numbers(values: Sequence[str], names: Sequence[str]) -> list[float]:
    """Return finite numbers; every value that is none is named in one error."""
    from rtcp.config.geometry import angle

    numbers, wrong = [], []
    for value, name in zip(values, names, strict=True):
        unit = "m" if name in POSE[:3] else "rad"
        written = value if unit == "m" else angle(value)
        try:
            number = plain_number(written)
        except ValueError:
            wrong.append(f"{name}: {value!r} is not a number ({unit})")
            continue
        if not math.isfinite(number):
            wrong.append(f"{name}: {value} is not finite; a finite number of {unit} is needed")
        numbers.append(number)
    if wrong:
        raise CommandError("\n".join(wrong))
    return numbers


def _write(out: Path, write: Callable[[], object]) -> None:
    try:
        write()
    except OSError as error:
        raise CommandError(f"--out {out}: it cannot be written: {error.strerror or error}") from error
    report(f"{out} is written")
