"""Limits of joints and space: in force and configured; they are narrowed while the platform runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from nicegui import ui

from rtcp.api import RtcpError
from rtcp.panel.page import ENABLED, POSE, Field, View, button, no_platform, number, quantity, table, text

_JOINT = {"min": "rad", "max": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "jerk": "rad/s³", "torque": "Nm"}
"""Limit of a joint -> its unit."""


async def build(view: View) -> None:
    """Build the page."""
    text("h1", "Limits")
    if view.live.status is None:
        no_platform()
        return
    text(
        "p",
        "Narrower than the file allows, until the platform ends. A field says what is in force; below it stands what "
        "the file allows. The tool stays inside the box, and out of the other spaces.",
    )
    limits = await view.live.view(lambda robot: robot.limits())
    fields: dict[str, Field] = {}

    async def apply() -> None:
        try:
            changes = {key: control.number() for key, control in fields.items() if control.value != kept[key]}
        except RtcpError as error:
            view.warn(error.message)
            return
        if changes and await view.act(lambda robot: robot.set_limits(changes), "The limits are in force") is not None:
            kept.update({key: fields[key].value for key in changes})

    async def widest() -> None:
        changes = dict(_all(limits["configured"], limits["joint_names"]))
        if await view.act(lambda robot: robot.set_limits(changes), "The limits of the file are in force") is not None:
            for key, value in changes.items():
                fields[key].value = kept[key] = f"{value:g}"

    with table(("Joint", *_JOINT.items()), "Limits of the joints", "numbers"):
        for at, name in enumerate(limits["joint_names"]):
            with ui.element("tr"):
                text("th", name, scope="row")
                for key, unit in _JOINT.items():
                    with ui.element("td"):
                        fields[f"{name}.{key}"] = _field(
                            f"{name} {key}", limits["limits"][key][at], limits["configured"][key][at], unit
                        )
    with table(("Space", "Corner", *POSE[:3]), "Limits of the space", "numbers"):
        for box in _boxes(limits["limits"]):
            for side in ("min", "max"):
                with ui.element("tr"):
                    text("th", box.replace("_", " "), scope="row")
                    text("td", "lower" if side == "min" else "upper", "text")
                    for axis, letter in enumerate("xyz"):
                        now, allowed = (_boxes(limits[which])[box][side][axis] for which in ("limits", "configured"))
                        with ui.element("td"):
                            fields[f"{box}.{side}.{letter}"] = _field(f"{box} {side} {letter}", now, allowed, "m")
    kept = {key: control.value for key, control in fields.items()}
    when = f"ready {ENABLED} stopped_by_limit fault"
    with ui.element("div").classes("buttons"):
        button("Set the limits", apply, when=when)
        button("As the file allows", widest, when=when, plain=True)


def _field(name: str, now: float, allowed: float, unit: str) -> Field:
    control = number(name, f"{now:g}", unit)
    with ui.element("small"):
        text("span", "file: ")
        quantity(allowed, unit)
    return control


def _boxes(limits: dict[str, Any]) -> dict[str, Any]:
    inner = {} if limits.get("box") is None else {"box": limits["box"]}
    return {**inner, **limits["keep_out"]}


def _all(limits: dict[str, Any], joints: Sequence[str]) -> Iterator[tuple[str, float]]:
    """Yield key and value of every limit."""
    for at, name in enumerate(joints):
        for key in _JOINT:
            yield f"{name}.{key}", limits[key][at]
    for box, corners in _boxes(limits).items():
        for side in ("min", "max"):
            for axis, letter in enumerate("xyz"):
                yield f"{box}.{side}.{letter}", corners[side][axis]
