"""All arms of a cell as one group of joints for ROS: `left_joint_1` and so on, in the order of the cell's file.

`GroupRobot` is to `rtcp.ros.commands.Commander` what a connection to one arm is; its motions are in step.
`GroupStates` makes one sample and one status of those of the arms. The URDF has all arms on one world.
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
from types import TracebackType
from typing import Any, Final, TypeVar, cast

from kinematics.pose import Pose
from kinematics.urdf import fixed_axes_rpy, to_urdf
from rtcp.api import Arrival, AsyncRobot, Progress, RtcpError, State, Stream
from rtcp.api.async_robot import connect_async
from rtcp.api.cell import CellStream, StepPlan, find_cell, most_telling
from rtcp.api.feed import Feed
from rtcp.api.results import result
from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.fieldbus.simple_message.messages import RobotMode, TriState
from rtcp.ipc.runtime_directory import control_socket
from rtcp.ros.commands import Connect
from rtcp.ros.state import ChannelSample, Diagnostics, JointSample, RobotStatus, Sink, StatePublisher

T = TypeVar("T")
Numbers = Sequence[float]
_STALE_NS: Final = 500_000_000
_WORST = (
    State.EMERGENCY_STOP, State.FAULT, State.RESETTING, State.STARTING, State.CLOSING, State.OFF,
    State.STOPPED_BY_LIMIT, State.DISABLING, State.READY, State.ENABLING, State.STOPPING, State.HOMING, State.MOVING,
    State.HOLDING,
)  # fmt: skip
"""The state of the group is the first of these in which an arm is."""


def joint_names(cell: CellConfig) -> tuple[str, ...]:
    """Return the names of all joints: those of an arm behind the arm's."""
    return tuple(f"{arm.name}_{joint.name}" for arm in cell.arms for joint in arm.config.joints)


def group_urdf(cell: CellConfig) -> str:
    """Return all arms whose geometry is known as one URDF document, the arm's name before those of links and joints."""
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
    """What a commander looks at: the worst state, and the joints of all arms."""

    state: State
    joint_names: tuple[str, ...]
    commanded_positions: tuple[float, ...]


