"""`rtcp faults`: the list, one fault, its picture; no platform runs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.cli import faults
from rtcp.ipc.observer import record_type
from rtcp.ipc.recording import About, FaultRecording, Moment, faults_directory, read, write
from rtcp.ipc.schema import FLAG_ENABLED, arm_schema
from rtcp.ipc.states import State

JOINTS, PERIOD_NS, CYCLES, AT = 3, 1_000_000, 1200, 800
WHEN_NS = 1_790_000_000_250_000_000
WHAT = "joint2: the drive is in fault (statusword 0x0218), [red]; `rtcp reset` goes on"


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "state"))
    return tmp_path / "state"


def recording() -> FaultRecording:
    """An arm that moves for 0.8 s and faults; after the fault no frame comes for 40 cycles."""
    schema = arm_schema(JOINTS)
    records = np.zeros(CYCLES, dtype=record_type(schema))
    cycles = np.arange(CYCLES)
    records["number"] = cycles + 5
    records["time_ns"] = (cycles + 7) * PERIOD_NS
    records["state"] = np.where(cycles < AT, State.MOVING, State.FAULT)
    records["wkc_expected"] = 10
    records["wkc"] = np.where((cycles > AT) & (cycles <= AT + 40), -1, 10)
    records["lost"] = np.where((cycles > AT) & (cycles <= AT + 40), cycles - AT, 0)
    records["flags"] = FLAG_ENABLED
    records["missed"] = np.where(cycles < 100, 2, 5)
    records["sent_position"] = np.minimum(cycles, AT)[:, None] * 1e-4 * np.array([1, 2, -1])
    records["sent_position"][300:, 1] += 0.01
    records["actual_position"] = records["sent_position"] - 0.001
    records["actual_velocity"][:AT] = (0.1, 0.2, -0.1)
    records["actual_torque"][AT] = (1.0, -2.0, 3.0)
    about = About(
        number=0, time_ns=WHEN_NS, what=WHAT, before="moving", arm="arm", bus="virtual", period_ns=PERIOD_NS,
        joints=("base", "elbow", "wrist"), versions={"rtcp": "9.9"}, began_ns=5, event=7, at=AT,
        notes=("0.8 s before the fault instead of 10 s: the platform had just started",),
        timeline=(Moment(WHEN_NS - 500_000_000, "a sentence before"), Moment(WHEN_NS, WHAT),
                  Moment(WHEN_NS + 20_000_000, "slave 3 sent emergency 0x8611")),
    )  # fmt: skip
    return FaultRecording(about, records, schema)


def test_without_a_recording_the_list_says_so(rtcp: Callable[..., Any], state: Path) -> None:
    ended = rtcp("faults")
    assert ended.code == 0
    assert f"no fault has been recorded in {state}/faults" in ended.out
    assert json.loads(rtcp("faults", "--json").out) == {"faults": []}
    assert not state.exists()


def test_the_list_has_number_time_first_sentence_state_before_and_the_length_recorded(rtcp: Callable[..., Any]) -> None:
    write(faults_directory(), recording())
    write(faults_directory(), recording())
    ended = rtcp("faults")
    output = " ".join(ended.out.split())
    when = recording().about.when
    assert f"2 {when:%Y-%m-%d %H:%M:%S} joint2: the drive is in" in output
    assert "moving 1.2 s" in output
    assert "recorded" in output
    assert "duration" not in output
    assert "1: 0.8 s before the fault instead of 10 s" in output
    assert max(len(line) for line in ended.out.splitlines()) <= 80
    rows = json.loads(rtcp("faults", "--json").out)["faults"]
    assert [row["number"] for row in rows] == [1, 2]
    assert (rows[0]["what"], rows[0]["before"], rows[0]["seconds"]) == (WHAT, "moving", 1.199)


def test_a_file_that_is_none_is_a_sentence_in_the_list_and_the_others_are_shown(rtcp: Callable[..., Any]) -> None:
    _, path = write(faults_directory(), recording())
    path.write_bytes(path.read_bytes()[:3000])
    write(faults_directory(), recording())
    ended = rtcp("faults")
    assert ended.code == 0
    assert "unreadable" in ended.out
    assert "is cut off, damaged or no recording" in " ".join(ended.out.split())
    assert "moving" in ended.out
    assert "error" in json.loads(rtcp("faults", "--json").out)["faults"][0]
    result = rtcp("faults", "show", "1")
    assert (result.code, result.out) == (5, "")
    assert "cut off" in result.trouble


def test_one_fault_is_shown_with_what_happened_the_joints_steps_and_frames(rtcp: Callable[..., Any]) -> None:
    _, path = write(faults_directory(), recording())
    ended = rtcp("faults", "show", "1")
    assert ended.code == 0
    output = " ".join(ended.out.split())
    for text in (
        "FAULT 1", "arm on virtual", "[red]; `rtcp reset` goes on", "before: moving; rtcp 9.9",
        "-0.500 a sentence before", "+0.000 state: moving -> fault", "+0.020 slave 3 sent emergency 0x8611",
        "elbow +0.1690 +0.1700 +0.0000 -2.0000", "1200 cycles, -0.8 s to +0.4 s",
        "0.0102 rad of a target in one cycle (elbow, 10.2 rad/s, at -0.500 s)", "3 cycles of the grid",
        "working counter 10 of 10 at the fault; 40 wrong, 40 without an answer",
        "0.8 s before the fault instead of 10 s",
    ):  # fmt: skip
        assert text in output, text
    assert max(len(line) for line in ended.out.split("\nrecording:")[0].splitlines()) <= 80
    picture = path.with_suffix(".png")
    assert ended.out.endswith(f"recording: {path}\npicture: {picture}\n")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_json_of_a_fault_has_the_same_in_numbers_and_draws_only_when_asked(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    _, path = write(faults_directory(), recording())
    answer = json.loads(rtcp("faults", "show", "1", "--json").out)
    assert answer["largest_step"] == {
        "joint": "elbow", "rad": pytest.approx(0.0102), "rad_per_s": pytest.approx(10.2), "t_s": -0.5,
    }  # fmt: skip
    assert answer["wkc"] == {"expected": 10, "actual": 10, "wrong_cycles": 40, "without_answer": 40}
    assert answer["missed"] == 3
    assert answer["joints"]["actual_torque"] == [1.0, -2.0, 3.0]
    assert [event["t_s"] for event in answer["timeline"]] == [-0.5, 0.0, 0.0, 0.02]
    assert not path.with_suffix(".png").exists()
    out = tmp_path / "mine.svg"
    answer = json.loads(rtcp("faults", "show", "1", "--json", "--plot", str(out)).out)
    assert answer["picture"] == str(out)
    assert "<svg" in out.read_text()


@pytest.mark.parametrize("disabled", [299, 300])
def test_a_step_counts_only_where_the_drives_are_enabled_on_both_of_its_cycles(
    rtcp: Callable[..., Any], disabled: int
) -> None:
    edited = recording()
    edited.records["flags"][disabled] = 0
    write(faults_directory(), edited)
    step = json.loads(rtcp("faults", "show", "1", "--json").out)["largest_step"]
    assert (step["joint"], step["rad"]) == ("elbow", pytest.approx(2e-4))
    edited.records["flags"][:] = 0
    write(faults_directory(), edited)
    assert json.loads(rtcp("faults", "show", "2", "--json").out)["largest_step"] is None
    assert rtcp("faults", "show", "2").code == 0


def test_a_picture_replaces_a_link_and_leaves_what_that_leads_to(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    _, path = write(faults_directory(), recording())
    precious = tmp_path / "precious"
    precious.write_text("precious")
    picture = path.with_suffix(".png")
    picture.symlink_to(precious)
    assert rtcp("faults", "show", "1").code == 0
    assert precious.read_text() == "precious"
    assert not picture.is_symlink()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert [file.name for file in path.parent.iterdir() if file.name.startswith(".") and file.suffix == ".png"] == []


def test_who_has_recorded_nothing_is_referred_to_where_the_service_records(
    rtcp: Callable[..., Any], state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = tmp_path / "service"
    monkeypatch.setattr(faults, "SERVICE_FAULTS", service)
    assert str(service) not in rtcp("faults").out
    service.mkdir()
    assert f"no fault has been recorded in {state}/faults; the service records in {service}" in rtcp("faults").out
    assert f"the service records in {service}" in rtcp("faults", "show", "1").trouble


def test_a_fault_without_a_single_cycle_is_shown(rtcp: Callable[..., Any]) -> None:
    made = recording()
    none = made.records[:0]
    _, path = write(faults_directory(), FaultRecording(replace(made.about, at=-1), none, made.schema))
    assert read(path).records["number"].shape == (0,)
    ended = rtcp("faults", "show", "1")
    assert ended.code == 0
    assert "slave 3 sent emergency" in ended.out
    assert "+0.020" in ended.out


def test_a_number_that_does_not_exist_is_answered_with_those_that_do(rtcp: Callable[..., Any]) -> None:
    assert "none has been recorded" in rtcp("faults", "show", "1").trouble
    for number in range(1, 7):
        _, path = write(faults_directory(), recording())
        if number == 4:
            path.unlink()
    ended = rtcp("faults", "show", "9")
    assert (ended.code, ended.out) == (2, "")
    assert "there is no fault 9" in ended.trouble
    assert ended.trouble.endswith("recorded: 1-3, 5-6")


def test_a_picture_of_another_kind_is_refused_before_anything_is_read(rtcp: Callable[..., Any]) -> None:
    ended = rtcp("faults", "show", "1", "--plot", "picture.txt")
    assert ended.code == 2
    assert "--plot picture.txt: the ending must be one of .png, .svg, .pdf" in ended.trouble


def test_a_picture_that_cannot_be_written_is_a_sentence(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    write(faults_directory(), recording())
    (tmp_path / "directory.png").mkdir()
    for out, why in (("none/picture.png", "No such file or directory"), ("directory.png", "Is a directory")):
        ended = rtcp("faults", "show", "1", "--plot", str(tmp_path / out))
        assert ended.code == 2
        assert f"--plot {tmp_path / out} cannot be written: {why}" in ended.trouble


@pytest.mark.parametrize("command", [(), ("show", "1")])
def test_a_state_directory_that_is_a_file_is_a_sentence(
    rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    (tmp_path / "a file").write_text("")
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path / "a file"))
    ended = rtcp("faults", *command)
    assert (ended.code, ended.out) == (5, "")
    assert f"{tmp_path / 'a file' / 'faults'}: the directory cannot be read: Not a directory" in ended.trouble


def test_two_faults_that_begin_alike_are_distinct_at_80_columns(rtcp: Callable[..., Any]) -> None:
    original = recording()
    for end in ("drive1 with statusword 0x0218", "drive2 with statusword 0x0208"):
        text = f"a long sentence about something that went wrong with the drive {end}"
        write(faults_directory(), replace(original, about=replace(original.about, what=text)))
    ended = rtcp("faults")
    output = " ".join(ended.out.split())
    assert "0x0218" in output
    assert "0x0208" in output
    assert max(len(line) for line in ended.out.splitlines()) <= 80
