"""`rtcp arm`: forward and inverse kinematics, pictures, exports as URDF, C and MoveIt. No platform is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from rtcp.cli import arguments
from rtcp.cli.output import CommandError, ExitCode, emit, emit_json, report, show, table
from rtcp.config.model import UNLIMITED_TORQUE

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kinematics.model import ArmModel
    from kinematics.solution import Solution

_Exported = TypeVar("_Exported")
SINGULAR = 1e-9
"""Distance below which a configuration counts as singular, m or rad."""

ArmFile = Annotated[
    str | None,
    arguments.option("--arm", "FILE", "File of an arm, or name of a packaged one. Default: the platform's."),
]
Positions = Annotated[list[str], arguments.as_written("Q1..Q6", "Joint positions, rad or as -pi/2, base to tool.")]

HELP = "Compute with an arm: forward and inverse kinematics, picture, exports as URDF, C and MoveIt."
commands = typer.Typer(name="arm", help=HELP, no_args_is_help=True)


@commands.command("fk", context_settings=arguments.NUMBERS_AS_WRITTEN)
def _fk(positions: Positions, arm: ArmFile = None, as_json: arguments.AsJson = False) -> None:
    """Show the pose of the tool and of every frame at joint positions."""
    q = _joints(positions)
    model = _model(arm)
    from kinematics.forward import forward

    if as_json:
        pose = forward(model, q)
        # Adding 0.0 removes the sign of a zero, which comes from round-off.
        emit_json({"position": [value + 0.0 for value in pose.position], "rpy": [value + 0.0 for value in pose.rpy]})
        return
    show(*_forward_tables(model, q))


@commands.command("ik", context_settings=arguments.NUMBERS_AS_WRITTEN)
def _ik(
    pose: Annotated[
        list[str],
        arguments.as_written("X Y Z RX RY RZ", "Tool pose: m, and rad (or as -pi/2) of R = Rx(rx) Ry(ry) Rz(rz)."),
    ],
    near: Annotated[
        tuple[str, str, str, str, str, str] | None,
        arguments.option("--near", "Q1..Q6", "Joint positions, rad, for joints that a singularity frees."),
    ] = None,
    arm: ArmFile = None,
    as_json: arguments.AsJson = False,
) -> None:
    """Show all joint positions that reach a pose; exit code 3 where there are none."""
    target = arguments.pose_values(pose)
    q_near = None if near is None else arguments.joint_values(near, "--near, ")
    model = _model(arm)
    from kinematics.inverse import InverseKinematics
    from kinematics.pose import Pose

    result = InverseKinematics(model).solve(Pose.from_xyzrpy(*target), q_near)
    if as_json:
        solutions = [
            {"q": list(entry.q), "branch": entry.branch and str(entry.branch), "within_limits": entry.within_limits}
            for entry in result.solutions
        ]
        emit_json({"solutions": solutions, "reason": result.reason})
    if not result.solutions:
        raise CommandError(result.reason or "there is no solution", ExitCode.REFUSED)
    if not as_json:
        show(*_inverse_tables(model, result.solutions))


@commands.command("plot", context_settings=arguments.NUMBERS_AS_WRITTEN)
def _plot(
    positions: Positions,
    out: Annotated[Path, arguments.option("--out", "FILE", f"Picture: {', '.join(arguments.PICTURES)}.")] = (
        Path("arm.png")
    ),
    arm: ArmFile = None,
) -> None:
    """Draw the arm and its frames."""
    q = _joints(positions)
    arguments.check_picture("--out", out)
    model = _model(arm)
    from rtcp.cli.arm_plot import draw

    _write(out, lambda: draw(model, q, out))


@commands.command("range")
def _range(
    out: Annotated[Path, arguments.option("--out", "FILE", f"Picture: {', '.join(arguments.PICTURES)}.")] = (
        Path("range.png")
    ),
    facing: Annotated[
        float, typer.Option("--facing", min=0.0, metavar="M", help="A second arm that faces it, M meters away.")
    ] = 0.0,
    arm: ArmFile = None,
) -> None:
    """Draw where the wrist can be, within the mechanical limits of the joints."""
    arguments.check_picture("--out", out)
    from rtcp.cli.arm_range import draw_range
    from rtcp.config import find_arm
    from rtcp.config.loader import load_mechanics

    model = load_mechanics(find_arm(arm))
    _write(out, lambda: draw_range(model, out, facing))


@commands.command("urdf")
def _urdf(
    out: Annotated[Path | None, arguments.option("--out", "FILE", "File to write. Default: standard output.")] = None,
    arm: ArmFile = None,
) -> None:
    """Export the arm as URDF, for viewers, simulators and planners."""
    from kinematics.urdf import to_urdf
    from rtcp.config import find_arm, load_kinematics
    from rtcp.config.loader import whole_arm

    file = find_arm(arm)
    joints = config.joints if (config := whole_arm(file)) else ()
    text = to_urdf(load_kinematics(file), [joint.torque for joint in joints if joint.torque < UNLIMITED_TORQUE] or None)
    if out is None:
        emit(text.rstrip("\n"))
    else:
        _write(out, lambda: out.write_text(text, encoding="utf-8"))


@commands.command("export-c")
def _export_c(
    out: Annotated[
        Path, arguments.option("--out", "DIR", "Folder to write to; it is made where it is missing.")
    ] = Path(),
    arm: ArmFile = None,
) -> None:
    """Export forward and inverse kinematics as a C file and its header, which need no Python."""
    from kinematics.c_source import to_c

    model = _model(arm)
    _write_files(out, _covered(lambda: to_c(model)).files)


@commands.command("export-moveit")
def _export_moveit(
    out: Annotated[
        Path, arguments.option("--out", "DIR", "Folder for the package, as the src of a workspace.")
    ] = Path(),
    arm: ArmFile = None,
) -> None:
    """Export a ROS package for MoveIt: analytic kinematics, URDF, SRDF, limits, controllers."""
    from rtcp.cli.arm_moveit import moveit_package
    from rtcp.config import find_arm

    file = find_arm(arm)
    package = _covered(lambda: moveit_package(file))
    if (out / package.name).exists():
        raise CommandError(f"{out / package.name} exists: remove it, or name another folder by --out")
    _write_files(out / package.name, package.files)


def _model(arm: str | None) -> ArmModel:
    from rtcp.config import find_arm, load_kinematics

    return load_kinematics(find_arm(arm))


def _joints(positions: Sequence[str]) -> list[float]:
    if len(positions) != arguments.JOINTS:
        raise CommandError(
            f"{len(positions)} positions for an arm of {arguments.JOINTS} joints: give {arguments.JOINTS} numbers, rad"
        )
    return arguments.joint_values(positions)


def _covered(export: Callable[[], _Exported]) -> _Exported:
    """Run an export; raises CommandError with the reason for an arm that it does not support."""
    try:
        return export()
    except ValueError as error:
        raise CommandError(str(error), ExitCode.REFUSED) from error


def _write_files(folder: Path, files: dict[str, str]) -> None:
    """Write files, by their paths below a folder."""
    for name, text in files.items():
        path = folder / name

        def write(path: Path = path, text: str = text) -> None:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")

        _write(path, write)


def _write(out: Path, write: Callable[[], object]) -> None:
    try:
        write()
    except OSError as error:
        raise CommandError(f"--out {out} cannot be written: {error.strerror or error}") from error
    report(f"wrote {out}")


def _forward_tables(model: ArmModel, q: Sequence[float]) -> list[RenderableType]:
    """Return the frames at joint positions `q`, rad, their limits and their distances to singularities."""
    from rich.text import Text

    from kinematics.forward import frames
    from kinematics.jacobian import manipulability, singularity_distances

    rows = table(
        ("frame", "x", "y", "z", "rx", "ry", "rz"), ("frame",), title=f"{model.name}: frames in the base frame, m, rad"
    )
    for name, pose in zip([*map(str, range(1, 7)), "tool"], frames(model, q), strict=True):
        numbers = (f"{value:.6f}" for value in (*pose.position, *pose.rpy))
        rows.add_row(name, *map(_zero, numbers), style="bold" if name == "tool" else "")
    distances = singularity_distances(model, q)
    named = zip(("shoulder", "elbow", "wrist"), distances, ("m", "rad", "rad"), strict=False)
    known = [f"{name} {_small(value)} {unit}" for name, value, unit in named if value is not None]
    lines = [
        f"from the singularities: {', '.join([*known, f'smallest singular value {_small(distances.smallest)}'])}",
        f"manipulability {_small(manipulability(model, q))} m^3",
    ]
    lines += [
        f"{name} at {value:g} rad is outside its limits, {limit.lower:g} to {limit.upper:g}"
        for name, value, limit in zip(model.joint_names, q, model.limits, strict=True)
        if not limit.lower <= value <= limit.upper
    ]
    return [rows, *(Text(f" {line}") for line in lines)]


def _inverse_tables(model: ArmModel, solutions: Sequence[Solution]) -> list[RenderableType]:
    """Return the solutions: joint positions, then limits and distances to the singularities."""
    from rich.text import Text

    from kinematics.jacobian import singularity_distances
    from kinematics.solution import Singularity

    counted = "1 solution" if len(solutions) == 1 else f"{len(solutions)} solutions"
    headings = ("#", "branch", *(f"q{joint}" for joint in range(1, 7)), "limits")
    joints = table(headings, ("branch", "limits"), title=f"{model.name}: {counted}, rad", padding=0)
    distances = table(
        ("#", "outside", "shoulder m", "elbow rad", "wrist rad", "smallest", "singular"),
        ("outside", "singular"),
        title="limits and distances to the singularities",
    )
    for column in (1, 6):
        distances.columns[column].no_wrap = False
    for number, entry in enumerate(solutions, 1):
        joints.add_row(
            str(number),
            str(entry.branch or "-"),
            *(Text(_zero(f"{q:.4f}"), "red" if joint in entry.outside else "") for joint, q in enumerate(entry.q)),
            "inside" if entry.within_limits else "outside",
            style="" if entry.within_limits else "dim",
        )
        distances.add_row(
            str(number),
            ", ".join(f"q{joint + 1}" for joint in entry.outside) or "-",
            *("-" if value is None else _small(value) for value in singularity_distances(model, entry.q)),
            ", ".join(flag.name.lower() for flag in Singularity if flag in entry.singularity and flag.name) or "-",
        )
    parts: list[RenderableType] = [joints, Text(""), distances]
    if not any(solution.within_limits for solution in solutions):
        parts.append(Text(" no solution is inside the joints' limits"))
    return parts


def _small(value: float) -> str:
    return "0" if value < SINGULAR else f"{value:.3g}"


def _zero(number: str) -> str:
    """Remove the sign of a zero, which comes from round-off."""
    return number.removeprefix("-") if not number.strip("-0.") else number
