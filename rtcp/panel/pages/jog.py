"""Jog: pads, keys and a gamepad, held to move."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from nicegui import ui

from rtcp.panel.page import ENABLED, View, button, choice, no_platform, number, text, tool_pose

FRAMES = {"base": "Base frame", "tool": "Tool frame", "joints": "Joints"}
_PADS = {
    "X and Y": ("x+ Forward, +X", "y+ Left, +Y", "y- Right, -Y", "x- Back, -X"),
    "Z and yaw": ("z+ Up, +Z", "rz+ Yaw +", "rz- Yaw -", "z- Down, -Z"),
    "Roll and pitch": ("ry+ Pitch +", "rx+ Roll +", "rx- Roll -", "ry- Pitch -"),
}
"""Name -> part of the speed and label of the upper, left, right and lower button, as on the source's stick."""
_PLACES = ("1 / 2", "2 / 1", "2 / 3", "3 / 2")
_KEYS = (
    "up and down, left stick",
    "left and right, left stick",
    "page up and down, right stick",
    "a and d, cross left and right",
    "w and s, cross up and down",
    "q and e, right stick",
)
"""What moves each joint, in the frame of the joints."""


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Jog")
    config = view.live.config
    if config is None:
        no_platform()
        return
    text("p", "Hold to move. Letting go, leaving the page or losing the connection stops the arm.")
    with ui.element("div").classes("page jog-area").props("tabindex=0") as area:
        area.props["aria-label"] = (
            "Jog by keys: arrows X and Y, page up and down Z, q and e yaw, a and d roll, w and s pitch, o and c gripper"
        )
        area.props["role"] = "group"

        def settings() -> None:
            # Numbers that are none, or beyond what is configured, move nothing: the platform refuses them.
            area.props.update(
                {
                    "data-jog-frame": frame.value,
                    "data-jog-speed": speed.value,
                    "data-jog-turn": turn.value,
                    "data-jog-joint": joint.value,
                }
            )
            cartesian.set_visibility(frame.value != "joints")
            single.set_visibility(frame.value == "joints")

        with ui.element("div").classes("fields"):
            if config.arm is None:
                frame = choice("Frame", {"joints": FRAMES["joints"]}, "joints")
            else:
                frame = choice("Frame", FRAMES, config.jog.frame)
            with ui.element("div").style("display: contents") as of_the_tool:
                most = config.jog.speed
                speed = number("Speed, m/s", str(most / 2), min="0", max=str(most), step="0.005")
                most = config.jog.angular_speed
                turn = number("Turning, rad/s", str(most / 2), min="0", max=str(most), step="0.01")
            of_the_tool.set_visibility(config.arm is not None)
            joint = number("Joints, rad/s", "0.1", min="0", step="0.01")
        with ui.element("div").classes("pads"):
            cartesian = ui.element("div").classes("pads")
            single = ui.element("div")
            _gripper(view)
        with cartesian:
            for name, buttons in _PADS.items() if config.arm else ():
                with ui.element("div"):
                    text("h2", name)
                    with ui.element("div").classes("pad"):
                        for place, one in zip(_PLACES, buttons, strict=True):
                            part, _, label = one.partition(" ")
                            _hold(label, part).style(f"grid-area: {place}")
        with single:
            for at, motor in enumerate(config.joints):
                with ui.element("div").classes("buttons"):
                    text("span", motor.name).style("min-width: 5rem")
                    _hold(f"{motor.name} -", f"{at}-")
                    _hold(f"{motor.name} +", f"{at}+")
                    text("small", _KEYS[at] if at < len(_KEYS) else "")
        for one_field in (frame, speed, turn, joint):
            one_field.on_change(settings)
        settings()
    text(
        "p",
        "Keys, while the pads have the focus: arrows, page up, page down, q e, a d, w s; o opens and c closes the "
        "gripper. Gamepad: hold the left shoulder button; A closes and B opens.",
    )
    if config.arm is not None:
        tool_pose()


def _gripper(view: View) -> None:
    """Show the gripper as on the source's stick: forward opens, backward closes."""

    def move(opens: bool, done: str) -> Callable[[], Awaitable[object]]:
        return lambda: view.act(lambda robot: robot.gripper(opens), done, instead=True)

    with ui.element("div"):
        text("h2", "Gripper")
        with ui.element("div").classes("pad"):
            for label, place, opens, done in (
                ("Open", _PLACES[0], True, "The gripper is open"),
                ("Close", _PLACES[3], False, "The gripper has closed"),
            ):
                made = button(label, move(opens, done), when=ENABLED).style(f"grid-area: {place}")
                made.props.update({"data-gripper": label.lower(), "aria-label": f"{label} gripper"})


def _hold(label: str, part: str) -> ui.element:
    made = button(label, when="holding moving")
    made.props["data-jog"] = part
    return made
