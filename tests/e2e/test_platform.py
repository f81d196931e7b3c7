"""INIT to OP, enable, move in every mode, disable: on a real socket between real processes."""

from __future__ import annotations

import json
import os
import socket
import stat
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rtcp.config import default_config, load
from rtcp.ipc.errors import Refused
from rtcp.ipc.jsonrpc import INTERNAL_ERROR
from rtcp.ipc.observer import Observer
from rtcp.ipc.runtime_directory import blackboard_file, segment_control
from rtcp.realtime.scheduling import choose_cpu
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import CUBEMARS, FULL_CIA402, PERIOD_US, SLAVES, Platform
from tests.e2e.wire import COUNTS_PER_RAD, outputs
from tests.fieldbus.test_capture import OUTBOUND, PACKET, blocks

pytestmark = pytest.mark.platform

ZERO = [0.0] * 6
Q = [0.3, -0.2, 0.4, -0.1, 0.25, -0.35]


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
    pids, cpu = shared.pids(), choose_cpu(load(default_config()).cycle.cpu)
    tasks = [task for name in ("gateway", "segment") for task in os.listdir(f"/proc/{pids[name]}/task")]
    assert not [task for task in tasks if cpu in os.sched_getaffinity(int(task))]


def test_the_status_has_every_promised_field(shared: Platform) -> None:
    status = shared.status()
    assert {"state", "drive_mode", "bus", "cycle_ns", "cycles", "missed", "wkc", "slaves", "joints", "devices",
            "wakeup_us", "exchange_us", "compute_us", "dc", "last_second", "realtime",
            "pids"} <= set(status)  # fmt: skip
    assert {"position", "name", "state"} <= set(status["slaves"][0])
    assert all(
        len(status["joints"][name]) == 6
        for name in ("actual_position", "actual_velocity", "actual_torque", "commanded_position", "sent_position")
    )
    assert all({"p50", "p99", "max"} <= set(status[name]) for name in ("wakeup_us", "exchange_us", "compute_us"))
    assert {"locked", "offset_ns"} <= set(status["dc"])
    assert {"scheduler", "memory_locked", "cpu"} <= set(status["realtime"])
    assert set(status["pids"]) == {"loop", "gateway", "segment"}
    assert status["devices"]["io"]["inputs"]["value"] & 0xFF == 63


@CUBEMARS
def test_the_mapping_that_was_written_is_read_back_over_sdo(shared: Platform) -> None:
    def entries(slave: str, index: str, kind: str, count: int) -> list[int]:
        read = (shared.rtcp("sdo", "read", slave, f"{index}:{i}", "--type", kind).stdout for i in range(1, count + 1))
        return [int(printed.split()[0], 0) for printed in read]

    assert entries("2", "0x1C12", "uint16", 1) == [0x1600]
    assert entries("2", "0x1600", "uint32", 5) == [0x60400010, 0x607A0020, 0x60FF0020, 0x60710020, 0x60600008]
    assert entries("drive6", "0x1A00", "uint32", 5) == [0x60410010, 0x60640020, 0x606C0020, 0x60770020, 0x60610008]


def test_a_capture_beside_the_cycle_holds_its_frames_and_does_not_disturb_it(shared: Platform, tmp_path: Path) -> None:
    out, before = tmp_path / "cycle.pcapng", shared.status()
    reported = shared.rtcp("capture", "--out", str(out), "--seconds", "2").stdout
    after = shared.status()
    assert (after["state"], "lost" in reported) == (before["state"], False)
    packets = [content for kind, content in blocks(out) if kind == PACKET]
    assert f"{len(packets)} frames written to {out}" in reported
    # Process data: LRD, LWR or LRW, ETG.1000.4, table 14; behind the header of the packet.
    cyclic = [content for content in packets if content[20 + 16] in (10, 11, 12)]
    sent = sum(struct.unpack_from("<I", content, len(content) - 8)[0] == OUTBOUND for content in cyclic)
    assert 200 < sent <= after["cycles"] - before["cycles"]


def test_an_sdo_that_the_slave_refuses_is_a_sentence(shared: Platform) -> None:
    done = shared.rtcp("sdo", "read", "2", "0x5FFF:0", check=3)
    assert "5FFF" in done.stderr.upper()
    done = shared.rtcp("sdo", "write", "2", "0x6041:0", "1", "--type", "uint16", check=3)
    assert "read" in done.stderr


@pytest.mark.parametrize("mode", ["csp", *(pytest.param(mode, marks=FULL_CIA402) for mode in ("csv", "cst"))])
def test_a_move_ends_within_a_milliradian(enabled: Platform, mode: str) -> None:
    enabled.call("mode", name=mode)
    enabled.rtcp("move", *map(str, Q))
    status = enabled.until(lambda status: distance(status, Q) < 1e-3, f"arrival in {mode}")
    assert status["drive_mode"] == mode
    assert status["state"] == "holding"
    enabled.call("move_joints", q=[-0.05] * 6)
    enabled.until(lambda status: distance(status, [-0.05] * 6) < 1e-3, f"arrival in {mode}")


@FULL_CIA402
def test_the_arm_holds_between_commands(enabled: Platform) -> None:
    for mode in ("csp", "csv", "cst"):
        enabled.call("mode", name=mode)
        before = enabled.status()["joints"]["actual_position"]
        time.sleep(0.5)
        after = enabled.status()["joints"]["actual_position"]
        assert max(abs(a - b) for a, b in zip(before, after, strict=True)) < 1e-3, mode


