"""Trials of tasks by a user: a record beside each recording, and completion times by joystick and by trajectory.

A trial of a simulated person and one of a user (`rtcp user-trial`) have the same record and the same evaluation.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import groupby
from math import isfinite
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from rtcp.telemetry.experiments.experiment import Experiment, ExperimentFailed, Row, Setup
from rtcp.telemetry.experiments.picks import AIM_S, ITEMS, REACTION_S, by_joystick, by_trajectory, require_virtual

Way = Literal["joystick", "trajectory"]
WAYS: tuple[Way, ...] = get_args(Way)
SIMULATED = "simulated"
"""Participant of the trials that the simulated person carries out."""
_ENDING = ".trial.json"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.]*")
_ALLOWED: Mapping[str, tuple[tuple[type, ...], str]] = {
    "number": ((int,), "a whole number from 1"), "succeeded": ((bool,), "true or false"),
    "seconds": ((int, float), "a number above 0"), "began": ((str,), "a text"), "recording": ((str,), "a text"),
    "remarks": ((str,), "a text"),
}  # fmt: skip
"""Field of a record -> its types, and what is allowed in words."""


@dataclass(frozen=True)
class UserTrial:
    """One trial of a task.

    Attributes:
        participant: code of the person; no name.
        task: of a list that the study states before it begins, as `drink`.
        way: `joystick`, or `trajectory`: a computed motion that the person starts.
        number: of the trial with this participant, task and way, from 1.
        succeeded: whether the task was done as the protocol defines it.
        seconds: time from the signal to begin until the end of the task, s.
        began: time of the begin, ISO 8601, local time.
        recording: name of the file of the arm's recording beside the record; empty: none.
        remarks: what the observer noted.
    """

    participant: str
    task: str
    way: Way
    number: int
    succeeded: bool
    seconds: float
    began: str
    recording: str = ""
    remarks: str = ""

    def __post_init__(self) -> None:
        """Check the values; raises ValueError."""
        for field in ("participant", "task"):
            if not isinstance(getattr(self, field), str) or not _NAME.fullmatch(getattr(self, field)):
                raise ValueError(f"{field}: found {getattr(self, field)!r}, allowed are letters, digits, _ and .")
        if self.way not in WAYS:
            raise ValueError(f"way: found {self.way!r}, allowed are {', '.join(WAYS)}")
        for field, (types, allowed) in _ALLOWED.items():
            value = getattr(self, field)
            # In Python a truth value is an int too.
            is_allowed = isinstance(value, types) and (bool in types or not isinstance(value, bool))
            if not is_allowed or (field in ("number", "seconds") and not (isfinite(value) and value > 0)):
                raise ValueError(f"{field}: found {value!r}, allowed is {allowed}")

    @property
    def name(self) -> str:
        """Name of its files, without their endings."""
        return trial_name(self.participant, self.task, self.way, self.number)

    def write(self, folder: Path) -> Path:
        """Write the record and return its file; a record that exists is kept: raises FileExistsError, OSError."""
        path = folder / f"{self.name}{_ENDING}"
        with path.open("x") as file:
            file.write(json.dumps(asdict(self), indent=1) + "\n")
        return path


def trial_name(participant: str, task: str, way: Way, number: int) -> str:
    """Return the name of a trial's files."""
    return f"{participant}-{task}-{way}-{number}"


def next_number(folder: Path, participant: str, task: str, way: Way) -> int:
    """Return the number of the next trial in a folder; a recording without a record counts too."""
    number = 1
    while any(folder.glob(f"{trial_name(participant, task, way, number)}.*")):
        number += 1
    return number


def read_trials(folder: Path) -> list[UserTrial]:
    """Return the records in a folder and in its folders, in the order of their begin.

    Raises:
        ExperimentFailed: there is none, one is damaged, or two are of the same trial, as those of a copied folder.
    """
    trials: dict[str, UserTrial] = {}
    paths: dict[str, Path] = {}
    for path in sorted(folder.rglob(f"*{_ENDING}")):
        try:
            trial = UserTrial(**json.loads(path.read_bytes()))
        except (OSError, ValueError, TypeError, OverflowError) as error:
            raise ExperimentFailed(f"{path}: it is no record of a trial: {error}") from error
        if trial.name in trials:
            raise ExperimentFailed(
                f"{path}: it records the trial {trial.name}, and so does {paths[trial.name]}. "
                "Remove one of the two records, or move it to another folder"
            )
        trials[trial.name], paths[trial.name] = trial, path
    if not trials:
        raise ExperimentFailed(f"{folder}: there are no records of trials (*{_ENDING}) in it")
    return sorted(trials.values(), key=lambda trial: trial.began)


