"""The virtual IRB 120 by RAPID streaming: a RAPID program between the platform and the arm, which is behind."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Iterator
from math import cos, pi, radians
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed: pip install 'rtcp[zenoh]'")
pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.api import Robot, RtcpError
from rtcp.fieldbus.simple_message.messages import JointPosition, JointTrajPt, ReplyCode
from rtcp.ipc.runtime_directory import control_socket, irc5_control
from rtcp.ros.ros2_types import encode, make
from rtcp.ros.ros2_zenoh import key_of, open_session
from rtcp.ros.simple_message.client import MotionClient, StateClient
from rtcp.virtual.request_socket import RequestClient
from tests.cell.running import CONFIG, RunningCell, leftovers_of
from tests.leftovers import Leftovers
from tests.ros2.zenoh_client import Router
from tests.waiting import until

from .conftest import Platform

pytestmark = pytest.mark.platform
HOME = [0.0, 0.0, 0.0, 0.0, 0.5, 0.0]
BACK = [0.0, -0.5, 0.3, 0.0, 0.5, 0.0]
SLOW_RAD_S = 0.2
BOARD = """
inputs: {named: [{name: door, number: 3}]}
outputs: {named: [{name: valve, number: 15}]}
"""
CYCLE_LOST = pytest.mark.long("test_a_cycle_is_lost_when_either_positions_or_status_are_missing")
STATE_BY_STATUS = pytest.mark.long("test_the_state_of_a_drive_is_what_the_status_says")


@pytest.fixture(scope="module")
def platform(leftovers: Leftovers) -> Iterator[Platform]:
    made = Platform()
    leftovers.shared.add(str(made.directory))
    made.be_patient(2000)
    file = made.directory / "config" / "abb_irb120_rapid.yaml"
    text = file.read_text()
    assert "  interface: virtual " in text
    file.write_text(text.replace("  interface: virtual ", "  board: dsqc652\n  interface: virtual ") + BOARD)
    made.environment["RTCP_CONFIG"] = str(file)
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


def board(platform: Platform) -> dict[str, int]:
    """Return the levels of the terminals of the controller's board."""
    status = operate(platform, "status")
    assert isinstance(status, dict)
    return dict(status["streaming"]["board"])


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


def test_it_is_moved_halted_and_disabled_and_its_board_and_motors_are_used_by_name(platform: Platform) -> None:
    shown = json.loads(platform.rtcp("status", "--json").stdout)
    assert (shown["bus_kind"], shown["slaves"], shown["dc"]) == ("rapid", [], None)
    told = shown["robot"]
    assert (told["mode"], told["e_stopped"], told["drives_powered"]) == ("auto", False, True)
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
    with Robot("the tests", control_socket(platform.directory)) as robot:
        assert not robot.io["door"]
        operate(platform, "input", input="DI3", level="on")
        until(lambda: robot.io["door"], "the input")
        robot.set_output("valve", True)
        until(lambda: board(platform)["DO15"] == 1, "the output")
        robot.set_output("robot.motors_order", 2)
        until(lambda: robot.status().raw["devices"]["robot"]["drives_powered"]["value"] == 0, "motors off")
        robot.set_output("robot.motors_order", 1)
        until(lambda: robot.status().raw["devices"]["robot"]["drives_powered"]["value"] == 1, "motors on")
        robot.set_output("robot.motors_order", 0)
    operate(platform, "start_rapid")
    platform.until(can_be_commanded, "a controller that can be commanded")


