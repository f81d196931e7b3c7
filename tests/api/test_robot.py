"""Robot and AsyncRobot at a real control socket, in front of a fake loop."""

from __future__ import annotations

import asyncio
import dataclasses
import gc
import inspect
import pydoc
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest

import rtcp
from rtcp import api
from rtcp.api import Arrival, AsyncRobot, GripperRest, JogFrame, Progress, Robot, State, Streamed
from rtcp.api.robot import Method, Methods
from rtcp.ipc.commands import Disable, Halt, Jog, MoveGripper, MoveJoints, SetOutput, StreamPosition
from rtcp.ipc.events import SlaveLost
from rtcp.ipc.runtime_directory import blackboard_file, control_socket
from tests.gateway.fake_loop import JOINTS, FakeLoop, RunningLoop
from tests.waiting import HANG_S, until

Q = [0.1] * JOINTS
LONG = 1_000_000
METHODS = {name: method.describe for name, method in vars(Methods).items() if isinstance(method, Method)}


@pytest.fixture
def robot(directory: Path, loop: FakeLoop) -> Iterator[Robot]:
    loop.state = State.HOLDING
    with rtcp.connect("a test", control_socket(directory)) as connected:
        yield connected


def run(directory: Path, work: Callable[[AsyncRobot], Coroutine[Any, Any, Any]]) -> Any:
    async def connected() -> Any:
        async with rtcp.connect_async("a test", control_socket(directory)) as robot:
            return await work(robot)

    return asyncio.run(connected())


@pytest.mark.parametrize("name", METHODS)
def test_both_robots_have_every_method_with_its_signature_and_its_documentation(name: str) -> None:
    described, blocking, awaited = METHODS[name], getattr(Robot, name), getattr(AsyncRobot, name)
    parameters = list(inspect.signature(described).parameters.values())
    for method in (blocking, awaited):
        assert list(inspect.signature(method).parameters.values()) == parameters
        assert not str(inspect.signature(method).return_annotation).startswith("Call")
        assert method.__doc__ == described.__doc__
        assert method.__doc__
    assert inspect.iscoroutinefunction(awaited)


@pytest.mark.parametrize("robot", [Robot, AsyncRobot])
def test_a_subclass_of_a_robot_keeps_the_methods_that_it_overrides(robot: Any) -> None:
    class Own(robot):  # type: ignore[misc]
        def halt(self) -> None:
            raise NotImplementedError

    class Mixed(Own):
        pass

    assert Own.halt is Mixed.halt
    assert "Own.halt" in Own.halt.__qualname__
    assert Own.enable is robot.enable


@pytest.mark.parametrize("kind", [Robot, AsyncRobot, Methods])
def test_python_helps_with_a_robot_and_its_methods(kind: type) -> None:
    assert "Move to joint positions and return when the arm is there." in pydoc.render_doc(kind)
    assert "move_joints" in dict(inspect.getmembers(kind))


def test_the_package_shows_the_names_of_the_api() -> None:
    assert all(getattr(rtcp, name) is getattr(api, name) for name in rtcp.__all__)
    assert all(hasattr(api, name) for name in api.__all__)
    assert {*rtcp.__all__} <= {*dir(rtcp)}
    assert {*api.__all__} <= {*dir(api)}
    with pytest.raises(AttributeError):
        _ = rtcp.nothing


def test_a_motion_returns_its_arrival_and_reports_progress(robot: Robot, loop: FakeLoop) -> None:
    seen: list[Progress] = []
    arrival = robot.move_joints(Q, speed=0.2, synchronized=False, progress=seen.append)
    assert arrival == Arrival(tuple(Q), 0.0)
    assert loop.commands == [MoveJoints(tuple(Q), 0.2, False)]
    assert all(len(update.positions) == JOINTS for update in seen)
    assert seen


