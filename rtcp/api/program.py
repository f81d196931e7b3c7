"""Programs: the steps of a motion file, checked and planned whole, then carried out one after the other by a robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
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
_HALTED: Final = "halted_at_rest"
_THERE: Final = "AlreadyThere"
"""Reason of a motion that is refused because the arm is where it leads."""
Where = tuple[str | int, ...]
"""Keys to a step in its file."""


@dataclass(frozen=True)
class Motion:
    """Motions of one or more steps that go over into each other: what `Robot.run_path` takes.

    steps: where each stop comes from. stops: of the path.
    """

    steps: tuple[Where, ...]
    stops: tuple[dict[str, Any], ...]


@dataclass(frozen=True)
class Action:
    """A step that is no motion."""

    where: Where
    step: Step


@dataclass(frozen=True)
class PlannedMotion:
    """A motion as it was planned: its line in the file, and the plan."""

    line: int
    plan: Preview


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

    def line_of(self, where: Where) -> int:
        """Return the line of a step in the file."""
        return self._document.line(where)

    def check(self, robot: Robot) -> list[PlannedMotion]:
        """Plan all motions one after the other from where the arm is commanded; nothing moves.

        A part that runs several times is planned twice.

        Raises:
            Refused: a motion cannot be carried out; the sentence begins with the line of its first step.
        """
        places = self._places(robot)
        q: Sequence[float] = robot.status().commanded_positions
        with_tool: dict[str, Any] = {}
        found: list[PlannedMotion] = []
        for number, one in enumerate(self._units(places, _PLANNED_TIMES)):
            if number == _MOST_PLANNED:
                raise RtcpError("refused", f"{self.file}: it has more than {_MOST_PLANNED} steps", "program")
            if isinstance(one, Action):
                if one.step.tool is not None:
                    with_tool["tool"] = one.step.tool
                continue
            line = self.line_of(one.steps[0])
            try:
                plan = robot.preview(stops=one.stops, start=q, speed=self._motion.speed, **with_tool)
            except RtcpError as error:
                if error.reason == _THERE:
                    continue
                raise RtcpError(
                    error.kind, f"{self.file}:{line}: {error.message}", error.reason, error.fields
                ) from None
            found.append(PlannedMotion(line, plan))
            q = plan.path[-1]
        return found

    def run(self, robot: Robot, say: Callable[[int, str], None] = lambda line, text: None, check: bool = True) -> None:
        """Carry out the program; what ends it early stops the arm.

        Args:
            robot: enabled, in control mode `joint` or `cartesian`.
            say: called with the line in the file and what begins there.
            check: plan all of it first.

        Raises:
            Refused: as `check`; or a step is refused.
            RtcpError: what ended it.
        """
        here = robot.status().commanded_positions
        since = max((event.number for event in robot.events()), default=0)
        if check:
            self.check(robot)
        for one in self._units(self._places(robot), None):
            line = self.line_of(one.steps[0] if isinstance(one, Motion) else one.where)
            self._check_undisturbed(robot, line, here, since)
            if isinstance(one, Motion):
                say(line, f"{len(one.stops)} motions in one" if len(one.stops) > 1 else "motion")
                try:
                    robot.run_path(one.stops, self._motion.speed)
                except RtcpError as error:
                    if error.reason != _THERE:
                        raise
                here = robot.status().commanded_positions
            else:
                self._act(robot, one, say)

    def _check_undisturbed(self, robot: Robot, line: int, here: Sequence[float], since: int) -> None:
        """Raise where the arm was halted, or moved by somebody else, since the last step."""
        now = robot.status().commanded_positions
        if max((abs(a - b) for a, b in zip(now, here, strict=True)), default=0.0) > _SAME_RAD:
            text = f"{self.file}:{line}: the arm was moved by somebody else meanwhile: the program ends"
            raise RtcpError("refused", text, "moved_meanwhile")
        if any(event.name == _HALTED for event in robot.events(since)):
            raise RtcpError("refused", f"{self.file}:{line}: the arm was halted: the program ends", "halted")

    def _act(self, robot: Robot, action: Action, say: Callable[[int, str], None]) -> None:
        step, line = action.step, self.line_of(action.where)
        if step.gripper is not None:
            say(line, f"gripper: {step.gripper}")
            robot.gripper(step.gripper == "open")
        elif step.output is not None:
            say(line, f"output {step.output}: {'on' if step.value else 'off'}")
            robot.io[step.output] = step.value
        elif step.wait_for is not None:
            say(line, f"wait until the input {step.wait_for} is {'on' if step.value else 'off'}")
            robot.io.wait(step.wait_for, step.value, step.timeout_s)
        elif step.wait_s is not None:
            say(line, f"wait {step.wait_s:g} s")
            time.sleep(step.wait_s)
        elif step.tool is not None:
            say(line, f"tool: {step.tool}")
            robot.set_tool(step.tool)

    def _places(self, robot: Robot) -> dict[str, list[float]]:
        """Return x, y, z of the poses through which arcs lead."""
        steps = [*self._motion.program, *(step for part in self._motion.parts for step in part.steps)]
        found: dict[str, list[float]] = {}
        for name in {step.via for step in steps if step.via is not None}:
            pose = self._poses[name]
            whole = pose.pose if pose.pose is not None else robot.fk(pose.q or ())
            found[name] = list(whole[:3])
        return found

    def _units(self, places: dict[str, list[float]], most: int | None) -> Iterator[Motion | Action]:
        """Yield motions, joined where they are blended, and actions; parts run at most `most` times."""
        steps: list[Where] = []
        stops: list[dict[str, Any]] = []
        for where, step in self._steps((("program",), self._motion.program), most):
            # A part that runs again begins a motion of its own: what is planned for twice holds for any number.
            stop = None if step is None else self._stop(step, places)
            if stop is not None:
                steps.append(where)
                stops.append(stop)
            if steps and (stop is None or not stop["blend"]):
                yield Motion(tuple(steps), tuple(stops))
                steps, stops = [], []
            if stop is None and step is not None:
                yield Action(where, step)
        if steps:
            yield Motion(tuple(steps), tuple(stops))

    def _steps(self, body: tuple[Where, tuple[Step, ...]], most: int | None) -> Iterator[tuple[Where, Step | None]]:
        """Yield steps; None behind each run of a part that runs several times."""
        above, steps = body
        for at, step in enumerate(steps):
            if step.run is None:
                yield (*above, at), step
                continue
            number, inner = self._parts[step.run]
            done = 0
            while (not step.times or done < step.times) and (most is None or done < most):
                yield from self._steps((("parts", number, "steps"), inner), most)
                done += 1
                if step.times != 1:
                    yield (*above, at), None

    def _stop(self, step: Step, places: dict[str, list[float]]) -> dict[str, Any] | None:
        """Return the stop of a motion; None: the step is none."""
        name = step.move or step.line or step.arc
        if name is None:
            return None
        pose = self._poses[name]
        made: dict[str, Any] = {"pose": list(pose.pose)} if pose.pose is not None else {"q": list(pose.q or ())}
        made |= {"blend": step.blend, "by_joints": step.move is not None}
        if step.speed is not None:
            made["speed"] = step.speed
        if step.via is not None:
            made |= {"via": places[step.via], "angle": step.angle}
        return made