def figures(trials: Sequence[UserTrial]) -> Iterator[Row]:
    """Return completion times of the successful trials and the rate of success, by task and way, and their ratio."""
    for task, way, group in _groups(trials):
        done = [trial.seconds for trial in group if trial.succeeded]
        label = f"{task} by {way}"
        yield Row(f"{label}: trials", "", len(group))
        # The thesis states a hundred per cent for its users.
        yield Row(f"{label}: success", "%", 100.0 * len(done) / len(group), 100.0)
        if done:
            yield Row(f"{label}: completion time, mean", "s", float(np.mean(done)), "below 60", most=AIM_S)
            yield Row(f"{label}: completion time, least", "s", min(done))
            yield Row(f"{label}: completion time, greatest", "s", max(done))
        if len(done) > 1:
            yield Row(f"{label}: completion time, standard deviation", "s", float(np.std(done, ddof=1)))
    for task in dict.fromkeys(trial.task for trial in trials):
        means = [
            np.mean(
                [trial.seconds for trial in trials if (trial.task, trial.way) == (task, way) and trial.succeeded]
                or [np.nan]
            )
            for way in WAYS
        ]
        if np.isfinite(means).all():
            yield Row(f"{task}: time by joystick / by trajectory", "", float(means[0] / means[1]), "above 1")


def _groups(trials: Sequence[UserTrial]) -> list[tuple[str, Way, list[UserTrial]]]:
    def key(trial: UserTrial) -> tuple[str, Way]:
        return trial.task, trial.way

    return [(*name, list(group)) for name, group in groupby(sorted(trials, key=key), key)]


def draw(setup: Setup, trials: Sequence[UserTrial]) -> None:
    """Draw the completion times: a box for each task and way, a point for each trial, a cross for a failed one."""
    from matplotlib.figure import Figure

    groups = _groups(trials)
    figure = Figure(figsize=(max(6.0, 1.6 * len(groups)), 5.0), layout="constrained")
    axes = figure.add_subplot()
    colours: dict[str, str] = {"joystick": "tab:blue", "trajectory": "tab:orange"}
    for at, (_, way, group) in enumerate(groups):
        done = [trial.seconds for trial in group if trial.succeeded]
        if done:
            axes.boxplot([done], positions=[at], widths=0.5, showfliers=False, medianprops={"color": colours[way]})
        for trial in group:
            axes.plot(at, trial.seconds, "o" if trial.succeeded else "x", color=colours[way], alpha=0.6)
    axes.axhline(AIM_S, color="0.6", lw=0.8, ls="--", label="aim of the thesis")
    axes.set_xticks(range(len(groups)), [f"{task}\n{way}\n{len(group)} trials" for task, way, group in groups])
    axes.set(ylabel="completion time, s", ylim=(0.0, None))
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=8)
    setup.draw("completion-times", figure)


class JoystickExperiment(Experiment):
    """Pick and place by joystick and by computed trajectory in turn, each several times: completion times compared.

    Args:
        trials: of each item and way.
        items: some of `ITEMS`.
    """

    name = "joystick"
    title = "Joystick against computed trajectory: completion times"

    def __init__(self, trials: int = 3, items: Sequence[str] = tuple(ITEMS)) -> None:
        self._trials = trials
        self._items = items

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`; each trial has its record beside its recording."""
        require_virtual(setup)
        setup.note(f"the joystick is moved by a simulated person with a reaction time of {1e3 * REACTION_S:g} ms")
        trials = []
        try:
            with setup.platform() as robot:
                for number in range(1, self._trials + 1):
                    for item in self._items:
                        for way in WAYS:
                            began = datetime.now().astimezone().isoformat(timespec="seconds")
                            name = trial_name(SIMULATED, item, way, number)
                            if way == "joystick":
                                done = by_joystick(setup, robot, item, name, seed=number)
                            else:
                                done = by_trajectory(setup, robot, item, name)
                            trials.append(
                                UserTrial(
                                    SIMULATED, item, way, number, done.succeeded, done.seconds, began, f"{name}.mcap"
                                )
                            )
                            trials[-1].write(setup.folder)
                            setup.report(f"{item} by {way}, {number}: {done.seconds:.1f} s")
        finally:
            if trials:
                draw(setup, trials)
        yield from figures(trials)


class UserTrialsExperiment(Experiment):
    """The figures of `JoystickExperiment` from the records of users' trials; no platform is started.

    Args:
        folder: the records.
    """

    name, title = JoystickExperiment.name, JoystickExperiment.title  # a report shows both side by side

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def run(self, setup: Setup) -> Iterator[Row]:
        """See `Experiment.run`."""
        trials = read_trials(self._folder)
        participants = sorted({trial.participant for trial in trials})
        setup.note(f"{len(trials)} trials of {len(participants)} participants: {', '.join(participants)}")
        draw(setup, trials)
        yield from figures(trials)