@pytest.mark.parametrize(
    ("file", "silence_s"),
    [
        pytest.param("cell_irc5.yaml", 0.2, id="rapid"),
        pytest.param(
            "cell_egm.yaml",
            0.1,
            marks=pytest.mark.long("test_two_arms_at_one_controller_follow_the_api_ros_and_simple_message"),
            id="egm",
        ),
    ],
)
def test_two_arms_at_one_controller_follow_the_api_ros_and_simple_message(
    file: str, silence_s: float, leftovers: Leftovers
) -> None:
    text = (CONFIG / file).read_text()
    # Loops that may be late for half a second need room to stop in.
    for old, new in {f"silence_s: {silence_s}": "silence_s: 0.5", "0.457, 0]": "0.8, 0]"}.items():
        assert old in text
        text = text.replace(old, new)
    with leftovers_of(leftovers, "left", "right") as platform:
        running = RunningCell(text, platform)

        def joints() -> list[float]:
            with RequestClient(irc5_control(running.of("left")), server="virtual IRC5") as operator:
                units = operator.ask({"do": "status"})["units"]
            return [radians(joint) for unit in ("ROB_1", "ROB_2") for joint in units[unit]["position_deg"]]

        with running.connect() as cell:
            cell.enable()
            cell.move_joints({"left": [0.2, *BACK[1:]], "right": [-0.2, *BACK[1:]]})
            goal = [0.2, *BACK[1:], -0.2, *BACK[1:]]
            until(lambda: joints() == pytest.approx(goal, abs=1e-3), "the targets of the API")
        router = Router()
        node = platform.background("ros", "--zenoh", "--router", router.address, "--cell", "--auto-enable")
        with open_session(router.address) as session:
            kind = "trajectory_msgs/msg/JointTrajectoryPoint"
            publisher = session.declare_publisher(key_of(0, "joint_command", kind))

            def has_followed() -> bool:
                # A little ahead of the arms, wherever the node has begun to listen.
                way = min(max(joints()[0] - 0.2, 0.0) + 0.02, 0.1)
                command = make(kind, positions=[0.2 + way, *goal[1:6], -0.2 - way, *goal[7:]])
                publisher.put(encode(kind, command))
                return joints()[0] > 0.29 and joints()[6] < -0.29

            until(has_followed, "the targets of joint_command", interval_s=1.0 / 30.0)
        node.send_signal(signal.SIGINT)
        node.communicate()
        ports = "21000", "21002"
        server = platform.background(
            "ros", "--simple-message", "--cell", "--motion-port", ports[0], "--state-port", ports[1]
        )
        asyncio.run(streamed(int(ports[0]), int(ports[1]), {0: 0.1, 6: -0.1}))
        until(lambda: joints()[0] < 0.101 and joints()[6] > -0.101, "the targets of Simple Message")
        server.send_signal(signal.SIGINT)
        server.communicate()


async def streamed(motion_port: int, state_port: int, goal: dict[int, float]) -> None:
    """Stream a trajectory of twelve joints to these positions, rad, as a Simple Message client."""
    positions: list[tuple[float, ...]] = []

    def take(message: object) -> None:
        if isinstance(message, JointPosition):
            positions.append(message.positions)

    motion, state = MotionClient("127.0.0.1", motion_port, joints=12), StateClient("127.0.0.1", take, state_port)
    running = [asyncio.create_task(client.run()) for client in (motion, state)]
    while not (motion.is_connected and positions):
        await asyncio.sleep(0.02)
    here = positions[-1]
    for number in range(21):
        way = (1.0 - cos(pi * number / 20)) / 2.0
        target = tuple(q + way * (goal.get(i, q) - q) for i, q in enumerate(here))
        reply = await motion.request(JointTrajPt(number, target, 1.0, 0.1 if number else 0.0))
        assert reply.reply_code is ReplyCode.SUCCESS
    while max(abs(positions[-1][i] - q) for i, q in goal.items()) > 1e-3:
        await asyncio.sleep(0.02)
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)


@pytest.mark.parametrize(
    ("verb", "keys", "state", "missing"),
    [
        ("stop_rapid", {}, "ready to switch on", "program"),
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
    assert status["robot"]["e_stopped"] is (verb == "stop")
    assert status["robot"]["drives_powered"] is (verb == "stop_rapid")
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
