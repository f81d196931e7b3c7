"""The experiments of the thesis, each on a whole platform of its own.

What a shared host takes away shows in figures of time: of those a test asks only that they are there and make sense.
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli.__main__ import main
from rtcp.cli.platform import running_platform
from rtcp.config.find import default_config
from rtcp.ipc.session import Processes, identify
from rtcp.telemetry.experiments import (
    CycleExperiment,
    DelaysExperiment,
    Experiment,
    JoystickExperiment,
    LatencyExperiment,
    PicksExperiment,
    ResourcesExperiment,
    TemperatureExperiment,
    TrackingExperiment,
)
from rtcp.telemetry.experiments.experiment import ExperimentFailed, Row, Setup, carry_out, read_result
from rtcp.telemetry.experiments.user_trials import read_trials

from .conftest import SLAVES, Platform


@pytest.fixture
def setup(platform: Platform, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Setup:
    """A setup whose platforms run in the directory of the test."""
    platform.be_patient(2000)
    for name in ("RTCP_RUNTIME_DIR", "RTCP_STATE_DIR", "RTCP_CONFIG"):
        monkeypatch.setenv(name, platform.environment[name])
    return Setup(tmp_path, running_platform, print)


def carried_out(experiment: Experiment, setup: Setup) -> dict[str, Row]:
    """Run an experiment; return the rows in its folder by their figures, and check its pictures."""
    carry_out(experiment, setup, "a test")
    result = read_result(setup.folder)
    for name in result.pictures:
        assert (setup.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "<svg" in (setup.folder / f"{name}.svg").read_text()
    return {row.figure: row for row in result.rows}


def ran(platform: Platform, name: str, tmp_path: Path) -> tuple[dict[str, Any], str]:
    """Run an experiment as a user does; return its rows and what was printed."""
    platform.be_patient(2000)
    folder = tmp_path / name
    done = platform.rtcp("experiment", name, "--out", str(folder))
    result = json.loads((folder / "result.json").read_text())
    return {row["figure"]: row for row in result["rows"]}, done.stdout


@pytest.mark.platform
@pytest.mark.long("test_a_step_settles_without_overshoot")
def test_a_step_of_1_35_rad_settles_at_0_2_rad_s_without_overshoot(platform: Platform, tmp_path: Path) -> None:
    rows, printed = ran(platform, "step", tmp_path)
    assert all(row["met"] for row in rows.values())
    assert 6.0 < rows["settling within 0.0007 rad"]["here"] < 7.5
    for edge in range(1, 5):
        assert 6.0 < rows[f"square signal, edge {edge}: settling within 0.0007 rad"]["here"] < 7.5
    assert "steady-state error" in printed
    page = platform.rtcp("report", str(tmp_path / "step"))
    assert "report.html" in page.stdout
    assert "Step of 1.35 rad" in (tmp_path / "step" / "report.html").read_text()


@pytest.mark.platform
@pytest.mark.long("test_what_is_beside_the_square_is_measured_and_drawn")
def test_the_square_is_driven_in_both_planes_within_1_mm_commanded_and_3_mm_actual(
    platform: Platform, tmp_path: Path
) -> None:
    rows, _ = ran(platform, "square", tmp_path)
    assert [row["met"] for row in rows.values() if row["met"] is not None] == [True] * 4
    for plane in ("xy", "yz"):
        assert rows[f"{plane}, 50 mm/s: elapsed time"]["here"] > 16.0
    assert rows["yz against xy, 50 mm/s: less time"]["source"] == 33.0
    assert (tmp_path / "square" / "recording-yz-50.mcap").stat().st_size > 0


@pytest.mark.platform
def test_the_delays_are_those_of_the_thesis(setup: Setup) -> None:
    rows = carried_out(DelaysExperiment(2), setup)
    assert [row.source for row in rows.values()] == [0, 820, 1660, 2500, 3320, 4160, 5020][:SLAVES]
    assert all(row.met for row in rows.values())


@pytest.mark.platform
@pytest.mark.parametrize(
    ("file", "sources"),
    [
        pytest.param(
            "one_actuator.yaml",
            (0, 880),
            marks=pytest.mark.long("test_each_setup_of_the_thesis_has_a_file_and_its_own_column"),
        ),
        pytest.param(
            "bench.yaml",
            (0, 840, 1680, 2520, 3340, 4030, 4960),
            marks=pytest.mark.long("test_each_setup_of_the_thesis_has_a_file_and_its_own_column"),
        ),
    ],
)
def test_the_setups_on_the_bench_have_the_delays_of_the_thesis(
    setup: Setup, file: str, sources: tuple[float, ...]
) -> None:
    rows = carried_out(DelaysExperiment(1), replace(setup, config=default_config().with_name(file)))
    assert tuple(row.source for row in rows.values()) == sources
    assert all(row.met for row in rows.values())


@pytest.mark.platform
@pytest.mark.timing
@pytest.mark.long("test_the_delays_are_those_of_the_thesis")
def test_the_cycle_is_the_same_from_inside_and_at_an_output_of_the_io_box(setup: Setup) -> None:
    rows = carried_out(CycleExperiment((2000.0,), 2.0), setup)
    inside, outside = (rows[f"2000 us, {side}: mean"].here for side in ("inside", "outside"))
    assert outside == pytest.approx(inside, rel=0.02)
    assert inside == pytest.approx(2000.0, rel=0.05)


@pytest.mark.platform
@pytest.mark.long("test_an_item_is_picked_and_placed_by_joystick_bytes_alone")
def test_an_item_is_picked_by_the_joystick_of_the_virtual_arm(setup: Setup) -> None:
    rows = carried_out(PicksExperiment(("shelf",)), setup)
    assert rows["shelf: distance to the item"].met
    assert rows["shelf: distance to its place"].met
    assert rows["shelf: completion time"].here > 10.0
    assert rows["highest item above ground"].here == pytest.approx(0.8, abs=0.01)


@pytest.mark.platform
@pytest.mark.long("test_an_item_is_picked_and_placed_by_joystick_bytes_alone")
def test_a_task_by_joystick_takes_longer_than_as_a_computed_motion(setup: Setup) -> None:
    rows = carried_out(JoystickExperiment(1, ("shelf",)), setup)
    assert rows["shelf: time by joystick / by trajectory"].here > 1.0
    trials = read_trials(setup.folder)
    assert [(trial.task, trial.way, trial.succeeded) for trial in trials] == [
        ("shelf", "joystick", True),
        ("shelf", "trajectory", True),
    ]
    assert all((setup.folder / trial.recording).stat().st_size > 0 for trial in trials)


@pytest.mark.platform
def test_the_form_of_a_trial_is_written_beside_its_recording(enabled: Platform, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    arguments = ("user-trial", "--participant", "P01", "--task", "drink", "--by", "joystick", "--out", str(folder))
    done = enabled.rtcp(*arguments, answers="\n\nmaybe\ny\nspilled a little\n")
    [trial] = read_trials(folder)
    assert (trial.participant, trial.task, trial.way, trial.number) == ("P01", "drink", "joystick", 1)
    assert (trial.succeeded, trial.remarks) == (True, "spilled a little")
    assert (folder / trial.recording).stat().st_size > 0
    assert "done" in done.stdout


@pytest.mark.platform
@pytest.mark.long("test_the_sine_fit_finds_the_latency_at_30_hz_within_0_2_ms")
def test_a_streamed_sine_is_followed_with_a_latency_far_below_the_sources(setup: Setup) -> None:
    rows = carried_out(LatencyExperiment((30.0,), 3), setup)
    for sender in ("Python API", "socket"):
        assert 0.0 < rows[f"{sender}, 30 Hz: latency to the motion"].here < 200.0
        assert rows[f"{sender}, 30 Hz: amplitude, actual / command"].here == pytest.approx(1.0, abs=0.05)
    assert rows["ring: p50"].here < 2 * 2000.0
    assert any("other limits" in note for note in read_result(setup.folder).notes)


@pytest.mark.platform
@pytest.mark.long("test_a_sine_at_30_hz_is_late_by_what_was_measured_on_the_real_one")
def test_by_rapid_the_sine_is_nearly_half_a_second_behind_and_reported_some_ms_late(setup: Setup) -> None:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")
    by_rapid = replace(setup, config=default_config().with_name("abb_irb120_rapid.yaml"))
    rows = carried_out(LatencyExperiment((30.0, 250.0), 3), by_rapid)
    assert not any("250 Hz" in figure for figure in rows)
    assert 300.0 < rows["Python API, 30 Hz: latency to the motion"].here < 700.0
    assert rows["Python API, 30 Hz: amplitude, actual / command"].here == pytest.approx(1.0, abs=0.1)
    assert abs(rows["Python API, 30 Hz: reported behind the accelerometer"].here) < 30.0


@pytest.mark.platform
@pytest.mark.long("test_inertia_and_friction_come_back_from_the_torque_that_they_take")
def test_inertia_and_friction_of_a_joint_come_back_within_5_percent(setup: Setup) -> None:
    rows = carried_out(TrackingExperiment((0,), (0.5, 1.0)), setup)
    assert [rows[f"joint1: {key}"].met for key in ("inertia", "coulomb", "viscous")] == [True] * 3
    assert rows["joint1, 0.5 Hz: gain"].here == pytest.approx(1.0, abs=0.01)


@pytest.mark.platform
@pytest.mark.long("test_resources_are_those_of_the_process")
def test_each_process_has_its_share_of_a_core_and_its_memory(setup: Setup) -> None:
    rows = carried_out(ResourcesExperiment(3.0), setup)
    for activity in ("holding", "moving", "jogging", "recording"):
        assert rows[f"{activity}: loop"].here > 1.0
    assert rows["recording: recorder"].here > 0.0
    assert rows["machine, before: CPU"].here >= 0.0
    # The frames of the loop at 4 ms: 250 in a second, some 200 bytes each.
    assert rows["machine, holding: network, sent"].here > 10.0
    assert rows["loop: resident"].here > 20.0


def test_a_virtual_rod_has_the_temperature_that_its_heater_estimates(tmp_path: Path) -> None:
    setup = Setup(tmp_path, running_platform, print)
    rows = carried_out(TemperatureExperiment((200.0,), hold_s=3.0), setup)
    # The ends of the rod are not steady after such a short hold.
    assert -20.0 < rows["200 C: true minus target"].here < 0.0
    assert abs(rows["200 C: estimated minus true"].here) < 20.0
    assert rows["mean absolute error"].source == 10.0
    with pytest.raises(ExperimentFailed, match="no process of kind shape_setting"):
        carried_out(TemperatureExperiment(), replace(setup, config=default_config()))
    with pytest.raises(ExperimentFailed, match="thermocouple"):
        carried_out(TemperatureExperiment(), replace(setup, bus="eth0"))


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["experiment", "flight"], 2, "there is no experiment flight: allowed are cycle, delays"),
        (["experiment", "step", "--out", "/proc/nowhere"], 2, "/proc/nowhere cannot be made"),
        (["report", "/proc"], 2, "/proc: there are no results of experiments"),
    ],
)
def test_what_cannot_be_carried_out_or_reported_is_one_message(
    arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == code
    assert said in (complaint := capsys.readouterr().err)
    assert len(complaint.splitlines()) == 1


def test_an_experiment_is_refused_while_a_platform_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path))
    tmp_path.chmod(0o700)
    Processes(loop=identify(os.getpid())).write(tmp_path)
    assert main(["experiment", "step", "--out", str(tmp_path / "x")]) == 3
    assert "a platform runs already" in capsys.readouterr().err


def test_a_real_arm_keeps_its_limits(setup: Setup) -> None:
    real = replace(setup, bus="eth0")
    assert real.with_limits(0, velocity=99.0) is real
