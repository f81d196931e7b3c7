"""Program: poses kept by name, steps made of them by clicks; run, stepped forwards and back, paused. Saved at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from nicegui import ui

from rtcp.api import Program, ProgramFile, Robot, RtcpError
from rtcp.api.program import Begun, axis_motion
from rtcp.config.model import ConfigError, NamedPose, Step
from rtcp.config.zero import state_directory
from rtcp.panel.page import ProgramSession, View, button, choice, field, no_platform, number, row, table, text

_KINDS: Final = {
    "move": "Move by the joints",
    "line": "Move on a line",
    "arc": "Move on an arc",
    "gripper": "Gripper",
    "output": "Set an output",
    "wait_for": "Wait for an input",
    "wait_s": "Wait for a time",
    "tool": "Use a tool",
    "run": "Run a part",
}
_MOTIONS: Final = ("move", "line", "arc")
_MOST_OFFERED: Final = 24


def programs_directory() -> Path:
    """Return the directory of the panel's programs."""
    return state_directory() / "programs"


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Program")
    if view.live.config is None or view.live.status is None:
        no_platform()
        return
    session = view.kept.setdefault("program", ProgramSession())
    assert isinstance(session, ProgramSession)
    ProgramPage(view, session)


class ProgramPage:
    """The page: each click changes the file at once, and `Undo` takes it back."""

    def __init__(self, view: View, session: ProgramSession) -> None:
        self._view, self._session = view, session
        with ui.element("div").classes("fields"):
            name = session.file.path.stem if session.file else ""
            self._name = field("Program", name, list="programs", maxlength="60")
            with ui.element("datalist").props("id=programs"):
                for path in sorted(programs_directory().glob("*.yaml")):
                    ui.element("option").props["value"] = path.stem
        with ui.element("div").classes("buttons"):
            button("Open", self._open)
            self._undo = button("Undo", partial(self._change, lambda file: file.undo()), plain=True)
        self._notice = text("p", "", role="status", **{"aria-live": "polite"})
        self._place = ui.element("div").classes("page")
        session.changed = self._show
        view.leaving.append(self._left)
        self._show()

    def _left(self) -> None:
        self._session.changed = lambda: None

    def _say(self, notice: str) -> None:
        self._session.notice = notice
        self._session.changed()

    # -- the file -----------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        name = self._name.value.strip().removesuffix(".yaml")
        if not name or name != Path(name).name or name.startswith("."):
            self._view.warn(f'Program: found the text "{name}", allowed is a name for its file')
            return
        if self._session.running:
            self._view.warn("The program runs: stop it first")
            return
        try:
            self._session.file = ProgramFile(programs_directory() / f"{name}.yaml")
        except ConfigError as error:
            self._view.warn(str(error))
            return
        self._session.at = 0
        path = self._session.file.path
        self._say(f"Opened {path}" if path.exists() else f"New; saved as {path} with its first pose")

    def _change(self, change: Callable[[ProgramFile], object]) -> bool:
        """Change the file; return whether it was changed."""
        file = self._session.file
        if file is None or not self._view.may_command():
            return False
        if self._session.running:
            self._view.warn("The program runs: it is changed when it has ended")
            return False
        try:
            change(file)
        except ConfigError as error:
            self._view.warn("\n".join(error.problems))
            return False
        self._session.at = min(self._session.at, len(file.motion.program))
        self._session.changed()
        return True

    # -- display ------------------------------------------------------------------------------------------------------

    def _show(self) -> None:
        session, file = self._session, self._session.file
        self._notice.text = session.notice
        self._undo.props["disabled"] = file is None or not file.can_undo or session.running
        self._place.clear()
        if file is None:
            with self._place:
                self._show_known()
            return
        with self._place:
            self._show_run(file)
            self._show_steps(file)
            if not file.motion.poses:
                self._show_poses(file)  # the first task of a new program
            self._show_new_step(file)
            if file.motion.poses:
                self._show_poses(file)
            self._show_speed(file)

    def _show_run(self, file: ProgramFile) -> None:
        session = self._session
        is_empty = not file.motion.program
        with ui.element("div").classes("buttons").props('role=group aria-label="Run"'):
            for label, handler, blocked in (
                ("Check", self._check, is_empty or session.running),
                ("Run", partial(self._run, 0, None), is_empty or session.running),
                ("Step back", self._step_back, session.running or session.at == 0),
                ("Step", self._step, session.running or session.at >= len(file.motion.program)),
            ):
                control = button(label, handler, plain=label != "Run")
                control.props["disabled"] = blocked

    def _show_known(self) -> None:
        """Offer the programs that exist."""

        def opens(name: str) -> None:
            self._name.value = name
            self._open()

        text("p", "Type a name: a new program is made, a known one is opened.")
        with ui.element("div").classes("buttons").props('role=group aria-label="Programs"'):
            for path in sorted(programs_directory().glob("*.yaml"))[:_MOST_OFFERED]:
                button(path.stem, partial(opens, path.stem), plain=True)

    def _show_speed(self, file: ProgramFile) -> None:
        now = file.motion.speed
        with ui.element("div").classes("fields"):
            speed = number("Speed of the tool (empty: the arm's)", "" if now is None else f"{now:g}", "m/s", min="0")

        def set_speed() -> None:
            try:
                value = speed.number() if speed.value.strip() else None
            except RtcpError as error:
                self._view.warn(error.message)
                return
            self._change(lambda changed: changed.set_speed(value))

        with ui.element("div").classes("buttons"):
            button("Set the speed", set_speed, plain=True)

    def _show_steps(self, file: ProgramFile) -> None:
        steps = file.motion.program
        with ui.element("div"):
            text("h2", "Steps")
            if not steps:
                text("p", "None yet: keep a pose, then add a step that leads there.")
                return
            body = table(("#", "Step", ""), "Steps of the program", "stack steps")
        for at, step in enumerate(steps):
            line = row(body, f"▶ {at + 1}" if at == self._session.at else str(at + 1), described(step))
            if at == self._session.at:
                line.props["aria-current"] = "step"
            with line, ui.element("td"), ui.element("div").classes("buttons"):
                for label, spoken, handler in (
                    ("Up", f"Move step {at + 1} up", partial(self._move, at, at - 1)),
                    ("Down", f"Move step {at + 1} down", partial(self._move, at, at + 1)),
                    ("Delete", f"Delete step {at + 1}", partial(self._delete, at)),
                    ("Run from here", f"Run from step {at + 1}", partial(self._run, at, None)),
                ):
                    button(label, handler, plain=True).props["aria-label"] = spoken

    def _show_new_step(self, file: ProgramFile) -> None:
        config = self._view.live.config
        assert config is not None
        poses, parts = [entry.name for entry in file.motion.poses], [entry.name for entry in file.motion.parts]
        kinds = {
            key: name for key, name in _KINDS.items() if (poses or key not in _MOTIONS) and (parts or key != "run")
        }
        text("h2", "New step")
        with ui.element("div").classes("fields"):
            kind = choice("Kind", kinds, next(iter(kinds)))
            places = {f"{at}": f"before step {at + 1}" for at in range(len(file.motion.program))}
            places |= {f"={at}": f"in place of step {at + 1}" for at in range(len(file.motion.program))}
            where = choice("Where", {"": "at the end", **places}, "")
        fields = ui.element("div").classes("fields")
        entered: dict[str, Any] = {}

        def show() -> None:
            fields.clear()
            entered.clear()
            with fields:
                entered.update(_fields_of(kind.value, poses, parts, config.tool_names))

        def add() -> None:
            try:
                step = {kind.value: None} | {key: read() for key, read in entered.items()}
            except RtcpError as error:
                self._view.warn(error.message)
                return
            step = {key: value for key, value in step.items() if value is not None}
            if where.value.startswith("="):
                self._change(lambda changed: changed.replace(int(where.value[1:]), step))
            else:
                at = int(where.value) if where.value else len(file.motion.program)
                self._change(lambda changed: changed.insert(at, step))

        kind.on_change(show)
        show()
        with ui.element("div").classes("buttons"):
            button("Add the step", add, plain=not poses)

    def _show_poses(self, file: ProgramFile) -> None:
        text("h2", "Poses")
        with ui.element("div").classes("fields"):
            name = field("Name of the pose", f"pose {len(file.motion.poses) + 1}", maxlength="64")
            kinds = {"q": "joint positions"} | (
                {"pose": "pose of the tool"}
                if self._view.live.config is not None and self._view.live.config.arm is not None
                else {}
            )
            kind = choice("Kept as", kinds, "q")
        with ui.element("div").classes("buttons"):
            button(
                "Keep where the arm is",
                lambda: self._keep(name.value.strip(), kind.value),
                plain=bool(file.motion.poses),
            )
        if not file.motion.poses:
            return
        body = table(("Pose", "Kept as", ""), "Poses of the program", "stack steps")
        for pose in file.motion.poses:
            with (
                row(body, pose.name, "joints" if pose.q is not None else "pose"),
                ui.element("td"),
                ui.element("div").classes("buttons"),
            ):
                for label, spoken, handler in (
                    ("Move there", f"Move to {pose.name}", partial(self._move_to, pose)),
                    ("Keep anew", f"Keep {pose.name} anew", partial(self._keep, pose.name, "q" if pose.q else "pose")),
                    ("Delete", f"Delete {pose.name}", partial(self._forget, pose.name)),
                ):
                    button(label, handler, plain=True).props["aria-label"] = spoken

    # -- actions ------------------------------------------------------------------------------------------------------

    def _keep(self, name: str, kind: str) -> None:
        status = self._view.live.status
        if status is None:
            self._view.warn("No platform runs: nothing is kept")
            return
        values = status.commanded_positions if kind == "q" else status.commanded_pose
        if values is None:
            self._view.warn("The pose of the tool is not known: nothing is kept")
            return
        if self._change(lambda file: file.keep(name, **{kind: values})):
            self._view.say(f"{name} is kept")

    def _forget(self, name: str) -> None:
        self._change(lambda file: file.remove_pose(name))

    def _delete(self, at: int) -> None:
        self._change(lambda file: file.remove(at))

    def _move(self, at: int, to: int) -> None:
        file = self._session.file
        if file is not None and 0 <= to < len(file.motion.program):
            self._change(lambda changed: changed.move(at, to))

    async def _move_to(self, pose: NamedPose) -> None:
        await self._view.act(
            lambda robot: robot.move_joints(pose.q) if pose.q is not None else robot.move_pose(pose.pose or ()),
            f"The arm is at {pose.name}",
        )

    def _program(self) -> Program | None:
        assert self._session.file is not None
        try:
            return Program(self._session.file.path)
        except ConfigError as error:
            self._view.warn("\n".join(error.problems))
            return None

    async def _check(self) -> None:
        program = self._program()
        if program is None:
            return
        motions = await self._view.ask(lambda robot: robot.in_thread(program.check))
        if motions is None:
            return
        plans = [motion.plan for motion in motions]
        duration_s = sum(plan.duration_s for plan in plans)
        if self._view.arm is not None:
            self._view.arm.preview([list(q) for plan in plans for q in plan.path], duration_s)
        self._say(f"It can be run: {len(plans)} motions, {duration_s:.1f} s")

    async def _run(self, start: int, end: int | None) -> None:
        """Run from a step on, and show what begins."""
        program, session = self._program(), self._session
        if program is None or session.running:
            return
        loop = asyncio.get_running_loop()

        def begun(start: Begun) -> None:
            session.at = start.number
            self._say(f"Step {start.number + 1}: {start.text}")

        def say(start: Begun) -> None:
            loop.call_soon_threadsafe(begun, start)

        def run(robot: Robot) -> bool:
            program.run(robot, say, start=start, end=end, between=session.between)
            return True

        session.begin()
        self._say("It is planned")
        done = None
        try:
            done = await self._view.act_beyond_visit(lambda robot: robot.in_thread(run))
        finally:
            session.end()
            last = len(program.steps) if end is None else end
            if done:
                session.at = last if end is not None or last < len(program.steps) else 0
            self._say(("Done" if end is None else f"Step {start + 1} is done") if done else "It has ended early")

    async def _step(self) -> None:
        await self._run(self._session.at, self._session.at + 1)

    async def _step_back(self) -> None:
        program, session = self._program(), self._session
        if program is None or session.running:
            return
        number = session.at - 1

        def step_back(robot: Robot) -> bool:
            program.step_back(robot, number)
            return True

        session.begin()
        self._say(f"Back over step {number + 1}")
        done = None
        try:
            done = await self._view.act_beyond_visit(lambda robot: robot.in_thread(step_back))
        finally:
            session.end()
            if done:
                session.at = number
            self._say(f"Step {number + 1} is next" if done else "It has ended early")


