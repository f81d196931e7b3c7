"""The reference clock no longer answers, and every frame comes back with the right working counter."""

from __future__ import annotations

import pytest

from rtcp.fieldbus.bus import station_of
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.alone

OP = 0x08


def test_a_reference_clock_that_lost_its_station_address_stops_the_arm_and_is_followed_again(running: Platform) -> None:
    running.rtcp("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.1")
    running.until_moving()
    # What the FRMW of the cycle addresses is there no more; the process data is addressed by FMMUs and goes on.
    running.wire("station", "0", "0")
    assert "the cycle has not followed the reference clock for 1 s" in moving.communicate()[1]
    assert moving.returncode == 5
    status = running.status()
    assert (status["state"], status["dc"]["locked"]) == ("fault", False)
    assert running.al_states() == [OP] * 7
    assert "the reference clock is not followed" in running.rtcp("reset", check=5).stderr
    running.wire("station", "0", str(station_of(1)))
    running.until(lambda found: found["dc"]["locked"], "the clock")
    running.rtcp("reset")
    running.rtcp("enable")
