"""Recorded motions as trajectories: near the recording, few points, accepted by the planner."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ruckig import InputParameter, Ruckig, Trajectory

from rtcp.config.model import Point
from rtcp.ipc.recording import RecordingError
from rtcp.ipc.schema import FLAG_ENABLED
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import cubic, value
from rtcp.motion.planning.plan import PlanTooFast
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.telemetry import replay
from rtcp.telemetry.reading import Recorded, read
from rtcp.telemetry.replay import deviation as smoothing_deviation
from rtcp.telemetry.replay import trajectory

from .test_reading import CONFIG, PERIOD_NS, csv, cycles, mcap

LIMITS = Limits(CONFIG)
TARGETS = ([0.1, -0.08, 0.12, 0.05, -0.1, 0.25], [0.0] * 6)


def moved(count_at_rest: int = 400, targets: Sequence[Sequence[float]] = TARGETS) -> Any:
    """Cycle records of moves as fast as the joints may, with rest between, as a controller sends them."""
    rows = [np.zeros((count_at_rest, 6))]
    at: Sequence[float] = [0.0] * 6
    for target in targets:
        given = InputParameter(6)
        given.current_position, given.target_position = at, target
        given.max_velocity, given.max_acceleration = LIMITS.velocity, LIMITS.acceleration
        given.max_jerk = LIMITS.jerk
        made = Trajectory(6)
        Ruckig(6).calculate(given, made)
        times = np.arange(0.0, made.duration, PERIOD_NS * 1e-9)
        rows += [np.array([made.at_time(t)[0] for t in times]), np.tile(target, (count_at_rest, 1))]
        at = target
    q = np.concatenate(rows)
    records = cycles(len(q))
    records["sent_position"] = q
    # The instants of real cycles are not those of the grid.
    records["time_ns"] += np.random.default_rng(2).integers(-30_000, 30_000, len(q))
    return records


def deviation(points: list[dict[str, Any]], recorded: Recorded, scale: float) -> float:
    """Largest distance of the trajectory's cubics from the recorded positions, rad."""
    q = recorded.column("sent_position")
    first = np.flatnonzero(np.abs(np.diff(q, axis=0)).max(axis=1))[0] - 1
    times = (recorded.seconds - recorded.seconds[first]) / scale
    worst, at = 0.0, 0
    for t, wanted in zip(times, q, strict=True):
        if not 0.0 <= t <= points[-1]["t"]:
            continue
        while t > points[at + 1]["t"]:
            at += 1
        before, after = points[at], points[at + 1]
        length = after["t"] - before["t"]
        for joint in range(6):
            piece = cubic(before["q"][joint], before["v"][joint], after["q"][joint], after["v"][joint], length)
            worst = max(worst, abs(value(piece, (t - before["t"]) / length) - wanted[joint]))
    return worst


def test_setpoints_that_were_sent_again_without_an_answer_are_no_rest_in_the_motion(tmp_path: Path) -> None:
    whole = moved()
    chance = np.random.default_rng(4)
    again = np.ones(len(whole), int)
    fast = np.flatnonzero(np.abs(np.diff(whole["sent_position"], axis=0)).max(axis=1) > 5e-5)
    again[chance.choice(fast, 80)] += chance.integers(1, 30, 80)
    standing = cycles(int(again.sum()))
    standing["sent_position"] = np.repeat(whole["sent_position"], again, axis=0)
    standing["flags"] = FLAG_ENABLED
    points = trajectory(read(mcap(tmp_path / "a.mcap", standing)), 0.9)
    plan_trajectory([Point(point["t"], point["q"], point["v"]) for point in points], LIMITS, points[0]["q"])
    assert deviation(points, read(mcap(tmp_path / "b.mcap", whole)), 0.9) < 1e-3


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_the_trajectory_deviates_by_less_than_1_mrad_with_few_points(tmp_path: Path, scale: float) -> None:
    recorded = read(mcap(tmp_path / "a.mcap", moved()), ["*_position"])
    points = trajectory(recorded, scale)
    assert len(points) < len(recorded.records) / 50
    assert deviation(points, recorded, scale) < 1e-3
    assert points[0]["v"] == points[-1]["v"] == [0.0] * 6
    assert points[-1]["q"] == pytest.approx(TARGETS[-1], abs=1e-6)


