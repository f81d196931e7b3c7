"""Programs: the steps of a motion file, checked and planned whole, then carried out one after the other by a robot."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rtcp.api.results import Preview
from rtcp.ipc.errors import RtcpError

if TYPE_CHECKING:
    from rtcp.api.robot import Robot
    from rtcp.config.model import NamedPose, Step

_PLANNED_TIMES: Final = 2
"""Largest number of runs of a part that are planned: the first begins elsewhere, all others where the part ends."""
_MOST_PLANNED: Final = 10_000
_SAME_RAD: Final = 1e-3
_WAIT_S: Final = 0.1
"""Interval between checks for the end of a program while a step waits for a time, s."""
_ENDS: Final = frozenset({
    "halted_at_rest", "disabled", "torque_removed", "stopped_by_limit", "limit_stop_reset", "reset_done",
    "control_mode_changed",
})  # fmt: skip
"""Events that end a program, beside faults and emergency stops: after them nobody expects the arm to continue."""
_FAULTS: Final = ("fault", "emergency_stop")
_ALREADY_THERE: Final = "AlreadyThere"
"""Reason of a refused motion whose target is where the arm is."""
Where = tuple[str | int, ...]
"""Keys to a step in its file."""


@dataclass(frozen=True)
class Motion:
    """Motions of one or more steps, blended into one path.

    number: of the first step in the program, from 0. where: keys to that step in the file. stops: the argument of
    `Robot.run_path`.
    """

    number: int
    where: Where
    stops: tuple[dict[str, Any], ...]


@dataclass(frozen=True)
class Action:
    """A step that is no motion."""

    number: int
    where: Where
    step: Step


@dataclass(frozen=True)
class Begun:
    """The start of a step: `text` describes it, `line` is its line in the file.

    number: of the step in the program, from 0; of a part that runs, the step that runs it.
    """

    number: int
    line: int
    text: str


@dataclass(frozen=True)
class PlannedMotion:
    """A motion as it was planned: its line in the file, and the plan."""

    line: int
    plan: Preview


@dataclass
class _Expected:
    """The state in which a program left the arm."""

    positions: Sequence[float]
    """Commanded joint positions, rad."""
    tool: str
    event: int
    """Number of the newest event that was seen."""


class Program:
    """A program of a motion file (`docs/motion.md`).

    Args:
        file: its path.

    Raises:
        ConfigError: one sentence per mistake in the file, with its line; or it holds no program.
    """

    def __init__(self, file: str | Path) -> None:
        # Here: the validator loads slowly, and few programs in Python use a file.
        from rtcp.config.model import ConfigError
        from rtcp.config.motion_file import read_document

        self.file = Path(file)
        self._document, self._motion = read_document(self.file)
        if not self._motion.program:
            raise ConfigError([f"{self.file}: it holds no program: `rtcp run` or `robot.run` run it whole"])
        self._poses: dict[str, NamedPose] = {pose.name: pose for pose in self._motion.poses}
        self._parts = {part.name: (at, part.steps) for at, part in enumerate(self._motion.parts)}

    @property
    def steps(self) -> tuple[Step, ...]:
        """The steps of the program, without those of its parts."""
        return self._motion.program

    def line_of(self, where: Where) -> int:
        """Return the line of a step in the file."""
        return self._document.line(where)

    def check(self, robot: Robot, start: int = 0, end: int | None = None) -> list[PlannedMotion]:
        """Plan all motions one after the other from where the arm is commanded; nothing moves.

        A part that runs several times is planned twice.

        Args:
            robot: plans the motions.
            start: step to begin with, from 0.
            end: step before which to end; None: behind the last.

        Raises:
            Refused: a motion cannot be carried out; the sentence begins with the line of its first step.
        """
        self._check_tool(robot, start)
        self._check_terminals(robot, start, end)
        self._check_axes(robot, start, end)
        places = self._places(robot)
        q: Sequence[float] = robot.status().commanded_positions
        with_tool: dict[str, Any] = {}
        planned: list[PlannedMotion] = []
        for number, unit in enumerate(self._units(places, _PLANNED_TIMES, start, end)):
            if number == _MOST_PLANNED:
                raise RtcpError("refused", f"{self.file}: it has more than {_MOST_PLANNED} steps", "program")
            if isinstance(unit, Action):
                if unit.step.tool is not None:
                    with_tool["tool"] = unit.step.tool
                continue
            line = self.line_of(unit.where)
            try:
                plan = robot.preview(stops=unit.stops, start=q, speed=self._motion.speed, **with_tool)
            except RtcpError as error:
                if error.reason == _ALREADY_THERE:
                    continue
                raise RtcpError(
                    error.kind, f"{self.file}:{line}: {error.message}", error.reason, error.fields
                ) from None
            planned.append(PlannedMotion(line, plan))
            q = plan.path[-1]
        return planned

    def run(
        self,
        robot: Robot,
        say: Callable[[Begun], None] = lambda begun: None,
        check: bool = True,
        start: int = 0,
        end: int | None = None,
        between: Callable[[], None] = lambda: None,
    ) -> None:
        """Carry out the program; an early end stops the arm.

        Args:
            robot: enabled, in control mode `joint` or `cartesian`.
            say: called at the start of each step.
            check: plan all of it first.
            start: step to begin with, from 0, from wherever the arm is.
            end: step before which to end; None: behind the last.
            between: called before each step, and every 0.1 s while a step waits for a time: the program continues when
                it returns, and ends with the exception that it raises.

        Raises:
            Refused: as `check`; or a step is refused.
            RtcpError: the cause of an early end.
        """
        status = robot.status()
        newest = max((event.number for event in robot.events()), default=0)
        expected = _Expected(status.commanded_positions, status.tool, newest)
        if check:
            self.check(robot, start, end)
        else:
            self._check_tool(robot, start)
            self._check_terminals(robot, start, end)
            self._check_axes(robot, start, end)
        try:
            self._run_units(robot, say, start, end, between, expected)
        finally:
            self._stop_axes(robot)

    def _run_units(
        self,
        robot: Robot,
        say: Callable[[Begun], None],
        start: int,
        end: int | None,
        between: Callable[[], None],
        expected: _Expected,
    ) -> None:
        for unit in self._units(self._places(robot), None, start, end):
            between()
            line = self.line_of(unit.where)
            self._check_undisturbed(robot, line, expected)
            if isinstance(unit, Motion):
                text = f"{len(unit.stops)} motions in one" if len(unit.stops) > 1 else "motion"
                say(Begun(unit.number, line, text))
                _carry_out(robot, unit.stops, self._motion.speed)
                expected.positions = robot.status().commanded_positions
            else:
                say(Begun(unit.number, line, _described(unit.step)))
                if unit.step.wait_s is not None:
                    self._wait(unit.step.wait_s, between, partial(self._check_undisturbed, robot, line, expected))
                _act(robot, unit.step)
                expected.tool = unit.step.tool or expected.tool

    def _stop_axes(self, robot: Robot) -> None:
        """Stop the axes that steps of the program run."""
        every = [*self._motion.program, *(step for part in self._motion.parts for step in part.steps)]
        for axis in dict.fromkeys(step.axis for step in every if step.axis is not None and step.velocity):
            with contextlib.suppress(RtcpError):  # the connection that has ended has stopped them
                robot.stop_axis(axis)

    def step_back(self, robot: Robot, number: int) -> None:
        """Move back to where step `number`, from 0, began: along its line or arc, else by the joints.

        A step that is no motion is not undone.

        Raises:
            Refused: reason `no_way_back`: no motion stands before it, or it is, or follows, an arc with an angle.
        """
        if not 0 <= number < len(self.steps):
            message = f"{self.file}: found step {number + 1}, allowed is 1 to {len(self.steps)}"
            raise RtcpError("invalid", message, "no_such_step")
        step, line = self._motion.program[number], self.line_of(("program", number))
        if step.run is None and _target(step) is None:
            return
        done = [previous for _, _, previous in self._steps(0, number, 1) if previous is not None]
        before = [at for at, previous in enumerate(done) if _target(previous) is not None]
        why = ""
        if not before:
            why = "no motion stands before it"
        elif step.angle is not None or done[before[-1]].angle is not None:
            why = "it is, or follows, an arc with an angle"
        elif any(earlier.tool is not None for earlier in done[before[-1] :]):
            why = "another tool was chosen before it"
        if why:
            raise RtcpError("refused", f"{self.file}:{line}: no way back over this step: {why}", "no_way_back")
        name = _target(done[before[-1]])
        back = dataclasses.replace(
            step,
            move=name if step.line is None and step.arc is None else None,
            line=name if step.line is not None else None,
            arc=name if step.arc is not None else None,
            blend=0.0,
            run=None,
            times=1,
        )
        self._check_tool(robot, number)
        stop = self._stop(back, self._places(robot))
        assert stop is not None
        _carry_out(robot, [stop], self._motion.speed)

    def _check_tool(self, robot: Robot, number: int) -> None:
        """Raise where the steps before have chosen another tool than the one in use: poses hold for one tool."""
        steps = (step for _, _, step in self._steps(0, number, 1))
        chosen = [step.tool for step in steps if step is not None and step.tool is not None]
        if chosen and (in_use := robot.status().tool) != chosen[-1]:
            text = f"the program uses the tool {chosen[-1]} there, in use is {in_use}: choose it first"
            raise RtcpError("refused", f"{self.file}:{self.line_of(('program', number))}: {text}", "another_tool")

    def _check_terminals(self, robot: Robot, start: int, end: int | None) -> None:
        """Raise where a step names an input or output that does not exist, or an output that has a function."""
        steps = [(where, step) for _, where, step in self._steps(start, end, 1) if step is not None]
        if not any(step.output is not None or step.wait_for is not None for _, step in steps):
            return
        terminals = robot.read_io()
        inputs, outputs = terminals.inputs, terminals.outputs
        # The names, then `box.number`, which every terminal has too.
        settable = dict.fromkeys(
            name for name in (*outputs, *outputs.places.values()) if not outputs.has_function(name)
        )
        readable = dict.fromkeys((*inputs, *outputs, *inputs.places.values(), *outputs.places.values()))
        for where, step in steps:
            if step.output is not None:
                name, key, allowed = step.output, "output", settable
            elif step.wait_for is not None:
                name, key, allowed = step.wait_for, "wait_for", readable
            else:
                continue
            if name not in allowed:
                text = f'{key}: found the text "{name}", allowed is one of {", ".join(allowed) or "none"}'
                raise RtcpError("refused", f"{self.file}:{self.line_of(where)}: {text}", "unknown_terminal")

    def _check_axes(self, robot: Robot, start: int, end: int | None) -> None:
        """Raise where a step names an external axis that does not exist."""
        named = [(where, step.axis) for _, where, step in self._steps(start, end, 1) if step is not None and step.axis]
        known = robot.status().axes if named else {}
        for where, axis in named:
            if axis not in known:
                text = f'axis: found the text "{axis}", allowed is one of {", ".join(known) or "none"}'
                raise RtcpError("refused", f"{self.file}:{self.line_of(where)}: {text}", "unknown_axis")

    @staticmethod
    def _wait(seconds: float, between: Callable[[], None], check: Callable[[], None]) -> None:
        """Wait; raise at once where the program is disturbed."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0:
            time.sleep(min(remaining, _WAIT_S))
            between()
            check()

    def _check_undisturbed(self, robot: Robot, line: int, expected: _Expected) -> None:
        """Raise where the arm was stopped, moved or given another tool by somebody else since the last step."""
        status = robot.status()
        now = status.commanded_positions
        if status.tool != expected.tool:
            text = f"{self.file}:{line}: somebody else has chosen the tool {status.tool} meanwhile: the program ends"
            raise RtcpError("refused", text, "another_tool")
        if max((abs(a - b) for a, b in zip(now, expected.positions, strict=True)), default=0.0) > _SAME_RAD:
            text = f"{self.file}:{line}: the arm was moved by somebody else meanwhile: the program ends"
            raise RtcpError("refused", text, "moved_meanwhile")
        events = robot.events(expected.event)
        for event in events:
            if event.name in _ENDS or event.severity in _FAULTS:
                text = f"{self.file}:{line}: meanwhile: {event.message}; the program ends"
                raise RtcpError("refused", text, "halted" if event.name == "halted_at_rest" else "interrupted")
        if events:
            if events[0].number > expected.event + 1:
                text = (
                    f"{self.file}:{line}: more events than are kept came meanwhile, a stop may be one: the program ends"
                )
                raise RtcpError("refused", text, "interrupted")
            expected.event = events[-1].number

    def _places(self, robot: Robot) -> dict[str, list[float]]:
        """Return x, y, z of the poses through which arcs lead."""
        steps = [*self._motion.program, *(step for part in self._motion.parts for step in part.steps)]
        places: dict[str, list[float]] = {}
        for name in {step.via for step in steps if step.via is not None}:
            pose = self._poses[name]
            values = pose.pose if pose.pose is not None else robot.fk(pose.q or ())
            places[name] = list(values[:3])
        return places

    def _units(
        self, places: dict[str, list[float]], most: int | None, start: int, end: int | None
    ) -> Iterator[Motion | Action]:
        """Yield motions, joined where they are blended, and actions; parts run at most `most` times."""
        first: tuple[int, Where] | None = None
        stops: list[dict[str, Any]] = []
        for number, where, step in self._steps(start, end, most):
            # A part that runs again begins a new motion, so that the plan of two runs holds for any number of them.
            stop = None if step is None else self._stop(step, places)
            if stop is not None:
                first = first or (number, where)
                stops.append(stop)
            if first and (stop is None or not stop["blend"]):
                yield Motion(*first, tuple(stops))
                first, stops = None, []
            if stop is None and step is not None:
                yield Action(number, where, step)
        if first:
            yield Motion(*first, tuple(stops))

    def _steps(self, start: int, end: int | None, most: int | None) -> Iterator[tuple[int, Where, Step | None]]:
        """Yield number in the program, place and step; None behind each run of a part that runs several times."""
        for number, step in list(enumerate(self._motion.program))[start:end]:
            for where, inner in self._inner(("program", number), step, most):
                yield number, where, inner

    def _inner(self, where: Where, step: Step, most: int | None) -> Iterator[tuple[Where, Step | None]]:
        """Yield a step, or those of the part that it runs."""
        if step.run is None:
            yield where, step
            return
        number, steps = self._parts[step.run]
        done = 0
        while (not step.times or done < step.times) and (most is None or done < most):
            for at, inner in enumerate(steps):
                yield from self._inner(("parts", number, "steps", at), inner, most)
            done += 1
            if step.times != 1:
                yield where, None

    def _stop(self, step: Step, places: dict[str, list[float]]) -> dict[str, Any] | None:
        """Return the stop of a motion; None: the step is no motion."""
        name = _target(step)
        if name is None:
            return None
        pose = self._poses[name]
        stop: dict[str, Any] = {"pose": list(pose.pose)} if pose.pose is not None else {"q": list(pose.q or ())}
        stop |= {"blend": step.blend, "by_joints": step.move is not None}
        if step.speed is not None:
            stop["speed"] = step.speed
        if step.via is not None:
            stop |= {"via": places[step.via], "angle": step.angle}
        return stop


