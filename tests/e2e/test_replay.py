"""`rtcp replay` on a whole platform: the wire carries the recorded motion again, or the arm does not move."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtcp.telemetry.reading import Recorded, read

from .conftest import Platform

pytestmark = pytest.mark.alone


def record(platform: Platform, name: str, *command: str, check: int = 0) -> Recorded:
    """Record what a command does."""
    out = platform.directory / name
    platform.rtcp("record", "start", "--out", str(out))
    platform.rtcp(*command, check=check)
    platform.rtcp("record", "stop")
    return read(out, ["sent_position", "state"])


def moving(recorded: Recorded) -> tuple[np.ndarray, np.ndarray]:  # type: ignore[type-arg]
    """Instants, s from the first step, and sent positions of what moves."""
    q = recorded.column("sent_position")
    steps = np.flatnonzero(np.abs(np.diff(q, axis=0)).max(axis=1) > 0)
    span = slice(steps[0], steps[-1] + 2)
    return recorded.seconds[span] - recorded.seconds[steps[0]], q[span]


def test_the_sent_positions_of_a_replay_are_the_recorded_ones_at_the_scaled_instants(enabled: Platform) -> None:
    first = record(enabled, "first.mcap", "move", "0.3", "-0.2", "0.25", "0.1", "0", "0.4")
    enabled.call("move_joints", q=[0.0] * 6)
    path = Path(first.path)
    again = record(enabled, "again.mcap", "replay", str(path), "--speed", "0.8")
    (wanted_t, wanted), (found_t, found) = moving(first), moving(again)
    for joint in range(6):
        # Where a host takes cycles away, the one or the other stands still for a moment: the way is compared, not time.
        way = np.interp(wanted[:, 0], found[:, 0], found[:, joint])
        assert np.abs(way - wanted[:, joint]).max() < 1e-3
    assert found_t[-1] == pytest.approx(wanted_t[-1] / 0.8, rel=0.1)


def test_a_motion_that_the_planner_refuses_moves_nothing_and_says_what_to_do(enabled: Platform) -> None:
    first = record(enabled, "fast.mcap", "move", "0.3", "0", "0", "0", "0", "0")
    refused = enabled.rtcp("replay", str(first.path), "--speed", "2", check=3)
    assert "allowed is at most" in refused.stderr
    assert "nothing has moved; a motion recorded at its limits passes with --speed 1.8" in refused.stderr
    assert enabled.status()["joints"]["commanded_position"][0] == pytest.approx(0.3)
    enabled.call("move_joints", q=[0.0] * 6)
