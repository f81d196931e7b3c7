"""The reference clock no longer answers, and every frame comes back with the right working counter."""

from __future__ import annotations

import pytest

from rtcp.fieldbus.bus import station_of
from rtcp.ipc.errors import Faulted
from tests.e2e.conftest import SLAVES, Platform

pytestmark = pytest.mark.platform

OP = 0x08


def test_a_reference_clock_that_lost_its_station_address_stops_the_arm_and_is_followed_again(running: Platform) -> None:
    running.call("enable")
    moving = running.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.1")
    running.until_moving()
    since = running.last_event()
    # The FRMW of the cycle reaches no slave any more; the process data is addressed by FMMUs and continues.
    running.wire("station", "0", "0")
    moving.communicate()
    assert moving.returncode == 5
    assert "clock_lost" in running.events(since)
    status = running.status()
    assert (status["state"], status["dc"]["locked"]) == ("fault", False)
    assert running.al_states() == [OP] * SLAVES
    with pytest.raises(Faulted) as failed:
        running.call("reset")
    assert failed.value.reason == "reset_without_frames"
    running.wire("station", "0", str(station_of(1)))
    running.until(lambda status: status["dc"]["locked"], "the clock")
    running.call("reset")
    running.call("enable")
