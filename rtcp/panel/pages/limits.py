"""Limits of joints, space and supervision: in force and configured; they are narrowed while the platform runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from nicegui import ui

from rtcp.api import RtcpError
from rtcp.panel.page import ENABLED, POSE, Field, View, button, no_platform, number, quantity, table, text

_SUPERVISION = {"speed": "times the limit", "torque": "times the limit", "following_error": "rad"}
"""Threshold of the supervision -> its unit."""
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

    async def put(changes: dict[str, float], widen: bool) -> None:
        done = await view.act(lambda robot: robot.set_limits(changes, widen=widen), "The limits are in force")
        if done is not None:
            kept.update({key: fields[key].value for key in changes})

    def changes() -> dict[str, float]:
        try:
            return {key: control.number() for key, control in fields.items() if control.value != kept[key]}
        except RtcpError as error:
            view.warn(error.message)
            return {}

    async def apply() -> None:
        if changed := changes():
            await put(changed, widen=False)

    def widen() -> None:
        async def confirmed() -> None:
            dialog.close()
            await put(changed, widen=True)

        if changed := changes():
            named = ", ".join(f"{key} {value:g}" for key, value in changed.items())
            note = f"{named}: at most what the file has under `absolute`, and without torque."
            with view.question("Allow more than the limits of the file?", note) as dialog:
                button("Widen the limits", confirmed)
                button("Leave them", dialog.close, plain=True)

    async def widest() -> None:
        allowed = dict(_all(limits["configured"], limits["joint_names"]))
        if await view.act(lambda robot: robot.set_limits(allowed), "The limits of the file are in force") is not None:
            for key, value in allowed.items():
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
    if cones := limits["limits"]["cones"]:
        columns = (("Cone", ""), ("Axis of the tool", ""), ("Direction", ""), ("Largest angle", "rad"))
        with table(columns, "Limits of the tool's orientation", "numbers"):
            for name, cone in cones.items():
                with ui.element("tr"):
                    text("th", name, scope="row")
                    text("td", cone["axis"], "text")
                    text("td", " ".join(f"{part:g}" for part in cone["direction"]), "text")
                    with ui.element("td"):
                        allowed = limits["configured"]["cones"][name]["angle"]
                        fields[f"{name}.angle"] = _field(f"{name} angle", cone["angle"], allowed, "rad")
    with table(("Measured", "Threshold"), "Supervision", "numbers"):
        for name, unit in _SUPERVISION.items():
            with ui.element("tr"):
                text("th", name.replace("_", " "), scope="row")
                with ui.element("td"):
                    now, allowed = (limits[which]["supervision"][name] for which in ("limits", "configured"))
                    label = f"supervision {name.replace('_', ' ')}"
                    fields[f"supervision.{name}"] = _field(label, now, allowed, unit)
    kept = {key: control.value for key, control in fields.items()}
    when = f"ready {ENABLED} stopped_by_limit fault"
    with ui.element("div").classes("buttons"):
        button("Set the limits", apply, when=when)
        button("As the file allows", widest, when=when, plain=True)
        button("Beyond the file", widen, when="ready fault", plain=True)


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
    for name, cone in limits["cones"].items():
        yield f"{name}.angle", cone["angle"]
    for name, value in limits["supervision"].items():
        yield f"supervision.{name}", value
