"""`rtcp arm new`: asks for the limits of each joint and writes the arm's file, and the segment's beside it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from rtcp.cli import arm
from rtcp.cli.arguments import option, positive
from rtcp.cli.device import choose
from rtcp.cli.output import CommandError, asking, new_file, report
from rtcp.config.model import MOST_AXES
from rtcp.config.numbers import angle, plain_number

_INSTEAD = "answer it, or pass --answers"


@arm.commands.command("new")
def _new(
    out: Annotated[Path, option("--out", "FILE", "The arm's file to write; devices/ is beside it.")],
    device: Annotated[str, option("--device", "NAME", "File of the drives, devices/NAME.yaml.")],
    joints: Annotated[int, option("--joints", "N", "Number of joints.")] = 6,
    esi: Annotated[
        Path | None, option("--esi", "FILE", "The maker's ESI file: writes the segment's file, too.")
    ] = None,
    choice: Annotated[
        int | None, option("--choice", "N", "Which of several devices of one identity, as for `device new`.")
    ] = None,
    answers: Annotated[
        Path | None, option("--answers", "FILE", "The numbers by name, one for all joints or a list. Default: asks.")
    ] = None,
    period_us: Annotated[float, option("--period-us", "US", "Period of the cycle.")] = 1000.0,
) -> None:
    """Ask for the limits of each joint and write the arm's file, with the unit beside each value.

    With --esi it also writes FILE_segment.yaml: the same drives in software, for the bus `virtual`.
    """
    from rtcp.config.arm_file import arm_text, segment_text
    from rtcp.config.document import read
    from rtcp.config.loader import load, load_device, segment_path
    from rtcp.esi.reader import choice_of, read_esi
    from rtcp.virtual.segment import check_segment

    positive("--period-us", period_us, "us")
    if not 1 <= joints <= MOST_AXES:
        raise CommandError(f"--joints {joints} is not allowed: 1 to {MOST_AXES}")
    described = load_device(out.parent / "devices" / f"{device}.yaml")
    if choice is not None and esi is None:
        raise CommandError("--choice needs --esi: it says which device of that file the drive is")
    content = None if esi is None else read_esi(esi)
    description = None if content is None else choose(content, described.product_id, None, choice)
    numbers = _numbers(joints, None if answers is None else read(answers).data)
    segment = "" if esi is None else f"{out.stem}_segment.yaml"
    written = [(out, arm_text(out.stem, device, described, numbers, period_us, segment))]
    if esi is not None and content is not None and description is not None:
        relative, number = os.path.relpath(esi, out.parent), choice_of(content, description)
        written.append((out.parent / segment, segment_text(relative, description, described, joints, number)))
    with new_file(out) as first:
        first.write(written[0][1].encode())
        first.flush()
        try:
            for path, text in written[1:]:
                with new_file(path) as file:
                    file.write(text.encode())
            config = load(out)
            if segment:
                check_segment(segment_path(config))
        except BaseException as error:
            first.truncate(0)  # and with that no file is left
            if segment and not isinstance(error, CommandError):  # which says that the file was there before
                (out.parent / segment).unlink(missing_ok=True)
            raise
    for path, _ in written:
        report(f"wrote {path}")
    report(f"next: `rtcp start --config {out}`" + ("" if segment else " --bus eth0"))


def _numbers(joints: int, given: Any) -> list[dict[str, float]]:
    """Return the numbers of each joint, from `given` or the terminal; raises CommandError for one that is wrong."""
    from rtcp.config.arm_file import QUANTITIES

    found: list[dict[str, float]] = [{} for _ in range(joints)]
    if given is not None:
        _check_keys(given)
    for place, values in enumerate(found):
        for key, unit, meaning in QUANTITIES:
            where = f"joint{place + 1}, {key}"
            if given is None:
                question = f"joint{place + 1}: {meaning}, {unit}"
                default = _shown(found[place - 1][key]) if place else None
                with asking(_INSTEAD):
                    values[key] = typer.prompt(question, default=default, value_proc=_asked_number)
                continue
            entry = given[key]
            if isinstance(entry, list) and len(entry) != joints:
                raise CommandError(f"--answers: {key}: found {len(entry)} numbers, needed are 1 or {joints}")
            values[key] = _number(entry[place] if isinstance(entry, list) else entry, f"--answers: {where}")
    return found


def _check_keys(given: Any) -> None:
    from rtcp.config.arm_file import QUANTITIES

    known = [quantity.key for quantity in QUANTITIES]
    if not isinstance(given, Mapping) or sorted(given) != sorted(known):
        missing = [key for key in known if not isinstance(given, Mapping) or key not in given]
        unknown = [] if not isinstance(given, Mapping) else [str(key) for key in given if key not in known]
        needed = ", ".join(f"{quantity.key} ({quantity.unit})" for quantity in QUANTITIES)
        wrong = f"missing: {', '.join(missing) or 'nothing'}; unknown: {', '.join(unknown) or 'nothing'}"
        raise CommandError(f"--answers: {wrong}; needed are {needed}")


def _asked_number(text: str) -> float:
    try:
        return plain_number(angle(text))
    except ValueError as error:
        raise typer.BadParameter(f"found {text!r}, allowed is a number, or as -pi/2") from error


def _number(value: object, where: str) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        return plain_number(angle(value))
    except ValueError as error:
        raise CommandError(f"{where}: found {value!r}, allowed is a number, or as -pi/2") from error


def _shown(value: float) -> str:
    return f"{value:g}"