def test_the_status_is_typed(robot: Robot) -> None:
    status = robot.status()
    assert (robot.state, status.state, status.control_mode) == (State.HOLDING, State.HOLDING, api.ControlMode.JOINT)
    assert status.drive_mode is None, "the fake loop shows none"
    # Another test of this module may have moved it before.
    assert status.positions == status.sent_positions in ((0.0,) * JOINTS, (0.1,) * JOINTS)
    assert status.joint_names[0] == "joint1"
    assert status.raw["bus"] == "virtual"


def test_events_are_typed(robot: Robot, loop: FakeLoop) -> None:
    before = robot.events()
    loop.board.event(SlaveLost(3))
    (event,) = robot.events(before[-1].number if before else 0)
    assert (event.name, event.fields) == ("slave_lost", {"slave": 3})


@pytest.mark.parametrize(
    ("call", "result", "command"),
    [
        (lambda robot: robot.jog([0.1] * 6, JogFrame.TOOL), Streamed, Jog((0.1,) * 6, JogFrame.TOOL, 0.25)),
        (lambda robot: robot.jog([0.1] * 6, "base", hold_s=0.1), Streamed, Jog((0.1,) * 6, JogFrame.BASE, 0.1)),
        (lambda robot: robot.stream(Q, 1.5), Streamed, StreamPosition(tuple(Q), 1.5)),
        (lambda robot: robot.set_output(3, True), type(None), SetOutput(3, True)),
        (lambda robot: robot.gripper(open=True), GripperRest, MoveGripper(True)),
        (lambda robot: robot.command("set_output", output=3, value=True), dict, SetOutput(3, True)),
        (lambda robot: robot.sdo_read(2, 0x6065), bytes, None),
    ],
)
def test_a_method_sends_its_command_and_returns_its_type(
    robot: Robot, loop: FakeLoop, call: Callable[[Robot], object], result: type, command: object
) -> None:
    assert type(call(robot)) is result
    sent = loop.commands
    if isinstance(command, Jog):
        # The time that is left of the call's.
        [jog] = sent
        assert isinstance(jog, Jog)
        assert 0.0 < jog.hold_s <= command.hold_s
        sent = [dataclasses.replace(jog, hold_s=command.hold_s)]
    assert sent == ([] if command is None else [command])


def test_a_command_older_than_its_hold_time_has_no_effect(robot: Robot, loop: FakeLoop) -> None:
    with pytest.raises(rtcp.TimedOut):
        robot.jog([0.1] * 6, sent_s=time.monotonic() - 1.0)
    assert loop.commands == []


def test_errors_have_classes_and_fields(robot: Robot, directory: Path) -> None:
    with pytest.raises(rtcp.Invalid, match="q: found 1 numbers"):
        robot.move_joints([0.0])
    robot.jog([0.1] * 6)
    with rtcp.connect("another", control_socket(directory)) as second, pytest.raises(rtcp.Refused) as raised:
        second.move_joints(Q)
    assert (raised.value.reason, raised.value.fields) == ("lease_held", {"holder": "a test"})


# -- asyncio ----------------------------------------------------------------------------------------------------------


def test_async_calls_return_the_same_and_may_overlap(robot: Robot, directory: Path, loop: FakeLoop) -> None:
    async def work(second: AsyncRobot) -> tuple[Arrival, State, api.Status]:
        move = asyncio.create_task(second.move_joints(Q))
        return await move, await second.state(), await second.status()

    arrival, state, status = run(directory, work)
    assert (arrival, state) == (Arrival(tuple(Q), 0.0), State.HOLDING)
    assert status.state is State.HOLDING


