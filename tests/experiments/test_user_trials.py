"""Records of trials by users: written once, read back, checked, and evaluated as those of the simulated person."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli.__main__ import main
from rtcp.telemetry.experiments.experiment import ExperimentFailed, Row, Setup, carry_out, read_result
from rtcp.telemetry.experiments.user_trials import UserTrial, UserTrialsExperiment, figures, next_number, read_trials

TRIAL = UserTrial("P01", "drink", "joystick", 1, True, 48.0, "2026-11-28T10:00:00+01:00", "P01-drink-joystick-1.mcap")


def trials() -> list[UserTrial]:
    """Four participants, one of whom failed once by the joystick."""
    made = []
    for at, (by_hand, computed) in enumerate(((40.0, 20.0), (50.0, 21.0), (60.0, 19.0), (70.0, 20.0))):
        began = f"2026-11-28T10:0{at}:00+01:00"
        participant = f"P{at + 1:02}"
        made.append(UserTrial(participant, "drink", "joystick", 1, at != 3, by_hand, began))
        made.append(UserTrial(participant, "drink", "trajectory", 1, True, computed, began))
    return made


def by_figure(rows: Any) -> dict[str, Row]:
    return {row.figure: row for row in rows}


def test_a_record_is_read_back_as_it_was_written_and_never_written_over(tmp_path: Path) -> None:
    TRIAL.write(tmp_path)
    assert read_trials(tmp_path) == [TRIAL]
    with pytest.raises(FileExistsError):
        replace(TRIAL, seconds=1.0).write(tmp_path)
    assert read_trials(tmp_path) == [TRIAL]


def test_the_next_trial_gets_the_next_number_also_after_a_recording_without_a_record(tmp_path: Path) -> None:
    assert next_number(tmp_path, "P01", "drink", "joystick") == 1
    TRIAL.write(tmp_path)
    (tmp_path / "P01-drink-joystick-2.mcap").touch()
    assert next_number(tmp_path, "P01", "drink", "joystick") == 3
    assert next_number(tmp_path, "P01", "drink", "trajectory") == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"participant": ""}, {"participant": "../P01"}, {"task": "a b"}, {"way": "voice"}, {"succeeded": "yes"},
        {"seconds": 0.0}, {"seconds": float("nan")}, {"seconds": "48"}, {"seconds": True}, {"seconds": 10**400},
        {"number": "x"}, {"number": 0}, {"number": 1.5}, {"number": True}, {"began": 5}, {"began": None},
        {"recording": 1}, {"remarks": [1]}, {"unknown": 1},
    ],
)  # fmt: skip
def test_a_record_with_a_value_that_is_not_allowed_is_named_with_its_file(
    tmp_path: Path, wrong: dict[str, Any]
) -> None:
    path = TRIAL.write(tmp_path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **wrong}))
    replace(TRIAL, number=2).write(tmp_path)
    with pytest.raises(ExperimentFailed, match=r"P01-drink-joystick-1\.trial\.json"):
        read_trials(tmp_path)


def test_two_records_of_one_trial_are_refused_with_both_files(tmp_path: Path) -> None:
    (tmp_path / "backup").mkdir()
    files = [TRIAL.write(folder) for folder in (tmp_path, tmp_path / "backup")]
    with pytest.raises(ExperimentFailed) as raised:
        read_trials(tmp_path)
    assert all(str(file) in str(raised.value) for file in files)


def test_a_folder_without_records_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ExperimentFailed, match="no records"):
        read_trials(tmp_path)


def test_times_are_those_of_the_successful_trials_and_success_counts_all() -> None:
    rows = by_figure(figures(trials()))
    assert rows["drink by joystick: trials"].here == 4
    assert rows["drink by joystick: success"].here == 75.0
    assert rows["drink by joystick: completion time, mean"].here == pytest.approx(50.0)
    assert rows["drink by joystick: completion time, standard deviation"].here == pytest.approx(10.0)
    assert rows["drink by trajectory: success"].here == 100.0
    assert rows["drink: time by joystick / by trajectory"].here == pytest.approx(2.5)


def test_a_task_that_nobody_completed_has_no_time() -> None:
    rows = by_figure(figures([replace(TRIAL, succeeded=False)]))
    assert rows["drink by joystick: success"].here == 0.0
    assert not any("time" in figure for figure in rows)


def test_the_records_of_a_study_become_a_result_with_a_picture(tmp_path: Path) -> None:
    study = tmp_path / "study"
    for trial in trials():
        (study / trial.participant).mkdir(parents=True, exist_ok=True)
        trial.write(study / trial.participant)
    carry_out(UserTrialsExperiment(study), Setup(tmp_path, nullcontext, print), "a test")
    result = read_result(tmp_path)
    assert (result.name, result.pictures) == ("joystick", ("completion-times",))
    assert result.notes[0] == "8 trials of 4 participants: P01, P02, P03, P04"
    assert (tmp_path / "completion-times.png").stat().st_size > 0


def test_the_command_evaluates_the_records_without_a_platform(tmp_path: Path) -> None:
    for trial in trials():
        trial.write(tmp_path)
    assert main(["experiment", "joystick", "--records", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert "drink: time by joystick / by trajectory" in by_figure(read_result(tmp_path / "out").rows)


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [("--participant", "Jane Doe", "participant: found 'Jane Doe'"), ("--by", "voice", "way: found 'voice'")],
)
def test_a_form_with_a_wrong_entry_is_refused_before_the_trial(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str, value: str, said: str
) -> None:
    entries = {"--participant": "P01", "--task": "drink", "--out": str(tmp_path / "study"), option: value}
    assert main(["user-trial", *(word for entry in entries.items() for word in entry)]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "study").exists()
