"""All arms of a cell as one group of joints for ROS: `left_joint_1` and so on, in the order of the cell's file.

`rtcp.ros.commands.Commander` uses `GroupRobot` in place of a connection to one arm; its motions are in step.
`GroupStates` merges the joint samples and the statuses of the arms. The URDF has all arms on one link `world`.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from kinematics.pose import Pose
from kinematics.urdf import fixed_axes_rpy, to_urdf
from rtcp.api import Arrival, AsyncRobot, NotRunning, Progress, RtcpError, State, Stream
from rtcp.api.async_robot import connect_async
from rtcp.api.cell import CellStream, StepPlan, find_cell, most_telling
from rtcp.api.feed import Feed
from rtcp.api.results import result
from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.fieldbus.simple_message.messages import RobotMode, Status, TriState
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ros.commands import Connect
from rtcp.ros.processes import ProcessService, ros_name
from rtcp.ros.state import ChannelSample, Diagnostics, JointSample, RobotStatus, Sink, StatePublisher

T = TypeVar("T")
Numbers = Sequence[float]
_STALE_NS: Final = 500_000_000
"""Age at which a sample of an arm is left out, ns."""
_WORST = (
    State.EMERGENCY_STOP, State.FAULT, State.RESETTING, State.STARTING, State.CLOSING, State.OFF,
    State.STOPPED_BY_LIMIT, State.DISABLING, State.READY, State.ENABLING, State.STOPPING, State.HOMING, State.MOVING,
    State.HOLDING,
)  # fmt: skip
"""The state of the group is the first of these in which an arm is."""


def joint_names(cell: CellConfig) -> tuple[str, ...]:
    """Return the names of all joints, each with its arm's name as prefix."""
    return tuple(f"{arm.name}_{joint.name}" for arm in cell.arms for joint in arm.config.joints)


def group_urdf(cell: CellConfig) -> str:
    """Return one URDF document of all arms with known geometry; links and joints have the arm's name as prefix."""
    robot = ET.Element("robot", name=cell.name)
    ET.SubElement(robot, "link", name="world")
    for arm in cell.arms:
        if arm.config.arm is None:
            continue
        for element in ET.fromstring(to_urdf(arm.config.arm, [joint.torque for joint in arm.config.joints])):
            if element.tag == "material":
                if robot.find(f"material[@name='{element.get('name')}']") is None:
                    robot.append(element)
                continue
            element.set("name", f"{arm.name}_{element.get('name')}")
            for end in element.iter():
                if end.tag in ("parent", "child"):
                    end.set("link", f"{arm.name}_{end.get('link')}")
            robot.append(element)
        base = Pose.from_xyzrpy(*arm.base.position, *arm.base.rpy)
        mount = ET.SubElement(robot, "joint", name=f"{arm.name}_base", type="fixed")
        ET.SubElement(mount, "parent", link="world")
        ET.SubElement(mount, "child", link=f"{arm.name}_base_link")
        rpy = fixed_axes_rpy(base.rotation)
        ET.SubElement(mount, "origin", xyz=" ".join(map(repr, base.position)), rpy=" ".join(map(repr, rpy)))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


# -- commands ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GroupStatus:
    """Status of the group: the worst state of an arm, and the joints of all, rad."""

    state: State
    joint_names: tuple[str, ...]
    commanded_positions: tuple[float, ...]


class GroupStream:
    """A stream of all joints in step; methods as of `Stream`.

    Args:
        stream: streams of the arms.
        counts: number of joints of each arm.
    """

    def __init__(self, stream: CellStream, counts: Mapping[str, int]) -> None:
        self._stream, self._counts = stream, counts

    def send(
        self, q: Numbers, velocity: Numbers | None = None, acceleration: Numbers | None = None, t: float | None = None
    ) -> None:
        """Send a setpoint of all joints; the acceleration is not used."""
        speeds = None if velocity is None else split(velocity, self._counts)
        self._stream.send(split(q, self._counts), speeds, t)

    @property
    def is_open(self) -> bool:
        """Whether all arms follow it."""
        return self._stream.is_open

    def close(self) -> None:
        """Bring all arms to rest."""
        self._stream.close()


def split(numbers: Numbers, counts: Mapping[str, int]) -> dict[str, list[float]]:
    """Return each arm's part of `numbers`; `counts`: number of joints of each arm."""
    parts, at = {}, 0
    for name, count in counts.items():
        parts[name] = list(numbers[at : at + count])
        at += count
    return parts


