"""Slaves that are lost and come back, on a whole platform: they come back by themselves, the arm does not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.ipc.errors import RtcpError
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, segment_control
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, PERIOD_US, Platform
from tests.e2e.wire import outputs

pytestmark = pytest.mark.platform

ENABLE_OPERATION = 0x000F
ENABLED = 0x27
"""Statusword of Operation Enabled, masked by 0x6F."""
LARGEST_STEP = 0.5 * PERIOD_US * 1e-6 * 1.001
"""rad: what the fastest joint may do in a cycle."""


@pytest.fixture
def segment(shared: Platform) -> Iterator[SegmentClient]:
    """The segment of the shared platform; its faults are cleared afterwards, and the arm is ready."""
    with SegmentClient(segment_control(shared.directory)) as client:
        yield client
        client.clear()
    well(shared)
    if shared.status()["state"] == "fault":
        shared.call("reset")
    shared.call("disable")


def well(platform: Platform) -> dict[str, Any]:
    """Wait until every slave is in OP."""
    return platform.until(lambda status: all(slave["state"] == "OP" for slave in status["slaves"]), "OP")


def lose(platform: Platform, segment: SegmentClient, faults: list[dict[str, Any]]) -> dict[str, Any]:
    """Inject faults; return the status when they were reported and every slave is in OP again."""
    before = [slave["recovered"] for slave in platform.status()["slaves"]]
    for fault in faults:
        segment.fault(fault)
    platform.until(lambda status: status["state"] == "fault", "the fault")
    platform.until(lambda status: [slave["recovered"] for slave in status["slaves"]] != before, "the return")
    return well(platform)


def torque(segment: SegmentClient) -> list[bool]:
    return [slave["torque_on"] for slave in segment.truth()["slaves"] if "torque_on" in slave]


def reset_and_enable(platform: Platform) -> None:
    platform.call("reset")
    assert platform.status()["state"] == "ready"
    platform.call("enable")
    assert platform.status()["state"] == "holding"


@CUBEMARS
def test_a_drive_that_was_without_supply_moves_by_nothing_but_reset_and_enable(
    enabled: Platform, segment: SegmentClient, tmp_path: Path
) -> None:
    enabled.call("mode", name="joint")
    moving = enabled.background("move", "1.5", "0.5", "0.3", "0", "0", "0", "--speed", "0.3")
    enabled.until_moving()
    observer = Observer(blackboard_file(enabled.directory))
    first = observer.head
    path = tmp_path / "frames"
    with enabled.capture(path):
        lose(enabled, segment, [{"fault": "power", "slave": 4, "lasts": 0.2}])
        assert moving.wait() == 5
        enabled.until(lambda status: max(map(abs, status["joints"]["actual_velocity"])) < 0.002, "standstill")
        stood = enabled.status()["joints"]
        assert enabled.status()["state"] == "fault"
        assert not torque(segment)[2]
        with pytest.raises(RtcpError, match="fault"):
            enabled.call("enable")
    records, _ = observer.since(first)
    observer.close()
    # The recovered drive: its target steps only to its position, and no controlword gives it torque.
    noticed = int(np.argmax(records["fault"] != 0))
    came_back = records["statusword"][noticed:, 2] & 0x6F
    assert ENABLED not in came_back[int(np.argmax(came_back != ENABLED)) :]
    assert np.abs(np.diff(records["sent_position"], axis=0))[:, [0, 1, 3, 4, 5]].max() <= LARGEST_STEP
    heard = records[noticed:][records["wkc"][noticed:] == records["wkc_expected"][noticed:]]
    back = heard[(heard["statusword"][:, 2] & 0x6F) != ENABLED]
    assert len(back) > 20
    assert np.abs(back["sent_position"][:, 2] - back["actual_position"][:, 2]).max() < 1e-6
    after = [drives for _, drives in outputs(path)][-60:]
    assert ENABLE_OPERATION not in {drive.controlword for drives in after for drive in drives}
    assert abs(stood["commanded_position"][2] - stood["actual_position"][2]) < 1e-3
    reset_and_enable(enabled)
    joints = enabled.status()["joints"]
    assert max(abs(a - b) for a, b in zip(joints["actual_position"], stood["actual_position"], strict=True)) < 0.01


def test_an_io_box_that_was_without_supply_takes_the_segments_time_up_again(
    enabled: Platform, segment: SegmentClient
) -> None:
    observer = Observer(blackboard_file(enabled.directory))
    first = observer.head
    status = lose(enabled, segment, [{"fault": "power", "slave": 1, "lasts": 0.4}])
    assert status["state"] == "fault"
    reset_and_enable(enabled)
    records, _ = observer.since(first)
    observer.close()
    # The reference clock continues with the drives' clocks; in the gap its time passes as the host's does.
    good = records[records["wkc"] == records["wkc_expected"]]
    offsets = good["dc_time_ns"].astype(np.int64) - good["time_ns"].astype(np.int64)
    gap = int(np.argmax(np.diff(good["time_ns"].astype(np.int64)))) + 1
    assert abs(np.median(offsets[:gap]) - np.median(offsets[gap:])) < 5_000_000
    assert np.abs(np.diff(records["sent_position"], axis=0)).max() <= LARGEST_STEP
    messages = enabled.status()["messages"]
    assert any("slave 1 (io) is back in OP" in sentence for sentence in messages), messages
