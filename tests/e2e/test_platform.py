"""INIT to OP, enable, move in every mode, disable: on a real socket between real processes."""

from __future__ import annotations

import os
import stat
import struct
from pathlib import Path
from typing import Any

import pytest
import yaml

from rtcp.config import default_config
from rtcp.ipc.errors import Refused
from rtcp.ipc.runtime_directory import segment_control
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, OTHER_ARM, PERIOD_US, SLAVES, Platform
from tests.e2e.wire import COUNTS_PER_RAD, outputs
from tests.fieldbus.test_capture import OUTBOUND, PACKET, blocks

pytestmark = pytest.mark.platform

ZERO = [0.0] * 6
Q = [0.12, -0.1, 0.15, -0.05, 0.12, -0.15]
MODES = ("csp",) if OTHER_ARM == "myactuator" else ("csp", "csv", "cst")
"""MyActuator's drives have CSP alone."""


def distance(status: dict[str, Any], q: list[float]) -> float:
    return max(abs(have - want) for have, want in zip(status["joints"]["actual_position"], q, strict=True))


def test_every_slave_is_in_op_and_the_clock_is_followed(shared: Platform) -> None:
    status = shared.status()
    assert status["state"] == "ready"
    assert [slave["state"] for slave in status["slaves"]] == ["OP"] * SLAVES
    assert shared.al_states() == [8] * SLAVES
    assert status["wkc"]["expected"] == 3 * SLAVES
    # A single late frame of a busy host does not matter.
    shared.until(lambda status: status["wkc"]["actual"] == 3 * SLAVES, "a frame with the full working counter")
    assert status["dc"]["locked"]
    assert status["cycle_ns"] == PERIOD_US * 1000


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one CPU runs all")
def test_no_thread_of_gateway_and_segment_runs_on_the_cpu_of_the_cycle(shared: Platform) -> None:
    pids, cpu = shared.pids(), shared.status()["realtime"]["cpu"]
    tasks = [task for name in ("gateway", "segment") for task in os.listdir(f"/proc/{pids[name]}/task")]
    assert not [task for task in tasks if cpu in os.sched_getaffinity(int(task))]


def test_a_capture_beside_the_cycle_holds_its_frames_and_does_not_disturb_it(shared: Platform, tmp_path: Path) -> None:
    out, before = tmp_path / "cycle.pcapng", shared.status()
    reported = shared.rtcp("capture", "--out", str(out), "--seconds", "1").stdout
    after = shared.status()
    assert (after["state"], "lost" in reported) == (before["state"], False)
    packets = [content for kind, content in blocks(out) if kind == PACKET]
    assert f"{len(packets)} frames written to {out}" in reported
    # Process data: LRD, LWR or LRW, ETG.1000.4, table 14; behind the header of the packet.
    cyclic = [content for content in packets if content[20 + 16] in (10, 11, 12)]
    sent = sum(struct.unpack_from("<I", content, len(content) - 8)[0] == OUTBOUND for content in cyclic)
    assert 100 < sent <= after["cycles"] - before["cycles"]


def test_a_move_ends_within_a_milliradian_in_every_mode(enabled: Platform) -> None:
    for sign, mode in enumerate(MODES):
        goal = [(-1) ** sign * q for q in Q]
        enabled.call("mode", name=mode)
        enabled.rtcp("move", *map(str, goal), "--speed", "0.4")
        status = enabled.until(lambda status, goal=goal: distance(status, goal) < 1e-3, f"arrival in {mode}")  # type: ignore[misc]
        assert (status["drive_mode"], status["state"]) == (mode, "holding")


def test_a_commander_that_is_killed_ends_in_a_controlled_stop_and_nobody_else_commands_before(
    enabled: Platform,
) -> None:
    enabled.call("move_joints", q=ZERO)
    moving = enabled.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.2")
    enabled.until_moving(0.02)
    with pytest.raises(Refused) as refused:
        enabled.call("move_joints", q=Q)
    assert f"pid {moving.pid}" in refused.value.fields["holder"]
    since = enabled.last_event()
    moving.kill()
    moving.communicate()
    status = enabled.until(lambda status: status["state"] == "holding", "standstill")
    assert 0.0 < status["joints"]["actual_position"][0] < 1.4
    assert "lease_expired" in enabled.events(since)
    assert status["lease"]["holder"] in ("", None)


