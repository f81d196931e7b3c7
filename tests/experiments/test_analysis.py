"""The computations of the experiments, on signals with known results."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import nullcontext
from math import pi, tau
from pathlib import Path

import numpy as np
import numpy.typing as npt
import psutil
import pytest

from rtcp.telemetry.experiments.experiment import (
    Experiment,
    ExperimentFailed,
    Result,
    Row,
    Setup,
    carry_out,
    read_result,
)
from rtcp.telemetry.experiments.latency import behind, fit_sine
from rtcp.telemetry.experiments.motions import respond
from rtcp.telemetry.experiments.resources import MachineMeter, traffic
from rtcp.telemetry.experiments.timing import spread
from rtcp.telemetry.experiments.tracking import identify, sine
from rtcp.telemetry.report import page

PERIOD_S = 2.0


@pytest.mark.parametrize("latency_s", [0.0, 0.0015, 0.033, 0.455, 0.9])
@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-3])
def test_the_sine_fit_finds_the_latency_at_30_hz_within_0_2_ms(latency_s: float, noise: float) -> None:
    random = np.random.default_rng(7)
    t = 1234.5 + np.arange(0.0, 10.0, 1 / 30)
    finer = 1234.5 + np.arange(0.0, 10.0, 1 / 2000)
    command = fit_sine(t, 0.3 + pi / 16 * np.sin(tau * t / PERIOD_S + 0.4), PERIOD_S, 1239.5)
    actual = 0.3 + pi / 16 * np.sin(tau * (finer - latency_s) / PERIOD_S + 0.4)
    feedback = fit_sine(finer, actual + noise * random.standard_normal(len(finer)), PERIOD_S, 1239.5)
    delay, error = behind(feedback, command)
    assert delay == pytest.approx(latency_s, abs=0.2e-3)
    assert abs(delay - latency_s) <= 5 * error + 1e-9
    assert feedback.amplitude == pytest.approx(pi / 16, rel=1e-3)
    assert feedback.period_s == pytest.approx(PERIOD_S, rel=1e-4)


def test_noise_of_30_hz_samples_themselves_still_gives_the_latency_within_its_standard_error() -> None:
    random = np.random.default_rng(1)
    t = np.arange(0.0, 10.0, 1 / 30)
    misses = []
    for _ in range(100):
        command = fit_sine(t, np.sin(tau * t / PERIOD_S), PERIOD_S, 5.0)
        noisy = np.sin(tau * (t - 0.1) / PERIOD_S) + 0.01 * random.standard_normal(len(t))
        feedback = fit_sine(t, noisy, PERIOD_S, 5.0)
        delay, error = behind(feedback, command)
        misses.append((delay - 0.1) / error)
    assert np.std(misses) == pytest.approx(1.0, abs=0.3)


def test_mean_error_and_average_deviation_are_those_of_the_thesis() -> None:
    mean, percent, deviation = spread(np.array([450.0, 470.0, 460.0, 480.0]), 500.0)
    assert (mean, percent, deviation) == pytest.approx((465.0, 7.0, 10.0))


def test_a_sine_begins_and_ends_at_rest_and_its_velocities_are_those_of_its_positions() -> None:
    t, q, v, a = np.array(list(sine(0.5, 0.2))).T
    assert (q[0], v[0], q[-1], v[-1]) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=1e-8)
    assert np.gradient(q, t)[1:-1] == pytest.approx(v[1:-1], abs=1e-2)
    assert np.gradient(v, t)[1:-1] == pytest.approx(a[1:-1], abs=3e-2)


def test_inertia_and_friction_come_back_from_the_torque_that_they_take() -> None:
    h = 0.0005
    t = np.arange(0.0, 8.0, h)
    q = 0.3 * (1 - np.cos(tau * 0.5 * t)) + 0.02 * (1 - np.cos(tau * 2 * t))
    v, acceleration = np.gradient(q, h), np.gradient(np.gradient(q, h), h)
    torque = 3.0 * acceleration + 2.0 * np.sign(v) + 1.5 * v - 19.6 * np.sin(q)
    torque[(t > 2.4) & (t < 2.5)] += 5.0  # what a stall leaves behind
    kept = np.arange(len(t)) % 50 != 3  # some cycles are missing
    identified = identify(*(np.round(values[kept], 4) for values in (t, torque, v, q)))
    assert (identified.inertia, identified.coulomb, identified.viscous) == pytest.approx((3.0, 2.0, 1.5), rel=0.01)
    assert identified.gravity == pytest.approx((19.6, 0.0), abs=0.1)


def test_a_joint_that_stands_is_not_identified() -> None:
    with pytest.raises(ExperimentFailed, match="hardly moved"):
        identify(np.arange(1000, dtype=np.float64) * 0.0005, *np.zeros((3, 1000)))


@pytest.mark.parametrize(
    ("row", "met"),
    [
        (Row("a", "s", 1.0), None),
        (Row("a", "s", 1.0, most=1.0), True),
        (Row("a", "s", 1.1, most=1.0), False),
        (Row("a", "s", 0.9, least=1.0), False),
        (Row("a", "s", float("nan"), most=1.0), False),
    ],
)
def test_a_row_is_met_between_its_bounds(row: Row, met: bool | None) -> None:
    assert row.met is met


def result(folder: Path, here: float, figure: str = "settling") -> Result:
    folder.mkdir(parents=True)
    row = Row(figure, "s", here, "about 6", most=7.5)
    began = "2026-11-22T20:00:00+00:00"
    made = Result("step", "A <step>", "rtcp experiment step", began, 3.0, {"arm": "a"}, (row,), ("p",))
    made.write(folder)
    (folder / "p.png").write_bytes(b"\x89PNG picture")
    return made


def test_a_result_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    made = result(tmp_path / "step", 6.1)
    assert read_result(tmp_path / "step") == made
    assert json.loads((tmp_path / "step" / "result.json").read_text())["rows"][0]["met"] is True


def test_a_report_is_one_file_with_figures_verdicts_and_pictures_of_one_or_two_folders(tmp_path: Path) -> None:
    result(tmp_path / "a" / "step", 6.1)
    result(tmp_path / "b" / "step", 8.0)
    single, both = page([tmp_path / "a"]), page([tmp_path / "a", tmp_path / "b"])
    assert "A &lt;step&gt;" in single
    assert "about 6" in single
    assert '<td class="met">met</td>' in single
    assert "data:image/png;base64," in single
    assert "http" not in single
    assert '<td class="missed">missed</td>' in both
    assert both.count("<img") == 2


def test_what_failed_or_could_not_be_measured_is_in_result_and_report_as_a_miss(tmp_path: Path) -> None:
    class Failing(Experiment):
        name, title = "failing", "An experiment that fails"

        def run(self, setup: Setup) -> list[Row]:
            raise ExperimentFailed("the arm has no geometry")

    with pytest.raises(ExperimentFailed, match="no geometry"):
        carry_out(Failing(), Setup(tmp_path, nullcontext, print), "rtcp experiment failing")
    result = read_result(tmp_path)
    assert (result.met, result.notes) == (False, ("the arm has no geometry",))
    assert "not measured" in page([tmp_path])
    assert "the arm has no geometry" in page([tmp_path])


@pytest.mark.parametrize("content", [None, b"", b"{}", b"[1]", b'{"rows": 3}', b'{"rows": [1]}', b"\xff\xfe"])
def test_a_folder_without_a_result_is_one_message(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "result.json").write_bytes(content)
    with pytest.raises(ExperimentFailed, match="result"):
        page([tmp_path])


def test_the_rows_before_a_failure_stay_in_the_result(tmp_path: Path) -> None:
    class FailingLater(Experiment):
        name, title = "later", "An experiment that fails in its second part"

        def run(self, setup: Setup) -> Iterator[Row]:
            yield Row("xy: deviation", "mm", 0.1, most=1.0)
            raise ExperimentFailed("the recorder has ended")

    with pytest.raises(ExperimentFailed, match="recorder"):
        carry_out(FailingLater(), Setup(tmp_path, nullcontext, print), "rtcp experiment later")
    result = read_result(tmp_path)
    assert [(row.figure, row.met) for row in result.rows] == [("xy: deviation", True), ("carried out", False)]


PERIOD = 0.0005


def approach(begin: float, goal: float, beyond: float = 0.0, error: float = 0.0) -> npt.NDArray[np.float64]:
    """A joint at 0.2 rad/s from begin to goal, then `beyond` the goal for 0.1 s, then at rest with an error."""
    way = np.arange(0.0, abs(goal - begin), 0.2 * PERIOD) * np.sign(goal - begin) + begin
    after = np.sign(goal - begin) * np.array([beyond] * 200 + [error] * 2000)
    return np.concatenate([way, goal + after])


@pytest.mark.parametrize(("begin", "goal"), [(0.0, 1.35), (1.35, 0.0), (0.0, -1.35)])
def test_a_step_settles_overshoots_and_rests_as_it_was_made(begin: float, goal: float) -> None:
    response = respond(approach(begin, goal, 0.01, 0.0005), begin, goal, PERIOD)
    assert response.settled_s == pytest.approx(1.35 / 0.2 + 0.1, abs=0.01)
    assert response.overshoot == pytest.approx(0.01)
    assert response.error == pytest.approx(0.0005)
    with pytest.raises(ExperimentFailed, match="did not settle"):
        respond(approach(begin, goal, 0.0, 0.001), begin, goal, PERIOD)


def test_the_machines_load_is_that_of_the_time_between() -> None:
    meter = MachineMeter()
    begun = time.process_time()
    while time.process_time() - begun < 0.3:
        sum(range(10_000))
    load = meter.read()
    assert 0.0 < load.cpu_percent <= 100.0
    assert load.memory_mb * 1e6 > psutil.Process().memory_info().rss
    assert load.sent_kb_s >= 0.0


def test_the_machines_network_is_that_of_the_host_and_of_the_namespace_of_the_virtual_bus() -> None:
    table = "Inter-|   Receive |  Transmit\n face |bytes packets|bytes packets\n"
    line = "{}: {} 7 0 0 0 0 0 0 {} 7 0 0 0 0 0 0\n"
    host = table + line.format("  lo", 900, 900) + line.format("eth0", 100, 2500) + line.format("eth1", 20, 30)
    bus = table + line.format("  lo", 700, 700) + line.format("ecat0", 3, 4)
    assert traffic(host) == (2530, 120)
    assert traffic(host, bus) == (2534, 123)
    assert traffic(host, host) == (2530, 120)  # a real bus: the loop is in the namespace of the host


def test_the_machines_network_contains_that_of_the_host_while_the_platform_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    opened: list[str] = []

    def read_text(path: Path) -> str:
        opened.append(str(path))
        return "\n\n"

    monkeypatch.setattr(Path, "read_text", read_text)
    MachineMeter()
    MachineMeter(42)
    assert opened == ["/proc/self/net/dev", "/proc/self/net/dev", "/proc/42/net/dev"]
