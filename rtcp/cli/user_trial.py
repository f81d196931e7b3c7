"""`rtcp user-trial`: the form of one trial with a user, filled in at the terminal while the arm is recorded."""

from __future__ import annotations

import time
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, ExitCode, interruptible, report
from rtcp.cli.platform import connect

if TYPE_CHECKING:
    from rtcp.telemetry.experiments.user_trials import Way

commands = typer.Typer()


@commands.command("user-trial")
def _user_trial(
    participant: Annotated[str, option("--participant", "CODE", "Code of the person, as P01; never a name.")],
    task: Annotated[str, option("--task", "TASK", "The task, as drink.")],
    way: Annotated[str, option("--by", "joystick|trajectory", "What moves the arm.")] = "joystick",
    out: Annotated[Path, option("--out", "DIR", "Folder of the study.")] = Path("user-trials"),
) -> None:
    """Record one trial with a user: time, success and remarks in a file beside the recording of the arm.

    The arm is moved by the user or by another command; this one only records.
    """
    from rtcp.telemetry.experiments.user_trials import UserTrial, next_number, trial_name

    by = cast("Way", way)
    try:
        # The values are checked before anybody begins; success and time are not known yet.
        UserTrial(participant, task, by, 1, succeeded=False, seconds=1.0, began="")
        out.mkdir(parents=True, exist_ok=True)
        number = next_number(out, participant, task, by)
        recording = f"{trial_name(participant, task, by, number)}.mcap"
    except ValueError as error:
        raise CommandError(str(error)) from error
    except OSError as error:
        raise CommandError(f"the folder {out} cannot be made: {error.strerror}") from error
    with interruptible("interrupted: there is no record of this trial"), connect("user trial") as robot:
        pid = robot.record_start(out / recording).pid
        try:
            _ask("Enter: the task begins ")
            began, begun_s = datetime.now().astimezone().isoformat(timespec="seconds"), time.monotonic()
            _ask("Enter: the task has ended ")
            seconds = max(time.monotonic() - begun_s, 0.001)
        finally:
            robot.record_stop(pid)
    while (answer := _ask("Was the task done as the protocol says? y or n: ").strip().lower()) not in ("y", "n"):
        pass
    remarks = _ask("Remarks: ").strip()
    trial = UserTrial(participant, task, by, number, answer == "y", seconds, began, recording, remarks)
    try:
        path = trial.write(out)
    except OSError as error:
        raise CommandError(
            f"{error.filename}: the record cannot be written: {error.strerror}", ExitCode.FAULT
        ) from error
    report(f"{seconds:.1f} s, {'done' if trial.succeeded else 'not done'}: {path}")


def _ask(question: str) -> str:
    """Return a line from the terminal; raises CommandError at the end of the input."""
    try:
        return input(question)
    except EOFError as error:
        raise CommandError("the input has ended: there is no record of this trial", ExitCode.FAULT) from error
