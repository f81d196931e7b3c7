"""I/O: inputs and outputs of the boxes, channels of other slaves, with name and terminal; outputs set by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from nicegui import ui
from nicegui.elements.mixins.text_element import TextElement

from rtcp.api import Channel, Levels, RtcpError
from rtcp.config.model import ArmConfig, Level
from rtcp.panel.page import View, button, no_platform, number, on_click, table, text

_INTERVAL_S = 0.2
_JOYSTICK = ("forward", "backward", "left", "right", "mode_up", "mode_down")
Places = dict[str, tuple[TextElement, TextElement | None, Level | None]]
"""Name -> elements of its word and its level, and the level at which it is on."""


async def build(view: View) -> None:
    """Build the page."""
    text("h1", "I/O")
    if view.live.config is None:
        no_platform()
        return
    answer = await view.query(lambda robot: robot.read_io())
    if not (answer.inputs or answer.outputs or answer.channels):
        text("p", "This platform has no box with inputs or outputs.")
        return
    with ui.element("div").classes("columns"):
        inputs = _terminals("Inputs", answer.inputs, lambda name: text("span", "", "level"), _active(view.live.config))
        outputs = _terminals("Outputs", answer.outputs, lambda name: _switch(view, name), {})
    channels = _channels(view, answer.channels) if answer.channels else {}
    text("p", "An output that the gripper, a lamp or a process drives is set again by it.")

    def show(places: Places, levels: Levels) -> None:
        for name, (place, beside, active) in places.items():
            level = "high" if levels[name] else "low"
            word = level if not active else "on" if level == active else "off"
            if place.text != word:
                place.text = word
                place.props["data-level"] = level
                if beside is not None:
                    beside.text = level
                if place.tag == "button":
                    place.props["aria-checked"] = str(levels[name]).lower()

    async def refresh() -> None:
        try:
            now = await view.query(lambda robot: robot.read_io())
        except RtcpError:
            return  # the header says why
        show(inputs, now.inputs)
        show(outputs, now.outputs)
        for name, place in channels.items():
            place.text = f"{now.channels[name].value:.6g}"

    show(inputs, answer.inputs)
    show(outputs, answer.outputs)
    ui.timer(_INTERVAL_S, refresh)


def _active(config: ArmConfig) -> dict[str, Level]:
    """Return the levels at which the inputs with a function are on."""
    inputs = config.inputs
    levels = {name: getattr(inputs, name) for name in ("arm_toggle", "enabling_switch", "emergency_stop")}
    joystick = dict.fromkeys(_JOYSTICK, inputs.joystick.active) if inputs.joystick is not None else {}
    return joystick | {name: level.active for name, level in levels.items() if level is not None}


def _terminals(
    title: str, levels: Levels, control: Callable[[str], TextElement], active: Mapping[str, Level]
) -> Places:
    """Show terminals, those with a meaning first; return their elements."""
    places: Places = {}
    with ui.element("section").classes("page"):
        text("h2", title)
        with ui.element("ul").classes("terminals"):
            for name, place in sorted(levels.places.items(), key=lambda item: item[0] == item[1]):
                with ui.element("li"):
                    text("span", name.replace("_", " "))
                    with ui.element("small"):
                        text("span", f"{place} " if name != place else "")
                        beside = text("span", "") if name in active else None
                    places[name] = control(name), beside, active.get(name)
    return places


def _channels(view: View, channels: Mapping[str, Channel]) -> dict[str, TextElement]:
    """Show numeric channels, with a field for those that can be set; return the elements of their values."""
    elements: dict[str, TextElement] = {}
    with table(("Channel", "Value", "Unit", "Set"), "Channels", "numbers"):
        for name, channel in channels.items():
            with ui.element("tr"):
                text("th", name, scope="row")
                elements[name] = text("td", f"{channel.value:.6g}")
                text("td", channel.unit, "text")
                with ui.element("td"):
                    if channel.settable:
                        _setting(view, channel)
    return elements


def _setting(view: View, channel: Channel) -> None:
    low, high = channel.range
    wanted = number(f"Set {channel.name}", f"{channel.value:g}", channel.unit)
    with ui.element("small"):
        text("span", f"{low:g} to {high:g}")

    async def send() -> None:
        try:
            value = wanted.number()
        except RtcpError as error:
            view.warn(error.message)
            return
        await view.act(lambda robot: robot.set_output(channel.name, value))

    button("Set", send, plain=True)


def _switch(view: View, name: str) -> TextElement:
    control = text("button", "", "act plain level", type="button", role="switch", **{"aria-label": name})

    async def toggle() -> None:
        value = control.props.get("aria-checked") != "true"
        await view.act(lambda robot: robot.set_output(name, value))

    on_click(control, toggle)
    return control