@FULL_CIA402
def test_the_arm_holds_against_gravity_through_every_change_of_mode(enabled: Platform) -> None:
    enabled.rtcp("move", "0", "-1.2", "-0.3", "0", "0", "0")
    before = enabled.status()["joints"]["actual_position"]
    observer = Observer(blackboard_file(enabled.directory))
    first = observer.head
    for mode in ("cst", "csv", "cst", "csp", "csv", "csp"):
        enabled.call("mode", name=mode)
    records, _ = observer.since(first)
    observer.close()
    assert np.abs(records["actual_position"] - np.array(before)).max() < 5e-3
    enabled.call("move_joints", q=ZERO)


def test_enabling_does_not_move_the_arm(shared: Platform) -> None:
    before = shared.status()["joints"]["actual_position"]
    shared.call("enable")
    status = shared.status()
    assert status["state"] == "holding"
    assert max(abs(a - b) for a, b in zip(before, status["joints"]["actual_position"], strict=True)) < 1e-3
    assert max(abs(a - b) for a, b in zip(before, status["joints"]["commanded_position"], strict=True)) < 1e-3
    shared.call("disable")
    assert shared.status()["state"] == "ready"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["move", "9", "0", "0", "0", "0", "0"], 3, "(joints[0].position in assistive_arm.yaml"),
        (["move", "0", "0", "0", "0", "0", "0", "--speed", "50"], 3, "speed 50 rad/s is not allowed"),
        (["move", "0", "0", "0"], 2, "6"),
        (["move", "nan", "0", "0", "0", "0", "0"], None, "nan"),
        (["mode", "sideways"], None, "csp"),
    ],
)
def test_what_is_not_allowed_is_refused_and_nothing_moves(
    enabled: Platform, arguments: list[str], code: int | None, said: str
) -> None:
    before = enabled.status()["joints"]["commanded_position"]
    done = enabled.rtcp(*arguments, check=code)
    assert done.returncode in (2, 3)
    assert said in " ".join(done.stderr.split())
    assert enabled.status()["joints"]["commanded_position"] == before


def test_moves_that_the_generator_finds_hard_are_made_or_refused(enabled: Platform) -> None:
    enabled.call("move_joints", q=[0.5, 0, 0, 0, 0, 0])
    enabled.call("move_joints", q=[0.54, 0, 0, 0, 0, 0])
    with pytest.raises(Refused) as refused:
        enabled.call("move_joints", q=ZERO, speed=1e-6)
    assert refused.value.reason == "no_trajectory"
    assert enabled.status()["state"] == "holding"
    enabled.call("move_joints", q=ZERO)


def test_malformed_requests_are_answered_and_end_nothing(shared: Platform) -> None:
    calls = [
        ("move_joints", {"q": "x"}),
        ("sdo_read", {"slave": 2, "index": -1, "subindex": 0}),
        ("sdo_read", {"slave": 99, "index": 1, "subindex": 70000}),
        ("sdo_write", {"slave": 2, "index": 24677, "subindex": 0, "hex": "zz"}),
        ("set_output", {"output": 10**400, "value": True}),
    ]
    requests = [b"garbage", b"[]", b'{"jsonrpc": "2.0", "id": 1, "method": "nothing"}']
    requests += [
        json.dumps({"jsonrpc": "2.0", "id": 1, "method": method, "params": params}).encode() for method, params in calls
    ]
    for request in requests:
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(shared.directory / "control.sock"))
            client.sendall(request + b"\n")
            answers = (json.loads(line) for line in client.makefile())
            answer = next(answer for answer in answers if "method" not in answer)  # a notification of progress has one
            error = answer.get("error") or pytest.fail(f"{request!r} is accepted: {answer}")
            assert error["code"] != INTERNAL_ERROR
            assert len(error["message"]) > 10
    assert shared.status()["state"] == "ready"


def test_an_abort_of_the_slave_reaches_the_client_with_its_code(shared: Platform) -> None:
    with pytest.raises(Refused) as refused:
        shared.call("sdo_read", slave=2, index=0x5FFF, subindex=0)
    where = {"slave": 2, "index": 0x5FFF, "subindex": 0, "code": 0x06020000}
    assert (refused.value.reason, refused.value.fields) == ("sdo_aborted", where)


def test_a_move_without_enabling_is_refused(shared: Platform) -> None:
    with pytest.raises(Refused) as refused:
        shared.call("move_joints", q=Q)
    assert (refused.value.reason, refused.value.fields["state"]) == ("wrong_state", "ready")


def test_a_second_commander_is_refused_with_the_holders_name(enabled: Platform) -> None:
    moving = enabled.background("move", "0.4", "0", "0", "0", "0", "0", "--speed", "0.2")
    enabled.until(lambda status: status["state"] == "moving", "motion")
    with pytest.raises(Refused) as refused:
        enabled.call("move_joints", q=Q)
    assert f"pid {moving.pid}" in refused.value.fields["holder"]
    assert moving.wait() == 0
    enabled.call("move_joints", q=ZERO)


def test_a_commander_that_is_killed_ends_in_a_controlled_stop(enabled: Platform) -> None:
    moving = enabled.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.1")
    enabled.until_moving()
    since = enabled.last_event()
    moving.kill()
    moving.wait()
    status = enabled.until(lambda status: status["state"] == "holding", "standstill")
    assert 0.0 < status["joints"]["actual_position"][0] < 1.4
    assert "lease_expired" in enabled.events(since)
    enabled.call("move_joints", q=ZERO)


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
    assert seen > 1000
    assert moved > 4 * 10_000 * sum(abs(q) for q in Q) * 0.99


@CUBEMARS
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