class GroupRobot:
    """Connections to all arms, as one robot.

    Args:
        name: of the commander.
        directory: the runtime directory that holds those of the arms; None: that of the environment.
    """

    def __init__(self, name: str, directory: Path | None = None) -> None:
        self._name, self._directory = name, directory
        self._closing = contextlib.AsyncExitStack()
        self._arms: dict[str, AsyncRobot] = {}
        self._counts: dict[str, int] = {}
        self._names: tuple[str, ...] = ()
        self._processes: dict[str, Path] = {}
        """Runtime directory of each platform of processes."""
        self._others: dict[str, AsyncRobot] = {}
        """Connections to those that were reached."""
        self._reaching = asyncio.Lock()

    async def __aenter__(self) -> GroupRobot:
        """Connect to all arms; raises NotRunning."""
        cell = find_cell(directory=self._directory)
        self._names = joint_names(cell)
        self._processes = {member.name: member.directory for member in cell.processes}
        try:
            for arm in cell.arms:
                robot = AsyncRobot(self._name, control_socket(arm.directory), disable_when_lost=True)
                self._arms[arm.name] = await self._closing.enter_async_context(robot)
                self._counts[arm.name] = len(arm.config.joints)
        except BaseException:
            await self._closing.aclose()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._closing.aclose()

    async def member(self, name: str) -> AsyncRobot:
        """Return the connection to a platform; that to one of processes is made now where there is none.

        Raises:
            NotRunning: the platform does not run.
        """
        if name in self._arms:
            return self._arms[name]
        async with self._reaching:
            robot = self._others.get(name)
            if robot is None or not robot.is_open:
                reached = AsyncRobot(self._name, control_socket(self._processes[name]), disable_when_lost=True)
                robot = self._others[name] = await self._closing.enter_async_context(reached)
            return robot

    @property
    def is_open(self) -> bool:
        """Whether all connections to arms are open."""
        return all(robot.is_open for robot in self._arms.values())

    async def status(self) -> GroupStatus:
        """Return the worst state, of processes too while no arm moves, and where all joints are commanded."""
        statuses = await self._all(AsyncRobot.status)
        states = {status.state for status in statuses.values()}
        if not states & {State.MOVING, State.STOPPING}:
            states |= set((await self._of_processes(AsyncRobot.state)).values())
        state = next(state for state in _WORST if state in states)
        return GroupStatus(
            state, self._names, tuple(q for status in statuses.values() for q in status.commanded_positions)
        )

    async def enable(self) -> None:
        """Enable the platforms that are ready."""
        await self._everywhere(_enable)

    async def disable(self) -> None:
        """Stop all arms and processes, and remove the torque."""
        await self._everywhere(AsyncRobot.disable)

    async def reset(self) -> State:
        """Leave the faults of all platforms; return the worst state that was left."""
        states = await self._everywhere(AsyncRobot.reset)
        return next(state for state in _WORST if state in states.values())

    async def set_speed_override(self, fraction: float) -> None:
        """Set the speed override of all arms; below 1 motions in step are refused."""
        await self._all(lambda robot: robot.set_speed_override(fraction))

    async def set_output(self, output: str, value: float) -> None:
        """Set an output of one arm: the arm's name and an underscore before the output's."""
        for name, robot in self._arms.items():
            if output.startswith(f"{name}_"):
                await robot.set_output(output.removeprefix(f"{name}_"), value)
                return
        allowed = " or ".join(f"{name}_OUTPUT" for name in self._arms)
        text = f"name: found {output!r}, allowed is {allowed}, with the name of an output"
        raise RtcpError("invalid", text, "unknown_terminal", {"name": output})

    async def halt(self) -> None:
        """Stop every motion and every process."""
        await self._everywhere(AsyncRobot.halt)

    async def at_rest(self) -> GroupStatus:
        """Stop the motion under way, if any, so that another one replaces it; return the status then.

        Processes go on: only `halt` stops them.
        """
        status = await self.status()
        if status.state in (State.MOVING, State.STOPPING):
            await self._all(AsyncRobot.halt)
            status = await self.status()
        return status

    async def run_trajectory(
        self,
        points: Sequence[Mapping[str, Any]],
        progress: Callable[[Progress], None] | None = None,
        replace: bool = False,
        start_tolerance: float = 0.0,
        path_tolerance: Numbers = (),
        goal_tolerance: Numbers = (),
        goal_time_s: float | None = None,
    ) -> Arrival:
        """Run a trajectory of all joints in step; a motion under way is stopped first.

        Raises:
            RtcpError: as `Cell.run_trajectory`; `refused`, unsupported_tolerance: a path tolerance, which arms in step
                do not supervise.
        """
        if any(path_tolerance):
            message = "a path tolerance is not supervised in motions in step: leave it out"
            raise RtcpError("refused", message, "unsupported_tolerance")
        here = (await self.at_rest()).commanded_positions
        copies = [dict(point) for point in points]
        first = copies[0]
        if first["t"] > 0.0:
            # Every arm begins at time 0 at its present position.
            at_rest: dict[str, Any] = {key: [0.0] * len(here) for key in ("v", "a") if key in first}
            copies.insert(0, {"t": 0.0, "q": list(here), **at_rest})
        else:
            for name, planned, now in zip(self._names, first["q"], here, strict=True):
                if abs(planned - now) > start_tolerance:
                    message = f"point 1: at time 0 s {name} must be where it is, at {now:.4f} rad (within "
                    message += f"{start_tolerance:g} rad), found {planned:.4f} rad"
                    raise RtcpError("refused", message, "PlanRefused")
            first["q"] = list(here)
        targets = [{"arm": name, "points": rows} for name, rows in self._by_arm(copies).items()]
        arrived = await self._run_in_step(targets, progress)
        positions = tuple(q for arrival in arrived.values() for q in arrival.positions)
        largest = max(arrival.error for arrival in arrived.values())
        ends = copies[-1]["q"]
        for i, (name, allowed) in enumerate(zip(self._names, goal_tolerance, strict=False)):
            if allowed and abs(positions[i] - ends[i]) > allowed:
                fields = {"axis": i, "error": abs(positions[i] - ends[i]), "limit": allowed}
                message = f"{name} is {fields['error']:.4f} rad from its goal, allowed are {allowed:g} rad"
                raise RtcpError("fault", message, "goal_tolerance_violated", fields)
        return dataclasses.replace(next(iter(arrived.values())), positions=positions, error=largest)

    async def move_joints(self, q: Numbers) -> None:
        """Move all joints in step; a motion under way is stopped first. Raises as `Cell.move_joints`."""
        await self.at_rest()
        await self._run_in_step([{"arm": name, "q": part} for name, part in split(q, self._counts).items()])

    async def _run_in_step(
        self, targets: list[dict[str, Any]], progress: Callable[[Progress], None] | None = None
    ) -> dict[str, Arrival]:
        """Plan a motion in step and run it; return when all arms are there."""
        robot, asked_ns = next(iter(self._arms.values())), time.monotonic_ns()
        plan = StepPlan.from_json(await robot.command("plan_in_step", targets=targets), asked_ns)
        motion = time.monotonic_ns()
        accepted: set[str] = set()

        async def run(name: str) -> Arrival:
            def report(arm_progress: Progress) -> None:
                if arm_progress.accepted and name not in accepted:
                    accepted.add(name)
                    if len(accepted) == len(self._arms) and progress is not None:
                        progress(arm_progress)

            fields = plan.fields_of(name, motion)
            return result(Arrival, await self._arms[name].command("run_in_step", report, **fields))

        return await _gather({name: run(name) for name in self._arms})

    async def open_stream(self) -> GroupStream:
        """Begin a stream of all joints in step."""
        motion = time.monotonic_ns()

        opened: dict[str, Stream] = {}

        async def open_arm(name: str) -> None:
            partners = [partner for partner in self._arms if partner != name]
            answer = await self._arms[name].command("open_stream", motion=motion, partners=partners)
            opened[name] = Stream.from_json(answer)

        try:
            await _gather({name: open_arm(name) for name in self._arms})
        except BaseException:
            for stream in opened.values():
                stream.close()
            raise
        return GroupStream(CellStream({name: opened[name] for name in self._arms}), self._counts)

    async def open_trajectory(self, points: Sequence[Mapping[str, Any]], replace: bool = False) -> None:
        """Refuse: a trajectory in step is planned as a whole."""
        raise RtcpError("refused", "a cell takes no open trajectories: leave --buffer out", "unsupported")

    async def append(self, points: Sequence[Mapping[str, Any]]) -> None:
        """Refuse, as `open_trajectory`."""
        await self.open_trajectory(points)

    def _by_arm(self, points: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, Any]]]:
        by_arm: dict[str, list[dict[str, Any]]] = {name: [] for name in self._counts}
        for point in points:
            parts = {key: split(point[key], self._counts) for key in ("q", "v", "a") if key in point}
            for name, of_arm in by_arm.items():
                of_arm.append({"t": point["t"], **{key: part[name] for key, part in parts.items()}})
        return by_arm

    async def _all(self, call: Callable[[AsyncRobot], Coroutine[Any, Any, T]]) -> dict[str, T]:
        return await _gather({name: call(robot) for name, robot in self._arms.items()})

    async def _of_processes(self, call: Callable[[AsyncRobot], Coroutine[Any, Any, T]]) -> dict[str, T]:
        """Call it for the platforms of processes; the result has no value for one that does not run."""
        return _present(await _gather({name: self._if_running(name, call) for name in self._processes}))

    async def _everywhere(self, call: Callable[[AsyncRobot], Coroutine[Any, Any, T]]) -> dict[str, T]:
        """Call it for all arms, and for the platforms of processes that run."""
        calls = {name: self._if_running(name, call) for name in self._processes}
        return _present(await _gather({**calls, **{name: call(robot) for name, robot in self._arms.items()}}))

    async def _if_running(self, name: str, call: Callable[[AsyncRobot], Coroutine[Any, Any, T]]) -> T | _NotRunning:
        try:
            return await call(await self.member(name))
        except NotRunning:
            return _NotRunning()


