"""The evaluation of the latency experiment, on logs and samples with known lags."""

from __future__ import annotations

from contextlib import nullcontext
from math import pi
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from rtcp.api import Robot, RtcpError, State
from rtcp.config.find import default_config
from rtcp.telemetry.experiments import latency
from rtcp.telemetry.experiments.experiment import ExperimentFailed, Row, Setup
from rtcp.telemetry.experiments.latency import LatencyExperiment, lag_of_log, read_log
from tests.control.test_channels import config as with_valves

Array = npt.NDArray[np.float64]
W = pi  # a period of 2 s


@pytest.fixture
def setup(tmp_path: Path) -> Setup:
    return Setup(tmp_path, lambda options: nullcontext(), lambda text: None, default_config())


def write(path: Path, header: str, *columns: Array) -> None:
    np.savetxt(path, np.column_stack(columns), "%.6f", ",", header=header, comments="")


def test_the_log_of_the_controller_itself_gives_its_lag(tmp_path: Path) -> None:
    t = np.arange(360) / 30 + np.random.default_rng(3).uniform(0.0, 0.01, 360)
    moved = 11.25 * (1.0 - np.cos(W * (t - 0.422)))
    write(tmp_path / "latency.csv", "time_s,command,actual", t, 11.25 * (1.0 - np.cos(W * t)), moved)
    lag, error = lag_of_log(tmp_path / "latency.csv")
    assert lag == pytest.approx(0.422, abs=1e-3)
    assert error < 1e-3


def test_the_header_of_the_rapid_module_is_what_is_read() -> None:
    text = (default_config().parent.parent / "abb" / "rapid" / "latency.mod").read_text()
    assert 'Write file, "time_s,command,actual";' in text


def test_a_log_has_the_columns_of_its_joints(tmp_path: Path) -> None:
    path = tmp_path / "joint_states.csv"
    path.write_text("time_s,joint1,joint2\n0.000000,0.5,1\n0.010000,0.6,2\n")
    t, q = read_log(path, "joint2")
    assert (t.tolist(), q.tolist()) == ([0.0, 0.01], [1.0, 2.0])
    for text, column in ((path.read_text(), "joint3"), ("time_s\n", "time_s"), ("", "joint1")):
        path.write_text(text)
        with pytest.raises(ExperimentFailed, match="needed is"):
            read_log(path, column)


@pytest.mark.parametrize("lag_s", [-0.005, 0.012, 0.3])
def test_what_is_reported_is_compared_with_the_accelerometer_and_its_samples_are_kept(
    setup: Setup, lag_s: float
) -> None:
    random = np.random.default_rng(5)
    t, fine = np.arange(0.0, 12.0, 0.033), np.arange(0.0, 12.0, 0.004)
    series = {"joint_states": (t, 0.2 * (1.0 - np.cos(W * (t - 0.1 - lag_s))))}
    samples = 0.4 * 0.2 * W**2 * np.cos(W * (fine - 0.1)) + 0.3 * random.standard_normal(len(fine))
    sines = latency._fitted(series, 2.0, 12.0)
    window = (2.0, 12.0)
    rows = latency._beside_accelerometer(
        setup, "x", "sine", series, sines, "joint_states", list(zip(fine, samples, strict=True)), window
    )
    latency._draw(setup, "x", "sine", series, sines, window)
    lag, error = rows
    assert lag.here == pytest.approx(1e3 * lag_s, abs=5 * error.here)
    assert error.here < 5.0
    assert setup.pictures == ["latency-x-accelerometer", "latency-x"]
    assert all((setup.folder / f"{name}.png").stat().st_size > 5000 for name in setup.pictures)
    kept = np.loadtxt(setup.folder / "accelerometer-x.csv", delimiter=",", skiprows=1)
    assert kept == pytest.approx(np.column_stack((fine, samples)), rel=1e-4, abs=1e-5)


def test_without_an_accelerometer_there_is_neither_a_row_nor_a_picture(setup: Setup) -> None:
    assert latency._beside_accelerometer(setup, "x", "sine", {}, {}, "actual", [], (0.0, 1.0)) == []
    assert setup.pictures == []


def test_the_accelerometer_is_an_input_channel_of_a_slave() -> None:
    config = with_valves()
    LatencyExperiment(accelerometer="valves.pressure")._check_accelerometer(config)
    for text in ("valves.current", "valves", "tank.level"):
        with pytest.raises(ExperimentFailed, match="is no input channel"):
            LatencyExperiment(accelerometer=text)._check_accelerometer(config)
    assert LatencyExperiment(accelerometer="valves.pressure")._field() == ("valves_pressure",)


class Arm:
    """A robot that rests, and goes back to its begin."""

    def __init__(self, state: State) -> None:
        self.state = state
        self.moves: list[list[float]] = []

    def status(self) -> Any:
        return SimpleNamespace(positions=(0.1, 0.2))

    def move_joints(self, q: list[float], speed: float) -> None:
        self.moves.append(q)


@pytest.mark.parametrize(("failures", "is_done"), [(0, True), (2, True), (latency._TRIES, False)])
def test_a_stream_that_the_host_held_up_begins_anew_some_times(
    setup: Setup, monkeypatch: pytest.MonkeyPatch, failures: int, is_done: bool
) -> None:
    tries: list[int] = []

    def stream(*_: object) -> list[Row]:
        tries.append(1)
        if len(tries) <= failures:
            raise RtcpError("fault", "the stream has ended", "stream_ended")
        return [Row("rate", "Hz", 30.0)]

    monkeypatch.setattr(LatencyExperiment, "_stream", stream)
    arm = Arm(State.HOLDING)

    def carried_out() -> list[Row]:
        return LatencyExperiment()._repeated(setup, cast(Robot, arm), "socket", 30.0, 0.1)

    if is_done:
        assert [row.here for row in carried_out()] == [30.0]
    else:
        with pytest.raises(RtcpError):
            carried_out()
    repeated = min(failures, latency._TRIES - 1)
    assert arm.moves == [[0.1, 0.2]] * repeated
    assert setup.notes == ["socket, 30 Hz is repeated: the stream has ended"] * repeated


def test_a_stream_that_ended_in_a_fault_is_not_repeated(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    def stream(*_: object) -> list[Row]:
        raise RtcpError("fault", "a drive has a fault", "drive_fault")

    monkeypatch.setattr(LatencyExperiment, "_stream", stream)
    arm = Arm(State.FAULT)
    with pytest.raises(RtcpError, match="a drive"):
        LatencyExperiment()._repeated(setup, cast(Robot, arm), "socket", 30.0, 0.1)
    assert arm.moves == []