class GroupStream:
    """A stream of all joints in step; methods as of `Stream`.

    Args:
        stream: of the arms.
        counts: of the joints of each.
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
    """Return the numbers of each arm."""
    found, at = {}, 0
    for name, count in counts.items():
        found[name] = list(numbers[at : at + count])
        at += count
    return found


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

    async def __aenter__(self) -> GroupRobot:
        """Connect to all arms; raises NotRunning."""
        cell = find_cell(directory=self._directory)
        self._names = joint_names(cell)
        try:
            for arm in cell.arms:
                robot = AsyncRobot(self._name, control_socket(arm.directory), disable_when_lost=True)
                self._arms[arm.name] = await self._closing.enter_async_context(robot)
                self._counts[arm.name] = len(arm.config.joints)
        except BaseException:
            await self._closing.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._closing.aclose()

    @property
    def is_open(self) -> bool:
        """Whether all connections stand."""
        return all(robot.is_open for robot in self._arms.values())

    async def status(self) -> GroupStatus:
        """Return the worst state, and where all joints are commanded."""
        found = await self._all(AsyncRobot.status)
        states = {one.state for one in found.values()}
        state = next(one for one in _WORST if one in states)
        return GroupStatus(state, self._names, tuple(q for one in found.values() for q in one.commanded_positions))

    async def enable(self) -> None:
        """Enable the arms that are ready."""
        await self._all(_enable)

    async def disable(self) -> None:
        """Stop all arms and remove their torque."""
        await self._all(AsyncRobot.disable)

    async def reset(self) -> State:
        """Leave the faults of all arms; return the worst state that was left."""
        left = await self._all(AsyncRobot.reset)
        return next(one for one in _WORST if one in left.values())

    async def set_speed_override(self, fraction: float) -> None:
        """Set it of all arms; below 1 motions in step are refused."""
        await self._all(lambda robot: robot.set_speed_override(fraction))

    async def set_output(self, output: str, value: float) -> None:
        """Set an output of one arm: the arm's name and an underscore before the output's."""
        for name, robot in self._arms.items():
            if output.startswith(f"{name}_"):
                await robot.set_output(output.removeprefix(f"{name}_"), value)
                return
        text = f"name: found {output!r}, allowed is the name of an output behind one of {', '.join(self._arms)} and _"
        raise RtcpError("invalid", text, "unknown_terminal", {"name": output})

    async def halt(self) -> None:
        """Stop every motion."""
        await self._all(AsyncRobot.halt)

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
            RtcpError: as `Cell.run_trajectory`; `refused`, unsupported_tolerance: of the path, which no arm supervises
                in step.
        """
        if any(path_tolerance):
            raise RtcpError("refused", "a motion in step has no tolerance of its path", "unsupported_tolerance")
        status = await self.status()
        if status.state in (State.MOVING, State.STOPPING):
            await self.halt()
            status = await self.status()
        here = status.commanded_positions
        given = [dict(point) for point in points]
        first = given[0]
        if first["t"] > 0.0:
            # Every arm begins at time 0, where it stands.
            at_rest: dict[str, Any] = {key: [0.0] * len(here) for key in ("v", "a") if key in first}
            given.insert(0, {"t": 0.0, "q": list(here), **at_rest})
        elif max(abs(a - b) for a, b in zip(first["q"], here, strict=True)) <= start_tolerance:
            first["q"] = list(here)
        targets = [{"arm": name, "points": some} for name, some in self._by_arm(given).items()]
        robot, asked_ns = next(iter(self._arms.values())), time.monotonic_ns()
        plan = StepPlan.from_json(await robot.command("plan_in_step", targets=targets), asked_ns)
        motion = time.monotonic_ns()
        accepted: set[str] = set()

        async def run(name: str) -> Arrival:
            def report(found: Progress) -> None:
                if found.accepted and name not in accepted:
                    accepted.add(name)
                    if len(accepted) == len(self._arms) and progress is not None:
                        progress(found)

            fields = plan.fields_of(name, motion)
            return result(Arrival, await self._arms[name].command("run_in_step", report, **fields))

        arrived = await _gather({name: run(name) for name in self._arms})
        positions = tuple(q for one in arrived.values() for q in one.positions)
        largest = max(one.error for one in arrived.values())
        ends = given[-1]["q"]
        for i, (name, allowed) in enumerate(zip(self._names, goal_tolerance, strict=False)):
            if allowed and abs(positions[i] - ends[i]) > allowed:
                fields = {"axis": i, "error": abs(positions[i] - ends[i]), "limit": allowed}
                message = f"{name} is {fields['error']:.4f} rad from its goal, allowed are {allowed:g} rad"
                raise RtcpError("fault", message, "goal_tolerance_violated", fields)
        return dataclasses.replace(next(iter(arrived.values())), positions=positions, error=largest)

    async def open_stream(self) -> GroupStream:
        """Begin a stream of all joints in step."""
        motion = time.monotonic_ns()

        async def open_one(name: str) -> Stream:
            partners = [other for other in self._arms if other != name]
            found = await self._arms[name].command("open_stream", motion=motion, partners=partners)
            return Stream.from_json(found)

        opened: dict[str, Stream] = {}

        async def keep(name: str) -> None:
            opened[name] = await open_one(name)

        try:
            await _gather({name: keep(name) for name in self._arms})
        except BaseException:
            for stream in opened.values():
                stream.close()
            raise
        return GroupStream(CellStream({name: opened[name] for name in self._arms}), self._counts)

    async def open_trajectory(self, points: Sequence[Mapping[str, Any]], replace: bool = False) -> None:
        """Refuse: a trajectory in step is planned whole."""
        raise RtcpError("refused", "a cell takes no open trajectories: leave --buffer out", "unsupported")

    async def append(self, points: Sequence[Mapping[str, Any]]) -> None:
        """Refuse, as `open_trajectory`."""
        await self.open_trajectory(points)

    def _by_arm(self, points: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, Any]]]:
        found: dict[str, list[dict[str, Any]]] = {name: [] for name in self._counts}
        for point in points:
            parts = {key: split(point[key], self._counts) for key in ("q", "v", "a") if key in point}
            for name, some in found.items():
                some.append({"t": point["t"], **{key: part[name] for key, part in parts.items()}})
        return found

    async def _all(self, call: Callable[[AsyncRobot], Coroutine[Any, Any, T]]) -> dict[str, T]:
        return await _gather({name: call(robot) for name, robot in self._arms.items()})


async def _enable(robot: AsyncRobot) -> None:
    if await robot.state() is State.READY:
        await robot.enable()


async def _gather(calls: Mapping[str, Coroutine[Any, Any, T]]) -> dict[str, T]:
    """Await all; raise the error that says most, with the arm's name, when all have ended. Cancelled, all are."""
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