class _NotRunning:
    """In place of the result of a platform that does not run."""


def _present(results: Mapping[str, T | _NotRunning]) -> dict[str, T]:
    return {name: value for name, value in results.items() if not isinstance(value, _NotRunning)}


async def _enable(robot: AsyncRobot) -> None:
    if await robot.state() is State.READY:
        await robot.enable()


async def _gather(calls: Mapping[str, Coroutine[Any, Any, T]]) -> dict[str, T]:
    """Await all calls. Then raise the most telling error, if any, with its arm's name; a cancellation cancels all."""
    tasks = {name: asyncio.ensure_future(call) for name, call in calls.items()}
    try:
        if tasks:
            await asyncio.wait(tasks.values())
    except asyncio.CancelledError:
        for task in tasks.values():
            task.cancel()
        await asyncio.gather(*tasks.values(), return_exceptions=True)
        raise
    failed = {name: error for name, task in tasks.items() if (error := task.exception()) is not None}
    if failed:
        raise most_telling(failed)
    return {name: task.result() for name, task in tasks.items()}


# -- states -----------------------------------------------------------------------------------------------------------


def merged(statuses: Sequence[RobotStatus] | Sequence[Status]) -> dict[str, Any]:
    """Return the status of all arms as fields: in motion or in error if one is, motion possible if it is for all."""

    def first_of(field: str, *states: TriState) -> TriState:
        values = {getattr(status, field) for status in statuses}
        return next(state for state in states if state in values)

    of_any = {
        field: first_of(field, TriState.TRUE, TriState.UNKNOWN, TriState.FALSE)
        for field in ("e_stopped", "in_motion", "in_error")
    }
    of_all = {
        field: first_of(field, TriState.FALSE, TriState.UNKNOWN, TriState.TRUE)
        for field in ("drives_powered", "motion_possible")
    }
    modes = {status.mode for status in statuses}
    return {
        **of_any,
        **of_all,
        "mode": modes.pop() if len(modes) == 1 else RobotMode.UNKNOWN,
        "error_code": next((status.error_code for status in statuses if status.error_code), 0),
    }


