"""Poses of the demo, and its figures at the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.cli.demo import POSES, REACH, figures, pose
from rtcp.cli.output import show
from rtcp.config import find_config, load

JOINTS = load(find_config()).joints


@given(
    home=st.tuples(*(st.floats(joint.position.min, joint.position.max) for joint in JOINTS)),
    directions=st.sampled_from(POSES),
)
def test_every_pose_is_inside_the_limits_and_not_far(home: tuple[float, ...], directions: tuple[int, ...]) -> None:
    target = pose(home, JOINTS, directions)
    for start, value, joint in zip(home, target, JOINTS, strict=True):
        assert joint.position.min < value < joint.position.max
        assert abs(value - start) <= max(REACH, 0.05 * (joint.position.max - joint.position.min)) + 1e-12


def test_from_the_middle_every_joint_moves() -> None:
    assert all(pose([0.0] * len(JOINTS), JOINTS, directions) == [REACH * sign for sign in directions]
               for directions in POSES)  # fmt: skip


def test_the_table_shows_every_figure(platform: Any, capsys: pytest.CaptureFixture[str]) -> None:
    platform.status["dc"] |= {"filtered_us": {"p50": 1, "p99": 7.25, "max": 9}, "offset_us": {"p99": 44.0}}
    show(figures(platform.status, started_s=1.234, mean_ns=500_010.0))
    output = capsys.readouterr().out
    for figure in ("holding", "500.000 us", "500.010 us (+0.0020 %)", "123456, 2", "24.0 / 61.0 / 105.5 us",
                   "locked, filtered p99 7.2 us, raw p99 44.0 us", "1.50 s", "FIFO 80"):  # fmt: skip
        assert figure in output
    assert max(len(line) for line in output.splitlines()) <= 80


def test_a_demo_of_a_wrong_configuration_is_exit_code_2(rtcp: Callable[..., Any]) -> None:
    ended = rtcp("demo", "--config", "none.yaml")
    assert ended.code == 2
    assert "none.yaml" in ended.trouble