def test_a_motion_that_turns_at_the_end_of_a_range_stays_within_it(tmp_path: Path) -> None:
    """The first stop of joint 3 is short of its end; its last there is followed by a motion of the others alone."""
    top = LIMITS.high[2]
    targets = ([0.5, -0.3, 0.4, 0.0, -0.2, 1.0], [0.0, 0.2, top, 0.0, 0.6, 0.0], [0.3, 0.2, top, 0.0, 0.6, 0.0])
    points = trajectory(read(mcap(tmp_path / "a.mcap", moved(targets=targets)), ["*_position"]), 0.9)
    plan_trajectory([Point(point["t"], point["q"], point["v"]) for point in points], LIMITS, points[0]["q"])


def test_csv_is_replayed_as_mcap_is(tmp_path: Path) -> None:
    recorded = read(csv(tmp_path / "a.csv", moved()), ["*_position"])
    assert deviation(trajectory(recorded), recorded, 1.0) < 1e-3


def test_where_nothing_moves_or_too_much_there_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    still = cycles(500)
    still["sent_position"] = 0.25
    with pytest.raises(RecordingError, match="nothing moves in it") as raised:
        trajectory(read(mcap(tmp_path / "a.mcap", still)))
    assert raised.value.kind == "empty"
    monkeypatch.setattr(replay, "MOST_POINTS", 20)
    restless = cycles(1000)
    restless["flags"] = FLAG_ENABLED
    restless["sent_position"] = np.random.default_rng(1).normal(size=(1000, 6))
    with pytest.raises(RecordingError, match="choose a part by --start and --end") as raised:
        trajectory(read(mcap(tmp_path / "b.mcap", restless)))
    assert raised.value.kind == "long"


def test_a_motion_with_a_gap_or_without_torque_is_not_replayed(tmp_path: Path) -> None:
    records = moved()
    middle = len(records) // 2
    with pytest.raises(RecordingError, match="cycles are missing at 1 places") as raised:
        trajectory(read(mcap(tmp_path / "gap.mcap", np.delete(records, slice(middle, middle + 9))), ["*_position"]))
    assert raised.value.kind == "gap"
    records["flags"] = FLAG_ENABLED
    assert trajectory(read(mcap(tmp_path / "enabled.mcap", records), ["*_position", "flags"]))
    records["flags"][middle] = 0
    with pytest.raises(RecordingError, match="the drives were not enabled") as raised:
        trajectory(read(mcap(tmp_path / "disabled.mcap", records), ["*_position", "flags"]))
    assert raised.value.kind == "disabled"


def guided() -> Any:
    """Cycle records of a hand: a slow motion with a tremor of 8 Hz, a rest of 3 s, and on."""
    t = np.arange(0.0, 2.0, PERIOD_NS * 1e-9)
    progress = 0.5 * (1.0 - np.cos(np.pi * t / 2.0))
    tremor = 0.006 * np.sin(2 * np.pi * 8.0 * t) * np.sin(np.pi * t / 2.0)
    there = np.outer(progress + tremor, [0.2, -0.1, 0.15, 0.05, 0.0, 0.1])
    rest = np.tile(there[-1], (round(3.0 / (PERIOD_NS * 1e-9)), 1))
    q = np.concatenate([there, rest, there[-1] + there, np.tile(2 * there[-1], (200, 1))])
    records = cycles(len(q))
    records["sent_position"] = q
    return records


def plan(points: list[dict[str, Any]]) -> None:
    plan_trajectory([Point(point["t"], point["q"], point["v"]) for point in points], LIMITS, points[0]["q"])


def test_a_tremor_too_fast_for_the_joints_is_smoothed_away_near_the_recorded_motion(tmp_path: Path) -> None:
    recorded = read(mcap(tmp_path / "a.mcap", guided()), ["*_position"])
    q = recorded.column("sent_position")
    with pytest.raises(PlanTooFast):
        plan(trajectory(recorded))
    smooth = trajectory(recorded, smooth_hz=1.5)
    plan(smooth)
    assert 0.001 < smoothing_deviation(recorded, 1.5) < 0.01
    positions = np.array([point["q"] for point in smooth])
    assert (positions >= q.min(axis=0) - 1e-6).all()
    assert (positions <= q.max(axis=0) + 1e-6).all()
    assert smooth[0]["v"] == smooth[-1]["v"] == [0.0] * 6
    assert smooth[-1]["q"] == pytest.approx(q[-1], abs=1e-3)


def test_a_rest_in_the_motion_is_shortened(tmp_path: Path) -> None:
    recorded = read(mcap(tmp_path / "a.mcap", guided()), ["*_position"])
    whole, short = (trajectory(recorded, smooth_hz=1.5, rest_s=rest) for rest in (None, 0.5))
    # The slow begin and end of each half count to the rest.
    assert 2.5 < whole[-1]["t"] - short[-1]["t"] < 4.0
    assert short[-1]["q"] == pytest.approx(whole[-1]["q"], abs=1e-3)
