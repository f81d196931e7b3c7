"""Hand guiding on a whole platform: a hand pushes the virtual arm, and the motion is replayed, smoothed."""

from __future__ import annotations

import re
import signal
from typing import Any

import numpy as np
import pytest

from rtcp.telemetry.reading import read

from .conftest import FULL_CIA402, Platform

pytestmark = [pytest.mark.platform, FULL_CIA402]
BENT = [0.0, -0.5, 1.8, 0.0, 1.2, 0.0]


@pytest.fixture
def bent(enabled: Platform) -> Platform:
    enabled.call("move_joints", q=BENT)
    return enabled


def pushed(platform: Platform, y: float) -> None:
    """Push the tool along y for a second; return when it rests again."""
    before = position(platform)
    platform.rtcp("segment", "push", "0", str(y), "0", "--seconds", "1")
    platform.until(
        lambda status: (
            abs(status["joints"]["actual_position"][0] - before) > 0.05
            and max(map(abs, status["joints"]["actual_velocity"])) < 1e-2
        ),
        "a motion and rest",
    )


def position(platform: Platform) -> float:
    return float(platform.status()["joints"]["actual_position"][0])


@pytest.mark.long("test_a_guiding_command_that_is_interrupted_leaves_the_arm_holding")
def test_a_motion_guided_by_hand_is_recorded_and_replayed_smoothed(bent: Platform) -> None:
    out = bent.directory / "taught.mcap"
    out.unlink(missing_ok=True)
    bent.rtcp("record", "start", "--out", str(out))
    guiding = bent.background("guide")
    bent.until(lambda status: status["state"] == "moving", "guiding")
    assert bent.status()["control_mode"] == "torque"
    pushed(bent, -20.0)
    pushed(bent, 20.0)
    bent.rtcp("halt")
    assert guiding.wait() == 0
    bent.rtcp("record", "stop")
    assert bent.status()["control_mode"] == "joint"
    taught = read(out, ["sent_position", "actual_velocity"]).column("sent_position")
    assert np.ptp(taught[:, 0]) > 0.05

    again = bent.directory / "again.mcap"
    again.unlink(missing_ok=True)
    bent.rtcp("record", "start", "--out", str(again))
    said = bent.rtcp("replay", str(out), "--smooth", "2", "--rest", "0.5").stdout
    bent.rtcp("record", "stop")
    apart = re.search(r"smoothed: at most ([0-9.]+) rad from the recorded positions", said)
    assert apart is not None
    replayed: Any = read(again, ["sent_position"]).column("sent_position")
    low, high = taught.min(axis=0), taught.max(axis=0)
    assert np.abs(replayed.min(axis=0)[0] - low[0]) < float(apart[1]) + 2e-3
    assert (replayed <= high + 2e-3).all()
    assert replayed[-1] == pytest.approx(taught[-1], abs=2e-3)


def test_a_guiding_command_that_is_interrupted_leaves_the_arm_holding(bent: Platform) -> None:
    guiding = bent.background("guide")
    bent.until(lambda status: status["state"] == "moving", "guiding")
    pushed(bent, 20.0)
    bent.rtcp("segment", "push", "0", "20", "0", "--seconds", "60")
    guiding.send_signal(signal.SIGINT)
    _, said = guiding.communicate()
    assert (guiding.returncode, "controlled stop" in said) == (130, True)
    bent.until(lambda status: status["state"] == "holding", "rest")
    before = position(bent)
    bent.pass_cycles(250)
    # The position loop of CST yields by its stiffness; its integral part corrects that.
    assert position(bent) == pytest.approx(before, abs=0.05)
    assert bent.status()["state"] == "holding"
