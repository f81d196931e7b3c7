"""`rtcp replay` on a whole platform: the wire carries the recorded motion again, or the arm does not move."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtcp.telemetry.reading import Recorded, read

from .conftest import Platform

pytestmark = pytest.mark.platform


def record(platform: Platform, name: str, *command: str, check: int = 0) -> Recorded:
    """Record what a command does, from position 0."""
    platform.call("move_joints", q=[0.0] * 6)
    out = platform.directory / name
    out.unlink(missing_ok=True)  # of a test that is run again
    platform.call("record_start", out=str(out))
    platform.rtcp(*command, check=check)
    platform.call("record_stop")
    return read(out, ["sent_position", "state"])


def moving(recorded: Recorded) -> Any:
    """Sent positions, cycle by cycle, from 1 mrad after the beginning to 1 mrad before the end."""
    q = recorded.column("sent_position")
    q = q[np.append(True, np.diff(q, axis=0).any(axis=1))]  # without cycles that a loaded host sent again
    left, there = (np.flatnonzero(np.abs(q - end).max(axis=1) > 1e-3) for end in (q[0], q[-1]))
    return q[left[0] : there[-1] + 1]


def test_the_sent_positions_of_a_replay_are_the_recorded_ones_at_the_scaled_speed_and_a_refused_one_moves_nothing(
    enabled: Platform,
) -> None:
    first = record(enabled, "first.mcap", "move", "0.2", "-0.1", "0.15", "0.1", "0", "0.2")
    again = record(enabled, "again.mcap", "replay", str(first.path), "--speed", "0.8")
    wanted, replayed = moving(first), moving(again)
    for joint in range(6):
        then = np.interp(np.arange(len(wanted)) / 0.8, np.arange(len(replayed)), replayed[:, joint])
        assert np.abs(then - wanted[:, joint]).max() < 6e-3  # of which 4 mrad are the motion of one cycle
    assert len(replayed) == pytest.approx(len(wanted) / 0.8, rel=0.05)
    enabled.call("move_joints", q=[0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
    refused = enabled.rtcp("replay", str(first.path), "--speed", "3", check=3)
    assert "allowed is at most" in refused.stderr
    assert "nothing has moved; a motion recorded at its limits passes with --speed" in refused.stderr
    assert enabled.status()["joints"]["commanded_position"][0] == pytest.approx(0.1)
