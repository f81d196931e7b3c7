"""The virtual IRB 120 by RAPID streaming: a RAPID program between the platform and the arm, which is behind."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.api import RtcpError
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import irc5_control
from rtcp.virtual.request_socket import RequestClient
from tests.leftovers import Leftovers
from tests.waiting import until

from .conftest import Platform

pytestmark = pytest.mark.platform
HOME = [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]
SLOW_RAD_S = 0.2
CYCLE_LOST = pytest.mark.long("test_a_cycle_is_lost_when_either_positions_or_status_are_missing")
STATE_BY_STATUS = pytest.mark.long("test_the_state_of_a_drive_is_what_the_status_says")


@pytest.fixture(scope="module")
def platform(leftovers: Leftovers) -> Iterator[Platform]:
    made = Platform()
    leftovers.shared.add(str(made.directory))
    made.environment["RTCP_CONFIG"] = str(default_config().parent / "abb_irb120_rapid.yaml")
    made.rtcp("start", "--detach")
    yield made
    made.end()
    leftovers.shared.discard(str(made.directory))


@pytest.fixture
def moving(platform: Platform) -> Iterator[Platform]:
    """The platform with the arm in slow motion; restored afterwards."""
    platform.call("enable")
    platform.call("move_joints", q=HOME)
    platform.background("move", "--speed", f"{SLOW_RAD_S}", "1.5", "0", "0", "0", "0.5", "0")
    platform.until_moving()
    yield platform
    operate(platform, "clear")
    operate(platform, "release", circuit="emergency")
    operate(platform, "motors_on")
    if not units(platform)["rapid_running"]:
        operate(platform, "start_rapid")
    shown = platform.until(can_be_commanded, "a controller that can be commanded")
    if shown["state"] == "fault":
        platform.call("reset")
    platform.call("disable")
    platform.end_commands()


def can_be_commanded(shown: dict[str, Any]) -> bool:
    """Whether messages come, and nothing is missing at the controller."""
    return shown["wkc"]["actual"] == 1 and set(shown["drive_states"]) <= {
        "switched on", "operation enabled", "quick stop active",
    }  # fmt: skip


def operate(platform: Platform, verb: str, **keys: object) -> object:
    """Send a command to the controller."""
    with RequestClient(irc5_control(platform.directory), server="virtual IRC5") as operator:
        return operator.ask({"do": verb, **keys})


def units(platform: Platform) -> dict[str, list[float]]:
    """Return the state of the controller's unit."""
    status = operate(platform, "status")
    assert isinstance(status, dict)
    unit: dict[str, list[float]] = status["units"]["ROB_1"]
    return unit


def rest(platform: Platform) -> float:
    """Wait until the first joint rests; return its position, degrees."""
    until(lambda: not any(units(platform)["velocity_deg_s"]), "rest")
    return units(platform)["position_deg"][0]


def test_it_is_moved_from_the_command_line_halted_and_disabled(platform: Platform) -> None:
    shown = json.loads(platform.rtcp("status", "--json").stdout)
    assert (shown["bus_kind"], shown["slaves"], shown["dc"]) == ("rapid", [], None)
    assert shown["devices"]["robot"]["mode"]["value"] == 2
    platform.call("enable")
    assert "arrived" in platform.rtcp("move", "0.1", "0.1", "0", "0", "0.6", "0").stdout
    rest(platform)
    assert units(platform)["position_deg"][:2] == pytest.approx([5.730, 5.730], abs=0.01)
    platform.background("move", "--speed", f"{SLOW_RAD_S}", "1.5", "0", "0", "0", "0.5", "0")
    platform.until_moving(0.15)
    platform.call("halt")
    assert 0.15 < rest(platform) * 0.01745 < 1.4
    platform.call("disable")
    assert set(platform.status()["drive_states"]) == {"switched on"}


@pytest.mark.parametrize(
    ("verb", "keys", "state", "missing"),
    [
        ("stop_rapid", {}, "ready to switch on", "program"),
        pytest.param("motors_off", {}, "switch on disabled", "motors", marks=STATE_BY_STATUS),
        pytest.param("stop", {"circuit": "emergency"}, "switch on disabled", "motors", marks=STATE_BY_STATUS),
    ],
)
def test_what_the_operator_stops_is_said_and_starts_by_the_operator_alone(
    moving: Platform, verb: str, keys: dict[str, str], state: str, missing: str
) -> None:
    operate(moving, verb, **keys)
    status = moving.until(lambda status: status["state"] == "fault", "the fault")
    assert "joint_1: the drive left Operation Enabled by itself" in status["message"]
    here = rest(moving)
    status = moving.until(lambda status: set(status["drive_states"]) == {state}, state)
    moving.call("reset")
    with pytest.raises(RtcpError) as refused:
        moving.call("enable")
    assert (refused.value.reason, refused.value.fields["missing"]) == ("drive_not_ready", missing)
    operate(moving, "release", circuit="emergency")
    operate(moving, "motors_on")
    operate(moving, "start_rapid")
    moving.until(can_be_commanded, "a controller that can be commanded")
    assert rest(moving) == pytest.approx(here, abs=0.01)
    moving.call("enable")
    assert rest(moving) == pytest.approx(here, abs=0.01)


@pytest.mark.parametrize(
    "fault",
    [
        "socket_cut",
        pytest.param("silent_motion", marks=pytest.mark.long("test_a_motion_server_that_does_not_answer_is_lost")),
        pytest.param(
            "silent_state", marks=pytest.mark.long("test_a_cycle_is_lost_when_either_positions_or_status_are_missing")
        ),
    ],
)
def test_a_lost_connection_is_a_fault_and_nothing_moves_when_it_is_back(moving: Platform, fault: str) -> None:
    operate(moving, "fault", fault=fault)
    status = moving.until(lambda status: status["state"] == "fault", "the fault")
    assert ("process data lost" if fault == "silent_state" else "not ready to switch on") in status["message"]
    here = rest(moving)
    operate(moving, "clear")
    moving.until(can_be_commanded, "a controller that can be commanded")
    assert rest(moving) == pytest.approx(here, abs=0.01)
    moving.call("reset")
    moving.call("enable")
    assert rest(moving) == pytest.approx(here, abs=0.01)