class GroupStates:
    """Follows all arms, and tells a sink of them as of one robot.

    Args:
        sink: who publishes.
        name: of this node as commander.
        rate_hz: joint samples a second.
        describe: called with the URDF of all arms once they are reached.
        directory: as of `GroupRobot`.
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
                self._parts = [_Part(self, f"{arm.name}_") for arm in cell.arms]
                self._publishers = [
                    StatePublisher(part, _opens(arm.directory), self._rate_hz, self._name)
                    for part, arm in zip(self._parts, cell.arms, strict=True)
                ]
                self._describe(group_urdf(cell))
        if not self._publishers:
            time.sleep(wait_s)
        for publisher in self._publishers:
            publisher.step(wait_s / len(self._publishers))

    def close(self) -> None:
        """Let go of the records."""
        for publisher in self._publishers:
            publisher.close()

    def joints(self, part: _Part) -> None:
        """Publish a sample of all, when the first arm has a new one; an arm that is silent is left out."""
        newest = part.sample
        if part is not self._parts[0] or newest is None:
            return
        fresh = [
            (one.names, sample)
            for one in self._parts
            if (sample := one.sample) is not None and abs(sample.stamp_ns - newest.stamp_ns) < _STALE_NS
        ]
        names = tuple(name for of_arm, _ in fresh for name in of_arm)

        def joined(which: str) -> tuple[float, ...]:
            return tuple(number for _, sample in fresh for number in getattr(sample, which))

        self._sink.joints(
            names,
            JointSample(newest.stamp_ns, joined("position"), joined("velocity"), joined("effort"), joined("commanded")),
        )

    def status(self) -> None:
        """Publish the status of all: an error or a motion of one is the group's, possible is what all can."""
        found = [one.robot for one in self._parts if one.robot is not None]
        if len(found) < len(self._parts):
            return

        def any_of(which: str) -> TriState:
            values = {getattr(one, which) for one in found}
            return next(one for one in (TriState.TRUE, TriState.UNKNOWN, TriState.FALSE) if one in values)

        def all_of(which: str) -> TriState:
            values = {getattr(one, which) for one in found}
            return next(one for one in (TriState.FALSE, TriState.UNKNOWN, TriState.TRUE) if one in values)

        modes = {one.mode for one in found}
        self._sink.status(
            RobotStatus(
                max(one.stamp_ns for one in found), modes.pop() if len(modes) == 1 else RobotMode.UNKNOWN,
                any_of("e_stopped"), all_of("drives_powered"), all_of("motion_possible"), any_of("in_motion"),
                any_of("in_error"), next((one.error_code for one in found if one.error_code), 0),
                min(one.speed_override for one in found),
            )
        )  # fmt: skip

    def diagnostics(self, diagnostics: Diagnostics, prefix: str) -> None:
        """Publish the diagnostics of an arm, with its name."""
        self._sink.diagnostics(dataclasses.replace(diagnostics, message=f"{prefix.rstrip('_')}: {diagnostics.message}"))

    def channels(self, sample: ChannelSample, prefix: str) -> None:
        """Publish the channels of an arm, its name before those of the slaves."""
        values = {prefix + slave: found for slave, found in sample.values.items()}
        settable = [(prefix + slave, name) for slave, name in sample.settable]
        self._sink.channels(ChannelSample(sample.stamp_ns, values, settable))


class _Part:
    """The newest that one arm has said."""

    def __init__(self, group: GroupStates, prefix: str) -> None:
        self._group, self._prefix = group, prefix
        self.names: tuple[str, ...] = ()
        self.sample: JointSample | None = None
        self.robot: RobotStatus | None = None

    def connected(self, config: ArmConfig) -> None:
        """Do nothing: the group describes itself."""

    def joints(self, names: tuple[str, ...], sample: JointSample) -> None:
        """Take a sample."""
        self.names = tuple(self._prefix + name for name in names)
        self.sample = sample
        self._group.joints(self)

    def status(self, status: RobotStatus) -> None:
        """Take a status."""
        self.robot = status
        self._group.status()

    def diagnostics(self, diagnostics: Diagnostics) -> None:
        """Pass them on."""
        self._group.diagnostics(diagnostics, self._prefix)

    def channels(self, sample: ChannelSample) -> None:
        """Pass them on."""
        self._group.channels(sample, self._prefix)


def _opens(directory: Path) -> Callable[[], Feed]:
    return lambda: Feed(directory)


def connects(name: str, group: bool) -> Connect:
    """Return what connects a commander: to the platform of the environment, or to all arms of its cell."""
    if group:
        return lambda: cast(contextlib.AbstractAsyncContextManager[AsyncRobot], GroupRobot(name))
    return lambda: connect_async(name, disable_when_lost=True)
