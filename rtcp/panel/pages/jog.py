"""Jog: pads, keys and a gamepad, held to move; or a step for each click."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import ui
from nicegui.element import Element

from rtcp.api import RtcpError
from rtcp.config.model import ArmConfig
from rtcp.panel.page import (
    ENABLED,
    POSE,
    Field,
    View,
    button,
    choice,
    no_platform,
    number,
    remember_click,
    text,
    tool_pose,
)

FRAMES = {"base": "Base frame", "tool": "Tool frame", "joints": "Joints"}
_STEPS = {"fine": (1e-3, math.radians(1.0)), "coarse": (1e-2, math.radians(5.0))}
"""Steps of the tool, m, and about an axis or of a joint, rad."""
_MOVEMENTS = {"": "while held", "fine": "step 1 mm or 1 deg", "coarse": "step 10 mm or 5 deg"}
_PADS = {
    "X and Y": ("x+ Forward, +X", "y+ Left, +Y", "y- Right, \N{MINUS SIGN}Y", "x- Back, \N{MINUS SIGN}X"),
    "Z and yaw": ("z+ Up, +Z", "rz+ Yaw +", "rz- Yaw \N{MINUS SIGN}", "z- Down, \N{MINUS SIGN}Z"),
    "Roll and pitch": ("ry+ Pitch +", "rx+ Roll +", "rx- Roll \N{MINUS SIGN}", "ry- Pitch \N{MINUS SIGN}"),
}
"""Name -> part of the speed and label of the upper, left, right and lower button, as on the joystick."""
_PLACES = ("1 / 2", "2 / 1", "2 / 3", "3 / 2")
_KEYS = (
    "up and down, left stick",
    "left and right, left stick",
    "page up and down, right stick",
    "a and d, cross left and right",
    "w and s, cross up and down",
    "q and e, right stick",
)
"""Motion of each joint, in the frame of the joints."""


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Jog")
    if view.live.config is None:
        no_platform()
    else:
        Jog(view, view.live.config)


class Jog:
    """The pads of one arm; `panel.js` jogs while they are held."""

    def __init__(self, view: View, config: ArmConfig) -> None:
        self._view, self._config = view, config
        self._kept: dict[str, str] = view.kept.setdefault("jog", {})
        """Settings that `panel.js` jogs with."""
        with ui.element("div").classes("page jog-area").props("tabindex=0 role=group") as self._area:
            self._area.props["aria-label"] = (
                "Jog by keys: arrows X and Y, page up and down Z, q and e yaw, a and d roll, w and s pitch, "
                "o and c gripper"
            )
            with ui.element("div").classes("pads"):
                self._cartesian = ui.element("div").classes("pads")
                self._single = ui.element("div").classes("joints")
                _gripper(view)
            self._make_pads()
            with ui.element("div").classes("fields"):
                self._movement = choice("Movement", _MOVEMENTS, self._kept.get("data-jog-step", ""))
                frames = FRAMES if config.arm is not None else {"joints": FRAMES["joints"]}
                first = config.jog.frame if config.arm is not None else "joints"
                kept = self._kept.get("data-jog-frame", first)
                self._frame = choice("Frame", frames, kept if kept in frames else first)
                self._of_the_tool = ui.element("div").style("display: contents")
                with self._of_the_tool:
                    self._speed = self._limited("Speed", "m/s", config.jog.speed, "data-jog-speed")
                    self._turn_speed = self._limited("Turning", "rad/s", config.jog.angular_speed, "data-jog-turn")
                self._joint = number(
                    "Speed of joints", self._kept.get("data-jog-joint", "0.1"), "rad/s", min="0", step="0.01"
                )
            for control in (self._movement, self._frame, self._speed, self._turn_speed, self._joint):
                control.on_change(self._settle)
            self._settle()
        text(
            "p",
            "Letting go, leaving the page or losing the connection stops the arm. Keys, while the pads have the focus: "
            "arrows, page up, page down, q e, a d, w s; o opens and c closes the gripper. Gamepad: hold the left "
            "shoulder button; A closes and B opens.",
        )
        if config.arm is not None:
            tool_pose()
            _tool_and_hand(view, config)

    def _limited(self, label: str, unit: str, most: float, key: str) -> Field:
        return number(label, self._kept.get(key, str(most / 2)), unit, min="0", max=str(most), step=str(most / 20))

    def _make_pads(self) -> None:
        with self._cartesian:
            for name, buttons in _PADS.items() if self._config.arm else ():
                with ui.element("div"):
                    text("h2", name)
                    with ui.element("div").classes("pad"):
                        for place, spec in zip(_PLACES, buttons, strict=True):
                            part, _, label = spec.partition(" ")
                            self._pad(label, part).style(f"grid-area: {place}")
        with self._single:
            for at, motor in enumerate(self._config.joints):
                with ui.element("div").classes("joint"):
                    text("span", motor.name)
                    self._pad(f"{motor.name} \N{MINUS SIGN}", f"{at}-")
                    self._pad(f"{motor.name} +", f"{at}+")
                    text("small", _KEYS[at] if at < len(_KEYS) else "")

    def _pad(self, label: str, part: str) -> Element:
        """Return a button that jogs while it is held, or steps where its page shows that it does."""
        pad = button(label, when="holding moving")
        pad.props["data-jog"] = part

        async def clicked(event: Any) -> None:
            token_ns, movement = event.args
            remember_click(token_ns)
            if movement == self._movement.value:
                await self._step(part)

        pad.on("click", clicked, js_handler="() => rtcp.stepping && emit([rtcp.token, rtcp.stepping])")
        return pad

    def _settle(self) -> None:
        # The platform refuses what is no number, or beyond the configuration.
        self._kept.update(
            {
                "data-jog-frame": self._frame.value,
                "data-jog-speed": self._speed.value,
                "data-jog-turn": self._turn_speed.value,
                "data-jog-joint": self._joint.value,
                "data-jog-step": self._movement.value,
            }
        )
        self._area.props.update(self._kept)
        self._cartesian.set_visibility(self._frame.value != "joints")
        self._single.set_visibility(self._frame.value == "joints")
        self._of_the_tool.set_visibility(self._frame.value != "joints")
        self._joint.place.set_visibility(self._frame.value == "joints")

    async def _step(self, part: str) -> None:
        """Move by one step; a click while the last one moves does nothing."""
        operator, view = self._view.live.operator, self._view
        if operator is not None and operator.page is view.page and operator.moves:
            return
        length, angle = _STEPS[self._movement.value]
        axes = [name for name, _ in POSE]
        by_joint = part[:-1] not in axes
        axis = int(part[:-1]) if by_joint else axes.index(part[:-1])
        offset = [0.0] * (len(self._config.joints) if by_joint else len(axes))
        offset[axis] = math.copysign(angle if by_joint or axis > 2 else length, 1.0 if part[-1] == "+" else -1.0)
        try:
            # A line has no angular speed: the configured one holds.
            speed = self._joint.number() if by_joint else self._speed.number() if axis <= 2 else None
        except RtcpError as error:
            view.warn(error.message)
            return
        await view.act(lambda robot: robot.move_by(offset, "joints" if by_joint else self._frame.value, speed))


def _gripper(view: View) -> None:
    """Show the gripper as on the joystick: forward opens, backward closes."""

    def move(opens: bool, done: str) -> Callable[[], Awaitable[object]]:
        return lambda: view.act(lambda robot: robot.gripper(opens), done, instead=True)

    with ui.element("div"):
        text("h2", "Gripper")
        with ui.element("div").classes("pad"):
            for label, place, opens, done in (
                ("Open", _PLACES[0], True, "The gripper is open"),
                ("Close", _PLACES[3], False, "The gripper has closed"),
            ):
                control = button(label, move(opens, done), when=ENABLED).style(f"grid-area: {place}")
                control.props.update({"data-gripper": label.lower(), "aria-label": f"{label} gripper"})


def _tool_and_hand(view: View, config: ArmConfig) -> None:
    """Choose the tool and its payload; let the arm be guided by hand."""
    state = view.live.state()
    with ui.element("div").classes("fields"):
        tool = choice("Tool", config.tool_names, state.get("tool_name", config.tool_names[0]))
        mass = number("Payload, at the tool's point", "0", "kg", min="0", step="0.1")

    def use() -> Awaitable[object]:
        name = tool.value
        return view.act(lambda robot: robot.set_tool(name), f"The tool is {name}; it holds nothing")

    async def carry() -> None:
        try:
            value = mass.number()
        except RtcpError as error:
            view.warn(error.message)
            return
        await view.act(lambda robot: robot.set_payload(value), f"The payload is {value:g} kg")

    async def guide() -> None:
        if ended := await view.act(lambda robot: robot.guide()):
            view.say(f"Hand guiding has ended: {ended}")

    with ui.element("div").classes("buttons"):
        button("Use this tool", use, when="ready holding", plain=True)
        button("Set the payload", carry, when="ready holding", plain=True)
        button("Guide by hand", guide, when="holding", plain=True)