def _fields_of(
    kind: str, poses: Sequence[str], parts: Sequence[str], tools: Sequence[str]
) -> Mapping[str, Callable[[], Any]]:
    """Make the fields of a kind of step; return a reader for each key."""
    readers: dict[str, Callable[[], Any]] = {}

    def optional(key: str, label: str, unit: str) -> None:
        control = number(label, unit=unit, min="0")
        readers[key] = lambda: control.number() if control.value.strip() else None

    if kind in _MOTIONS:
        pose = choice("Pose", poses, poses[-1])
        readers[kind] = lambda: pose.value
        if kind == "arc":
            via = choice("Through", poses, poses[0])
            readers["via"] = lambda: via.value
            optional("angle", "Angle of the circle (empty: up to the pose)", "rad")
        if kind == "move":
            optional("speed", "Speed (empty: the limit)", "rad/s")
        else:
            optional("speed", "Speed (empty: the program's)", "m/s")
        optional("blend", "Blend (empty: it rests)", "m")
    elif kind == "gripper":
        grip = choice("Gripper", ("open", "close"), "close")
        readers[kind] = lambda: grip.value
    elif kind in ("output", "wait_for"):
        name = field("Output" if kind == "output" else "Input")
        level = choice("Level", {"true": "on", "": "off"}, "true")
        readers[kind] = lambda: str(name.value).strip()
        readers["value"] = lambda: bool(level.value)
        if kind == "wait_for":
            optional("timeout_s", "At most (empty: for ever)", "s")
    elif kind == "wait_s":
        seconds = number("Time, s", "1", min="0")
        readers[kind] = seconds.number
    elif kind == "tool":
        tool = choice("Tool", tools, tools[0])
        readers[kind] = lambda: tool.value
    else:
        part = choice("Part", parts, parts[0])
        times = number("Times (0: for ever)", "1", min="0", step="1")
        readers[kind] = lambda: part.value
        readers["times"] = lambda: int(times.number())
    return readers


def described(step: Step) -> str:
    """Return a step in words."""
    if (name := step.move or step.line or step.arc) is not None:
        verb = "move" if step.move else "line" if step.line else f"arc through {step.via}"
        unit = "rad/s" if step.move else "m/s"
        speed = "" if step.speed is None else f" at {step.speed:g} {unit}"
        angle = "" if step.angle is None else f", {step.angle:.4g} rad of the circle"
        return f"{verb} to {name}{speed}{angle}" + (f", blend {step.blend:g} m" if step.blend else "")
    if step.gripper is not None:
        return f"gripper: {step.gripper}"
    if step.axis is not None:
        return axis_motion(step)
    if step.tool is not None:
        return f"tool: {step.tool}"
    level = "on" if step.value else "off"
    if step.output is not None:
        return f"output {step.output}: {level}"
    if step.wait_for is not None:
        limit = "" if step.timeout_s is None else f", at most {step.timeout_s:g} s"
        return f"wait until {step.wait_for} is {level}{limit}"
    if step.wait_s is not None:
        return f"wait {step.wait_s:g} s"
    return f"run {step.run}" + (f", {step.times} times" if step.times > 1 else ", for ever" if not step.times else "")
