"""A cell: several arms, commanded together (`docs/cell.md`). Each is a `Robot`; motions in step are the cell's."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rtcp.api.results import Arrival, Status, result
from rtcp.api.robot import Robot
from rtcp.config.cell import CellConfig, Member
from rtcp.ipc.client import ControlClient
from rtcp.ipc.closing import Closing
from rtcp.ipc.errors import NotRunning, RtcpError
from rtcp.ipc.runtime_directory import control_socket, runtime_directory
from rtcp.ipc.session import SessionError, read_session

if TYPE_CHECKING:
    from rtcp.api.stream import Stream

T = TypeVar("T")
_LEAD_S, _LONGEST_LEAD_S = 0.25, 9.0
"""Bounds of the time from the command of a motion in step to its start, s: arms check it meanwhile, and allow 10 s."""
_INTERRUPT_S: Final = 3.0
"""Longest wait after an interrupt for a halt and for the calls that it ends, s."""
_LEAD_SHARE: Final = 3.0
"""Lead per planning time: checking takes about as long as planning."""
_SAYS_LESS = {"partner_stopped": 2, "partner_not_ready": 2, "partner_left": 1, "partner_silent": 1}
"""Reasons that only point to another arm, whose own reason tells more -> rank, the higher the less telling."""


@dataclass(frozen=True)
class StepPlan:
    """A planned motion in step.

    arms: points of each. duration_s: of all. brakes: times of the group's brakes, s, every `brake_step_s` of the path.
    lead_s: how long after it was commanded it begins.
    """

    arms: Mapping[str, Sequence[Mapping[str, Any]]]
    duration_s: float
    brakes: Sequence[float]
    brake_step_s: float
    lead_s: float

    @classmethod
    def from_json(cls, answer: Mapping[str, Any], asked_ns: int) -> StepPlan:
        """Read the answer of the method `plan_in_step`, asked for at `asked_ns`, CLOCK_MONOTONIC."""
        arms = {arm["arm"]: arm["points"] for arm in answer["arms"]}
        took_s = 1e-9 * (time.monotonic_ns() - asked_ns)
        lead_s = min(max(_LEAD_S, _LEAD_SHARE * took_s), _LONGEST_LEAD_S)
        return cls(arms, answer["duration_s"], answer["brakes"], answer["brake_step_s"], lead_s)

    def fields_of(self, arm: str, motion: int) -> dict[str, Any]:
        """Return the parameters of `run_in_step` for an arm; `motion`: when it was commanded, CLOCK_MONOTONIC, ns."""
        return {
            "points": [{key: value for key, value in point.items() if value is not None} for point in self.arms[arm]],
            "partners": [partner for partner in self.arms if partner != arm],
            "motion": motion,
            "start_ns": motion + round(self.lead_s * 1e9),
            "brakes": list(self.brakes),
            "brake_step_s": self.brake_step_s,
        }


def rod_file(cell: Path) -> Path:
    """Return the file in the runtime directory of a cell with the rod that its arms are to bend.

    It has `pid`, its writer, and `curves`, each a list of points in the world, m.
    """
    return cell / "rod.json"


def find_cell(name: str = "", directory: Path | None = None) -> CellConfig:
    """Return the cell whose arms run under a runtime directory, else that of the environment.

    `name`: where there is more than one.

    Raises:
        NotRunning: there is none.
        Refused: there are several, and none is named.
    """
    cells = find_cells(name, directory)
    if len(cells) > 1:
        listed = ", ".join(f"{cell.name} of {cell.source}" for cell in cells)
        raise RtcpError("refused", f"several cells run, {listed}: name one (`rtcp cell --cell NAME`), or stop one")
    return cells[0]


def find_cells(name: str = "", directory: Path | None = None) -> list[CellConfig]:
    """Return all cells, of a `name` where one is given, whose arms run under a runtime directory or the environment's.

    Raises:
        NotRunning: there is none.
    """
    root = runtime_directory("") if directory is None else directory
    cells: dict[int, CellConfig] = {}
    for path in sorted(root.glob("*/session.json")):
        with contextlib.suppress(SessionError):
            cell = read_session(path.parent).cell
            if cell is not None and name in ("", cell.name) and control_socket(path.parent).exists():
                cells[cell.digest] = cell
    if cells:
        return list(cells.values())
    description = f"the cell {name}" if name else "a cell"
    raise NotRunning("not running", f"no arm of {description} is running (runtime directory {root}): `rtcp cell start`")


def cell_of_this_arm() -> tuple[CellConfig, Member] | None:
    """Return the cell of the platform that this environment names, and its arm; None: it is in none.

    While the platform itself does not run, the sessions of its partners are read.
    """
    own, root = runtime_directory().absolute(), runtime_directory("").absolute()
    if own == root:
        return None
    partners = (path.parent for path in sorted(root.glob("*/session.json")) if path.parent != own)
    for directory in (own, *partners):
        if not control_socket(directory).exists():
            continue
        with contextlib.suppress(SessionError):
            cell = read_session(directory).cell
            member = None if cell is None else next((arm for arm in cell.members if arm.directory == own), None)
            if cell is not None and member is not None:
                return cell, member
            if directory == own:
                return None
    return None


class CellStream(Closing):
    """Setpoints of several arms in step: the end of one stream ends all of them.

    Args:
        streams: of the arms, by their names.
    """

    def __init__(self, streams: Mapping[str, Stream]) -> None:
        self.streams = dict(streams)

    @property
    def is_open(self) -> bool:
        """Whether all arms follow it."""
        return all(stream.is_open for stream in self.streams.values())

    def send(
        self,
        q: Mapping[str, Sequence[float]],
        velocity: Mapping[str, Sequence[float]] | None = None,
        t: float | None = None,
    ) -> None:
        """Send a setpoint to every arm, with one time stamp.

        Args:
            q: rad, one a joint, by the names of all arms of the stream.
            velocity: of the targets, rad/s; None: it is estimated.
            t: time stamp, s, rising; None: now.

        Raises:
            as `Stream.send`; and Invalid where an arm is missing.
        """
        if q.keys() != self.streams.keys():
            names, allowed = ", ".join(q), ", ".join(self.streams)
            raise RtcpError("invalid", f"q: found the arms {names or 'none'}, allowed are all of {allowed}")
        if velocity is not None and velocity.keys() != self.streams.keys():
            names, allowed = ", ".join(velocity), ", ".join(self.streams)
            raise RtcpError("invalid", f"velocity: found the arms {names or 'none'}, allowed are all of {allowed}")
        stamp = time.monotonic_ns() * 1e-9 if t is None else t
        for name, stream in self.streams.items():
            stream.send(q[name], None if velocity is None else velocity[name], t=stamp)

    def close(self) -> None:
        """Bring all arms to rest and end the stream; a second time is harmless."""
        for stream in self.streams.values():
            stream.close()


class Cell(Closing):
    """The arms of a running cell. Closing it stops its motions.

    Args:
        name: of this commander, shown to others that are refused; empty: this process.
        cell: name of the cell; empty: the one that runs.
        directory: the runtime directory that holds those of the arms; None: that of the environment.

    Attributes:
        arms: a `Robot` for each arm, by its name, in the order of the cell's file.
        processes: a `Robot` for each platform of processes, by its name.

    Raises:
        NotRunning: an arm does not run.
    """

    def __init__(self, name: str = "", cell: str = "", directory: Path | None = None) -> None:
        self.config = find_cell(cell, directory)
        self._name = name
        self.arms: dict[str, Robot] = {}
        self.processes: dict[str, Robot] = {}
        try:
            for members, robots in ((self.config.arms, self.arms), (self.config.processes, self.processes)):
                for member in members:
                    robots[member.name] = Robot(name, control_socket(member.directory))
        except RtcpError:
            self.close()
            raise

    def close(self) -> None:
        """Close all connections; a second time is harmless."""
        for robot in self._members.values():
            robot.close()

    @property
    def _members(self) -> dict[str, Robot]:
        return self.arms | self.processes

    # -- all arms -----------------------------------------------------------------------------------------------------

    def status(self) -> dict[str, Status]:
        """Return the status of each arm."""
        return self._each(Robot.status)

    def enable(self) -> None:
        """Enable all arms; where one cannot be enabled, disable those that this call has enabled."""
        enabled: list[str] = []

        def enable(name: str, robot: Robot) -> None:
            robot.enable()
            enabled.append(name)

        try:
            self._all(enable)
        except RtcpError:
            for name in enabled:
                with contextlib.suppress(RtcpError):
                    self._members[name].disable()
            raise

    def disable(self) -> None:
        """Stop all arms and remove their torque. Needs no lease."""
        self._stop("disable")

    def halt(self) -> None:
        """Stop every motion of every arm, whoever began it. Needs no lease; may be called from any thread."""
        self._stop("halt")

    def reset(self) -> None:
        """Leave the faults of all arms."""
        self._each(Robot.reset)

    def stop(self) -> dict[str, tuple[str, ...]]:
        """End the platforms of all arms; return the steps that failed."""
        return {name: tuple(answer["problems"]) for name, answer in self._stop("stop").items()}

    # -- motions in step ----------------------------------------------------------------------------------------------

    def move_joints(self, q: Mapping[str, Sequence[float]], speed: float | None = None) -> dict[str, Arrival]:
        """Move joints of several arms in step: all begin and end together; return when all are there.

        Args:
            q: rad, base to tool, by the names of the arms.
            speed: of the fastest joint of all, rad/s; None: the limits.

        Raises:
            Refused: a target outside the limits, the wrong state, an arm that does not run: then no arm moves.
            Faulted: it ended before all arrived; all have stopped.
        """
        return self.run(self.plan([{"arm": name, "q": list(joints)} for name, joints in q.items()], speed))

    def run_trajectory(self, points: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Arrival]:
        """Run trajectories of several arms in step: points as of `Robot.run_trajectory`, the first at time 0.

        Raises:
            as `move_joints`.
        """
        targets = [{"arm": name, "points": [dict(point) for point in waypoints]} for name, waypoints in points.items()]
        return self.run(self.plan(targets))

    def plan(self, targets: Sequence[Mapping[str, Any]], speed: float | None = None) -> StepPlan:
        """Plan a motion in step and move nothing; targets with `arm` and `q` or `points`."""
        robot, asked_ns = next(iter(self.arms.values())), time.monotonic_ns()
        answer = robot.command("plan_in_step", targets=[dict(target) for target in targets], speed=speed)
        return StepPlan.from_json(answer, asked_ns)

    def run(self, plan: StepPlan) -> dict[str, Arrival]:
        """Run a planned motion; return when all arms are there."""
        motion = time.monotonic_ns()

        def run(name: str, robot: Robot) -> Arrival:
            return result(Arrival, robot.command("run_in_step", **plan.fields_of(name, motion)))

        return self._all(run, plan.arms)

    def open_stream(self, arms: Sequence[str] = ()) -> CellStream:
        """Begin a stream of setpoints for several arms in step, all of them where none is named; leave it to end it.

        Raises:
            Refused: as any motion, or an arm that does not run.
        """
        from rtcp.api.stream import Stream  # here: numpy loads slowly, and a command has no use for it

        names = list(arms) or list(self.arms)
        if unknown := [name for name in names if name not in self.arms]:
            allowed = ", ".join(self.arms)
            raise RtcpError("invalid", f"arms: found {unknown[0]!r:.40}, allowed is a list of some of {allowed}")
        motion = time.monotonic_ns()

        def open_one(name: str, robot: Robot) -> Stream:
            partners = [partner for partner in names if partner != name]
            return Stream.from_json(robot.command("open_stream", motion=motion, partners=partners))

        opened: dict[str, Stream] = {}

        def keep(name: str, robot: Robot) -> None:
            opened[name] = open_one(name, robot)

        try:
            self._all(keep, dict.fromkeys(names))
        except RtcpError:
            for stream in opened.values():
                stream.close()
            raise
        return CellStream({name: opened[name] for name in names})

    # -- in parallel --------------------------------------------------------------------------------------------------

    def _halt_quietly(self) -> None:
        with contextlib.suppress(RtcpError):
            self.halt()

    def _each(self, call: Callable[[Robot], T]) -> dict[str, T]:
        return self._all(lambda name, robot: call(robot))

    def _stop(self, method: str) -> dict[str, dict[str, Any]]:
        """Stop every arm over new connections: those of this cell may be waiting, or may have ended."""

        def stop(name: str, robot: Robot) -> dict[str, Any]:
            with ControlClient(self._name, control_socket(robot.directory)) as client:
                return client.call(method)

        return self._all(stop)

    def _all(self, call: Callable[[str, Robot], T], names: Mapping[str, object] | None = None) -> dict[str, T]:
        """Call a function for several members at once; raise the most telling error when all have returned."""
        members = self._members
        chosen = [name for name in members if names is None or name in names]
        if not chosen:
            return {}
        futures: dict[str, Future[T]] = {name: Future() for name in chosen}

        def work(name: str) -> None:
            try:
                futures[name].set_result(call(name, members[name]))
            except BaseException as error:
                futures[name].set_exception(error)

        threads = [begin_thread(work, name) for name in chosen]
        try:
            errors = {name: future.exception() for name, future in futures.items()}
        except BaseException:
            # Bounded: a frozen gateway must not block the interrupt.
            until = time.monotonic() + _INTERRUPT_S
            for thread in (begin_thread(self._halt_quietly), *threads):
                thread.join(max(0.0, until - time.monotonic()))
            raise
        failed = {name: error for name, error in errors.items() if error is not None}
        if not failed:
            return {name: future.result() for name, future in futures.items()}
        raise most_telling(failed)


def begin_thread(call: Callable[..., None], *arguments: Any) -> Thread:
    """Start a thread that does not keep the process alive."""
    thread = Thread(target=call, args=arguments, daemon=True)
    thread.start()
    return thread


def most_telling(failed: Mapping[str, BaseException]) -> BaseException:
    """Return the most telling of the errors of several arms, at least one, with its arm's name."""
    first = min(failed, key=lambda name: _SAYS_LESS.get(getattr(failed[name], "reason", ""), 0))
    error = failed[first]
    if isinstance(error, RtcpError):
        return RtcpError(error.kind, f"{first}: {error.message}", error.reason, error.fields)
    return error


def connect_cell(name: str = "", cell: str = "", directory: Path | None = None) -> Cell:
    """Connect to the running cell; arguments and errors as of `Cell`."""
    return Cell(name, cell, directory)