class GroupStates:
    """Follows all arms and publishes them to a sink as one robot.

    Args:
        sink: publishes the group.
        name: name of this node as commander.
        rate_hz: joint samples per second.
        describe: called with the URDF of all arms when they are connected.
        directory: as in `GroupRobot`.
    """

    def __init__(
        self, sink: Sink, name: str, rate_hz: float, describe: Callable[[str], None], directory: Path | None = None
    ) -> None:
        self._sink, self._describe = sink, describe
        self._name, self._rate_hz, self._directory = name, rate_hz, directory
        self._parts: list[_Part] = []
        self._publishers: list[StatePublisher] = []
        self._retry_at = 0.0

    def step(self, wait_s: float) -> None:
        """Wait for new records, and publish what is due."""
        if not self._publishers and time.monotonic() >= self._retry_at:
            self._retry_at = time.monotonic() + 1.0
            with contextlib.suppress(RtcpError):
                cell = find_cell(directory=self._directory)
                self._parts = [_Part(self, arm.name) for arm in cell.arms]
                self._publishers = [
                    StatePublisher(part, _opens(arm.directory), self._rate_hz, self._name)
                    for part, arm in zip(self._parts, cell.arms, strict=True)
                ]
                self._publishers += [
                    StatePublisher(_Part(self, member.name), _opens(member.directory), self._rate_hz, self._name)
                    for member in cell.processes
                ]
                self._describe(group_urdf(cell))
        if not self._publishers:
            time.sleep(wait_s)
        for publisher in self._publishers:
            publisher.step(wait_s / len(self._publishers))

    def close(self) -> None:
        """Close the connections to the records."""
        for publisher in self._publishers:
            publisher.close()

    def joints(self, part: _Part) -> None:
        """Publish the merged sample when the first arm has a new one; an arm with a sample 0.5 s older is left out."""
        newest = part.sample
        if part is not self._parts[0] or newest is None:
            return
        fresh = [
            (part.names, sample)
            for part in self._parts
            if (sample := part.sample) is not None and abs(sample.stamp_ns - newest.stamp_ns) < _STALE_NS
        ]
        names = tuple(name for of_arm, _ in fresh for name in of_arm)

        def joined(field: str) -> tuple[float, ...]:
            rows = [getattr(sample, field) for _, sample in fresh]
            return tuple(number for row in rows for number in row) if all(rows) else ()

        self._sink.joints(
            names,
            JointSample(newest.stamp_ns, joined("position"), joined("velocity"), joined("effort"), joined("commanded")),
        )

    def status(self, part: _Part) -> None:
        """Publish the merged status of the arms: in motion or in error if one is, motion possible if it is for all."""
        statuses = [part.robot for part in self._parts if part.robot is not None]
        if part not in self._parts or len(statuses) < len(self._parts):
            return
        self._sink.status(
            RobotStatus(
                stamp_ns=max(status.stamp_ns for status in statuses),
                speed_override=min(status.speed_override for status in statuses),
                **merged(statuses),
            )
        )

    def diagnostics(self, diagnostics: Diagnostics, member: str) -> None:
        """Publish the diagnostics of a platform, with its name."""
        self._sink.diagnostics(dataclasses.replace(diagnostics, message=f"{member}: {diagnostics.message}"))

    def channels(self, sample: ChannelSample, prefix: str) -> None:
        """Publish the channels of an arm, its name before those of the slaves."""
        values = {prefix + slave: channels for slave, channels in sample.values.items()}
        settable = [(prefix + slave, name) for slave, name in sample.settable]
        self._sink.channels(ChannelSample(sample.stamp_ns, values, settable))

    def processes(self, entries: Mapping[str, Diagnostics], member: str) -> None:
        """Publish the processes of a platform."""
        self._sink.processes({ros_name(name, member): entry for name, entry in entries.items()})

    def serve(self, services: Sequence[ProcessService], member: str) -> None:
        """Offer the commands of the processes of a platform."""
        self._sink.serve([dataclasses.replace(service, member=member) for service in services])