def test_the_control_socket_is_its_owners_alone(shared: Platform) -> None:
    assert stat.S_IMODE(os.stat(shared.directory).st_mode) == 0o700
    assert stat.S_IMODE(os.stat(shared.directory / "control.sock").st_mode) == 0o600


def test_a_second_start_is_refused(shared: Platform) -> None:
    assert "running already" in shared.rtcp("start", "--detach", check=3).stderr


@CUBEMARS
def test_every_target_on_the_wire_is_inside_limits_and_every_step_inside_the_speed_limit(
    enabled: Platform,
) -> None:
    path = enabled.directory / "frames"
    enabled.call("move_joints", q=ZERO)
    with enabled.capture(path):
        enabled.call("move_joints", q=Q)
        with pytest.raises(Refused):
            enabled.call("move_joints", q=[3.2, 0, 0, 0, 0, 0])
        enabled.call("mode", name="csv")
        enabled.call("move_joints", q=ZERO)
        enabled.call("mode", name="cst")
        enabled.call("move_joints", q=Q)
        enabled.call("mode", name="csp")
        enabled.call("move_joints", q=ZERO)
        enabled.call("disable")
        enabled.call("enable")
    limits = [(-3.1, 3.1), (-2.0, 2.0), (-2.4, 2.4), (-3.1, 3.1), (-2.0, 2.0), (-3.1, 3.1)]
    torques = [float(joint["torque"]) for joint in yaml.safe_load(default_config().read_text())["joints"]]
    largest = 0.5 * PERIOD_US * 1e-6 * COUNTS_PER_RAD
    before: list[int] | None = None
    seen = moved = 0
    for _, drives in outputs(path):
        seen += 1
        for i, drive in enumerate(drives):
            low, high = limits[i]
            assert low * COUNTS_PER_RAD <= drive.position <= high * COUNTS_PER_RAD
            assert abs(drive.velocity) <= 0.5 * COUNTS_PER_RAD
            assert abs(drive.torque) <= torques[i] * COUNTS_PER_RAD
            if before is not None:
                step = abs(drive.position - before[i])
                moved += step
                assert step <= largest + 0.5
        before = [drive.position for drive in drives]
    assert seen > 500
    assert moved > 4 * 10_000 * sum(abs(q) for q in Q) * 0.99


@CUBEMARS
@pytest.mark.long("test_slaves_with_an_alias_are_found_where_they_hang_and_the_others_in_their_order")
def test_drives_that_are_swapped_on_the_cable_are_found_by_their_aliases_and_each_turns_its_own_joint(
    platform: Platform,
) -> None:
    platform.be_patient(2000)
    folder = platform.directory / "config"
    arm, segment = (yaml.safe_load((folder / file).read_text()) for file in ("assistive_arm.yaml", "segment.yaml"))
    for slave, alias in zip(arm["slaves"][1:3], (7, 9), strict=True):
        slave["alias"] = alias
    for slave, alias in zip(segment["slaves"][1:3], (9, 7), strict=True):
        slave["alias"] = alias
    # The segment takes the arm's drives in the order of the cable.
    del segment["arm"]
    for file, data in (("assistive_arm.yaml", arm), ("segment.yaml", segment)):
        (folder / file).write_text(yaml.safe_dump(data, sort_keys=False))
    platform.rtcp("start", "--detach")
    assert [slave["name"] for slave in platform.status()["slaves"][:4]] == ["io", "drive2", "drive1", "drive3"]
    platform.call("enable")
    platform.call("move_joints", q=[0.3, *ZERO[1:]])
    with SegmentClient(segment_control(platform.directory)) as client:
        turned = [slave["position_rad"] for slave in client.truth()["slaves"][1:4]]
    assert turned == pytest.approx([0.0, 0.3, 0.0], abs=5e-3)