def _target(step: Step) -> str | None:
    """Return the name of the pose to which a step moves."""
    return step.move or step.line or step.arc


def _carry_out(robot: Robot, stops: Sequence[dict[str, Any]], speed: float | None) -> None:
    try:
        robot.run_path(stops, speed)
    except RtcpError as error:
        if error.reason != _ALREADY_THERE:
            raise


def _described(step: Step) -> str:
    if step.gripper is not None:
        return f"gripper: {step.gripper}"
    if step.axis is not None:
        return axis_motion(step)
    if step.output is not None:
        return f"output {step.output}: {'on' if step.value else 'off'}"
    if step.wait_for is not None:
        return f"wait until the input {step.wait_for} is {'on' if step.value else 'off'}"
    if step.tool is not None:
        return f"tool: {step.tool}"
    return f"wait {step.wait_s:g} s"


def _act(robot: Robot, step: Step) -> None:
    if step.gripper is not None:
        robot.gripper(step.gripper == "open")
    elif step.axis is not None:
        _act_axis(robot, step, step.axis)
    elif step.output is not None:
        robot.io[step.output] = step.value
    elif step.wait_for is not None:
        robot.io.wait(step.wait_for, step.value, step.timeout_s)
    elif step.tool is not None:
        robot.set_tool(step.tool)


def axis_motion(step: Step) -> str:
    """Return the step of an external axis in words."""
    if step.home:
        return f"axis {step.axis}: home"
    if step.position is not None:
        return f"axis {step.axis}: to {step.position:g}"
    if step.velocity:
        return f"axis {step.axis}: velocity {step.velocity:g} for {step.time_s:g} s"
    return f"axis {step.axis}: stop"


def _act_axis(robot: Robot, step: Step, axis: str) -> None:
    if step.home:
        robot.home_axis(axis)
    elif step.position is not None:
        robot.move_axis(axis, step.position, step.speed)
    elif step.velocity and step.time_s:
        robot.run_axis(axis, step.velocity, step.time_s)
    else:
        robot.stop_axis(axis)