class _Part:
    """Sink of one platform: keeps its newest sample and status, with prefixed names, and notifies the group."""

    def __init__(self, group: GroupStates, member: str) -> None:
        self._group, self._member = group, member
        self.names: tuple[str, ...] = ()
        self.sample: JointSample | None = None
        self.robot: RobotStatus | None = None

    def connected(self, config: ArmConfig) -> None:
        """Do nothing: the group describes itself."""

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        """Store a sample."""
        self.names = tuple(f"{self._member}_{name}" for name in names)
        self.sample = sample
        self._group.joints(self)

    def status(self, status: RobotStatus) -> None:
        """Store a status."""
        self.robot = status
        self._group.status(self)

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        """Publish diagnostics."""
        self._group.diagnostics(diagnostics, self._member)

    def channels(self, sample: ChannelSample) -> None:
        """Publish channels."""
        self._group.channels(sample, f"{self._member}_")

    def processes(self, entries: Mapping[str, Diagnostics]) -> None:
        """Publish processes."""
        self._group.processes(entries, self._member)

    def serve(self, services: Sequence[ProcessService]) -> None:
        """Offer commands of processes."""
        self._group.serve(services, self._member)


def _opens(directory: Path) -> Callable[[], Feed]:
    return lambda: Feed(directory)


def connects(name: str, group: bool) -> Connect:
    """Return the function that connects a commander to the platform of the environment, or to all arms of its cell."""
    if group:
        return lambda: cast(contextlib.AbstractAsyncContextManager[AsyncRobot], GroupRobot(name))
    return lambda: connect_async(name, disable_when_lost=True)
