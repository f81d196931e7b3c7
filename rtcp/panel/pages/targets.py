"""Targets: joint positions or a pose, planned and shown as a ghost before they are sent; named poses."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Sequence
from dataclasses import dataclass
from functools import partial
from io import StringIO
from pathlib import Path

from nicegui import ui
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from kinematics.inverse import InverseKinematics
from kinematics.pose import Pose
from rtcp.api import Arrival, AsyncRobot, Invalid, Preview, RtcpError
from rtcp.config.model import ArmConfig
from rtcp.config.zero import state_directory
from rtcp.panel.page import POSE, Field, View, button, choice, field, no_platform, number, quantity, row, table, text

_KINDS = {"joints": "Joint positions", "pose": "Pose, by the joints", "line": "Pose, on a straight line"}
_LONGEST_NAME = 40
_SAME_RAD = 1e-3


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Targets")
    config, status = view.live.config, view.live.status
    if config is None or status is None:
        no_platform()
        return
    Targets(view, config)


@dataclass(frozen=True)
class Target:
    """A target, as the fields have it."""

    values: tuple[float, ...]
    """Joint positions, rad; or a pose, m and rad."""
    kind: str
    speed: float | None

    def preview(self, robot: AsyncRobot) -> Awaitable[Preview]:
        """Plan the motion."""
        if self.kind == "joints":
            return robot.preview(q=self.values, speed=self.speed)
        return robot.preview(pose=self.values, speed=self.speed, line=self.kind == "line")

    def move(self, robot: AsyncRobot) -> Awaitable[Arrival]:
        """Carry it out."""
        if self.kind == "joints":
            return robot.move_joints(self.values, self.speed)
        return robot.move_pose(self.values, self.speed, self.kind == "line")


class Targets:
    """The page of one arm: `Plan` shows a path, and only a path that was shown is sent."""

    def __init__(self, view: View, config: ArmConfig) -> None:
        self._view, self._config = view, config
        self._planned: Target | None = None
        self._begin: Sequence[float] = ()
        """Start of the path that was shown, rad."""
        with ui.element("div").classes("fields"):
            self._kind = choice("Target", _KINDS if config.arm else {"joints": _KINDS["joints"]}, "joints")
            self._speeds = {unit: number("Speed (empty: the limit)", unit=unit, min="0") for unit in ("rad/s", "m/s")}
        self._joints_part = ui.element("div").classes("fields")
        with self._joints_part:
            self._joints = [
                self._with_slider(joint.name, joint.position.min, joint.position.max) for joint in config.joints
            ]
        self._pose_part = ui.element("div").classes("fields")
        with self._pose_part:
            self._pose = [number(name, unit=unit) for name, unit in POSE]
        with ui.element("div").classes("buttons"):
            button("Here", self._here, plain=True)
            button("Plan", self._plan, when="ready holding")
            self._send_button = button("Send", self._send)
            self._solve_button = button("Solutions", self._solve, plain=True) if config.arm is not None else None
        self._notice = text("p", "", role="status", **{"aria-live": "polite"})
        self._solutions = ui.element("div").classes("page")
        text("h2", "Named poses")
        with ui.element("div").classes("buttons"):
            self._name = field("Name", maxlength=str(_LONGEST_NAME))
            button("Keep these joint positions", self._keep, plain=True)
        self._named = ui.element("div").classes("page")
        self._show_named()
        for control in (self._kind, *self._speeds.values(), *self._pose):
            control.on_change(self._changed)
        self._here()
        self._changed()

    def _with_slider(self, name: str, low: float, high: float) -> Field:
        with ui.element("div"):
            control = number(name, unit="rad")
            slider = ui.element("input")
            slider.props.update(
                {
                    "type": "range",
                    "min": f"{low:g}",
                    "max": f"{high:g}",
                    "step": "0.001",
                    "aria-label": f"{name}, slider",
                    "data-slider": control.control.html_id,
                }
            )
        control.on_change(self._changed)
        return control

    @property
    def _speed(self) -> Field:
        """Speed of the joints, or of the tool on a line."""
        return self._speeds["m/s" if self._kind.value == "line" else "rad/s"]

    def _changed(self) -> None:
        """Discard the plan: the fields have changed."""
        for control in self._speeds.values():
            control.place.set_visibility(control is self._speed)
        self._planned = None
        self._send_button.props["disabled"] = True
        self._joints_part.set_visibility(self._kind.value == "joints")
        self._pose_part.set_visibility(self._kind.value != "joints")
        if self._solve_button is not None:
            self._solve_button.set_visibility(self._kind.value != "joints")
        if self._view.arm is not None:
            self._view.arm.preview([], 0.0)

    def _here(self) -> None:
        state = self._view.live.state()
        if "joints" in state:
            # Where it holds, the commanded positions: the same target again moves nothing.
            which = "commanded_position" if state["state"] == "holding" else "actual_position"
            self._fill(self._joints, state["joints"][which])
            self._fill(self._pose, state.get("tool", ()))
            self._changed()

    @staticmethod
    def _fill(fields: Sequence[Field], values: Sequence[float]) -> None:
        for control, value in zip(fields, values, strict=False):
            control.value = f"{round(value, 6) + 0.0:.5g}"  # no -0

    def _target(self) -> Target:
        """Return the target in the fields; raises Invalid."""
        speed = self._speed.number() if self._speed.value.strip() else None
        fields = self._joints if self._kind.value == "joints" else self._pose
        return Target(tuple(control.number() for control in fields), self._kind.value, speed)

    async def _plan(self) -> None:
        self._changed()
        try:
            target = self._target()
            plan = await self._view.query(target.preview)
        except RtcpError as error:
            self._notice.text = f"No: {error.message}"
            return
        if target != self._target():
            return  # changed meanwhile
        length = "" if plan.length_m is None else f", {plan.length_m:.3f} m"
        hint = "" if self._view.arm is None else "look at the ghost, then "
        self._notice.text = f"{plan.duration_s:.1f} s{length}: {hint}send it"
        if self._view.arm is not None:
            self._view.arm.preview([list(q) for q in plan.path], plan.duration_s)
            ui.run_javascript("rtcp.showArm()")
        self._planned, self._begin = target, plan.path[0]
        self._send_button.props["disabled"] = False

    async def _send(self) -> None:
        target, begin, self._planned = self._planned, self._begin, None
        if target is None:
            return
        now = self._view.live.state().get("joints", {}).get("commanded_position", ())
        if len(now) != len(begin) or max(abs(a - b) for a, b in zip(now, begin, strict=True)) > _SAME_RAD:
            self._notice.text = "The arm has moved since: plan again"
            return
        self._notice.text = "Moving"
        arrival = await self._view.act(target.move)
        self._changed()
        self._notice.text = "" if arrival is None else f"There; largest error of a joint {arrival.error:.5f} rad"

    async def _solve(self) -> None:
        """Show every configuration that reaches the pose, under the limits in force."""
        self._solutions.clear()
        try:
            pose, state = Pose.from_xyzrpy(*(control.number() for control in self._pose)), self._view.live.state()
            model = self._config.model_of(state["tool_name"])
            assert model is not None
            result = InverseKinematics(model).solve(pose, state["joints"]["actual_position"])
            in_force = (await self._view.query(lambda robot: robot.limits()))["limits"]
        except (Invalid, ValueError, LookupError) as error:
            self._notice.text = f"No: {error}"
            return
        if not result.solutions:
            self._notice.text = f"No: {result.reason}"
            return
        with self._solutions:
            names = [joint.name for joint in self._config.joints]
            body = table(("#", "Branch", *((name, "rad") for name in names), "Limits", ""), "Solutions of the pose")
        for count, solution in enumerate(result.solutions, 1):
            outside = [
                name for name, q, low, high in zip(names, solution.q, in_force["min"], in_force["max"], strict=True)
                if not low <= q <= high
            ]  # fmt: skip
            limits = f"outside: {', '.join(outside)}" if outside else "inside"
            angles: list[tuple[float, str, int]] = [(q, "rad", 4) for q in solution.q]
            with row(body, str(count), str(solution.branch or "-"), *angles, limits), ui.element("td"):
                button(f"Use solution {count}", partial(self._use, solution.q), plain=True)

    def _use(self, q: Sequence[float]) -> None:
        self._fill(self._joints, q)
        self._kind.value = "joints"
        self._changed()

    # -- named poses --------------------------------------------------------------------------------------------------

    def _keep(self) -> None:
        if not self._view.may_command():
            return
        name = self._name.value.strip()[:_LONGEST_NAME]
        if not name:
            self._view.warn("Name: found nothing, allowed is a name of the pose")
            return
        try:
            write_named({**read_named(), name: [control.number() for control in self._joints]})
        except (RtcpError, OSError) as error:
            self._view.warn(str(error))
        self._show_named()

    def _forget(self, name: str) -> None:
        if not self._view.may_command():
            return
        try:
            write_named({key: q for key, q in read_named().items() if key != name})
        except (RtcpError, OSError) as error:
            self._view.warn(str(error))
        self._show_named()

    def _show_named(self) -> None:
        self._named.clear()
        try:
            named = read_named()
        except RtcpError as error:
            with self._named:
                text("p", error.message, "bad")
            return
        with self._named:
            for name, q in named.items():
                with ui.element("div").classes("buttons"):
                    button(name, partial(self._use, q), plain=True)
                    with ui.element("span").classes("values"):
                        for angle in q:
                            quantity(angle, "rad", 3)
                    button(f"Remove {name}", partial(self._forget, name), plain=True)


def named_file() -> Path:
    """Return the file of the named poses: `name: [q1, ..., q6]`, rad."""
    return state_directory() / "poses.yaml"


def read_named() -> dict[str, list[float]]:
    """Return the named poses.

    Raises:
        Invalid: the file is damaged.
    """
    path = named_file()
    if not path.exists():
        return {}
    try:
        poses = YAML(typ="safe").load(path.read_text()) or {}
        return {str(name): [float(angle) for angle in q] for name, q in poses.items()}
    except (OSError, YAMLError, ValueError, TypeError, AttributeError) as error:
        message = f"{path}: found no names with joint positions ({error}): mend or remove it"
        raise RtcpError("invalid", message) from error


def write_named(named: dict[str, list[float]]) -> None:
    """Replace the file; raises OSError."""
    path = named_file()
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    written = StringIO()
    YAML(typ="safe").dump(named, written)
    fresh = path.with_suffix(".new")
    fresh.write_text(written.getvalue())
    os.replace(fresh, path)