def test_halt_overtakes_the_move_of_the_same_robot(directory: Path, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG

    async def work(robot: AsyncRobot) -> None:
        move = asyncio.create_task(robot.move_joints(Q))
        while await robot.state() is not State.MOVING:
            pass
        halt = asyncio.create_task(robot.halt())
        while Halt not in loop.kinds:
            await asyncio.sleep(0.01)
        loop.state = State.HOLDING
        await halt
        with pytest.raises(rtcp.Faulted):
            await move

    run(directory, work)


def test_an_awaited_call_that_is_cancelled_ends_its_move(directory: Path, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG

    async def work(robot: AsyncRobot) -> None:
        move = asyncio.create_task(robot.move_joints(Q))
        while await robot.state() is not State.MOVING:
            pass
        move.cancel()
        while await robot.state() is not State.HOLDING:
            pass
        assert (await robot.status()).holder == ""

    run(directory, work)


def test_an_error_in_a_progress_callback_ends_its_move_and_not_the_connection(directory: Path, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG

    def report(progress: Progress) -> None:
        raise ZeroDivisionError

    async def work(robot: AsyncRobot) -> None:
        with pytest.raises(ZeroDivisionError):
            await robot.move_joints(Q, progress=report)
        while await robot.state() is not State.HOLDING:
            pass
        assert (await robot.status()).holder == ""

    run(directory, work)


@pytest.mark.parametrize("error", [StopIteration, asyncio.CancelledError])
def test_a_progress_callback_that_raises_what_no_task_may_ends_its_move_too(
    directory: Path, loop: FakeLoop, error: type[BaseException]
) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG

    def report(progress: Progress) -> None:
        raise error

    async def work(robot: AsyncRobot) -> None:
        with pytest.raises(BaseException):  # noqa: B017, PT011  which one is Python's
            await robot.move_joints(Q, progress=report)

    run(directory, work)
    with rtcp.connect("another", control_socket(directory)) as robot:
        while robot.state is not State.HOLDING:
            pass
        assert robot.status().holder == ""


def test_a_call_that_its_own_progress_callback_cancels_ends_its_move(directory: Path, loop: FakeLoop) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG

    async def work(robot: AsyncRobot) -> None:
        move = asyncio.create_task(robot.move_joints(Q, progress=lambda progress: move.cancel()))
        with pytest.raises(asyncio.CancelledError):
            await move
        while await robot.state() is not State.HOLDING:
            pass
        assert (await robot.status()).holder == ""

    run(directory, work)


def test_a_call_that_is_cancelled_as_its_connection_ends_leaves_no_error_behind(
    directory: Path, loop: FakeLoop
) -> None:
    loop.state, loop.moves_for = State.HOLDING, LONG
    left: list[dict[str, Any]] = []

    async def work(robot: AsyncRobot) -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: left.append(context))
        move = asyncio.create_task(robot.move_joints(Q))
        while await robot.state() is not State.MOVING:
            pass
        closing = asyncio.create_task(robot.close())
        await asyncio.sleep(0)
        move.cancel()
        with pytest.raises(asyncio.CancelledError):
            await move
        await closing

    run(directory, work)
    gc.collect()
    assert left == []


def test_async_errors_are_the_same(directory: Path, loop: FakeLoop, tmp_path: Path) -> None:
    async def refuse(robot: AsyncRobot) -> None:
        with pytest.raises(rtcp.Invalid):
            await robot.move_joints([0.0])
        await robot.close()
        with pytest.raises(rtcp.ConnectionLost):
            await robot.status()

    run(directory, refuse)
    with pytest.raises(rtcp.NotRunning):
        run(tmp_path, refuse)


def test_a_connection_that_the_platform_closes_fails_every_call_that_waits(tmp_path: Path) -> None:
    async def work() -> None:
        async def close(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readline()
            await reader.readline()
            writer.close()

        await asyncio.start_unix_server(close, control_socket(tmp_path))
        async with rtcp.connect_async(path=control_socket(tmp_path)) as robot:
            with pytest.raises(rtcp.ConnectionLost, match="before it answered 'status'"):
                await robot.status()

    asyncio.run(work())


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[FakeLoop]:
    """A loop without a gateway, in `tmp_path`."""
    loop = RunningLoop(blackboard_file(tmp_path))
    yield loop
    loop.end()
    blackboard_file(tmp_path).unlink()


def test_a_stop_reaches_the_loop_after_the_gateway_has_closed_the_connection(tmp_path: Path, alone: FakeLoop) -> None:
    async def work() -> rtcp.RtcpError:
        async def close(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.close()

        await asyncio.start_unix_server(close, control_socket(tmp_path))
        async with rtcp.connect_async(path=control_socket(tmp_path)) as robot:
            while robot.is_open:
                await asyncio.sleep(0.001)
            with pytest.raises(rtcp.ConnectionLost) as raised:
                await robot.halt()
            return raised.value

    assert asyncio.run(work()).fields == {"stop_taken": True}
    assert alone.kinds == [Halt]


def test_a_stop_whose_robot_is_closed_before_its_answer_is_lost(tmp_path: Path, alone: FakeLoop) -> None:
    async def work() -> None:
        await asyncio.start_unix_server(lambda reader, writer: None, control_socket(tmp_path))
        robot = await rtcp.connect_async(path=control_socket(tmp_path)).__aenter__()
        halt = asyncio.create_task(robot.halt())
        while Halt not in alone.kinds:
            await asyncio.sleep(0.001)
        await robot.close()
        with pytest.raises(rtcp.ConnectionLost, match=r"^the platform closed the connection"):
            await halt

    asyncio.run(work())


def test_a_stop_reaches_the_loop_where_there_is_no_gateway(tmp_path: Path, alone: FakeLoop) -> None:
    async def work(robot: AsyncRobot) -> rtcp.RtcpError:
        assert not robot.is_open
        with pytest.raises(rtcp.NotRunning):
            await robot.status()
        with pytest.raises(rtcp.NotRunning) as raised:
            await robot.disable()
        return raised.value

    assert run(tmp_path, work).fields == {"stop_taken": True}
    assert alone.kinds == [Disable]


def test_inputs_and_outputs_are_mappings_by_name_and_by_place(robot: Robot, loop: FakeLoop) -> None:
    loop.inputs, loop.outputs = 1 << 9, 1 << 4
    robot.wait_io("emergency_stop", True, 2.0)
    inputs, outputs = robot.io.inputs, robot.io.outputs
    assert [name for name, value in inputs.items() if value] == ["emergency_stop"]
    assert inputs["io.10"]
    assert "io.17" not in inputs
    assert [name for name, value in outputs.items() if value] == ["io.5"]
    assert robot.io["emergency_stop"]
    assert robot.io["io.10"]
    with pytest.raises(KeyError, match=r"none: allowed is one of state_lamp, .*io\.16"):
        robot.io["none"]
    robot.io["io.6"] = True
    assert loop.received(SetOutput) == [SetOutput(6, True)]


def test_a_wait_for_an_input_of_another_thread_ends_with_it(robot: Robot, loop: FakeLoop) -> None:
    threading.Timer(0.1, lambda: setattr(loop, "inputs", 1 << 11)).start()
    robot.io.wait("io.12", True, timeout_s=HANG_S)
    with pytest.raises(rtcp.TimedOut) as late:
        robot.io.wait("io.12", False, timeout_s=0.1)
    assert (late.value.reason, late.value.fields["name"]) == ("level_not_reached", "io.12")


def test_pose_fk_and_ik_are_the_same_in_both_robots(directory: Path, robot: Robot, loop: FakeLoop) -> None:
    loop.q = [0.1, 0.3, 1.5, 0.2, 0.5, 0.4]
    until(lambda: robot.positions == pytest.approx(loop.q), "the positions")
    pose = robot.fk(loop.q)
    assert robot.pose == pytest.approx(pose, abs=1e-6)
    assert robot.status().tool_velocity == (0.0,) * 6
    assert robot.ik(pose) == pytest.approx(loop.q, abs=1e-9)

    async def asked(second: AsyncRobot) -> Any:
        return await second.pose(), await second.positions(), await second.ik(await second.fk(loop.q), near=loop.q)

    answers = run(directory, asked)
    assert [answers[0], answers[1], answers[2]] == [pytest.approx(value, abs=1e-6) for value in (pose, loop.q, loop.q)]
