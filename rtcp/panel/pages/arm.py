"""Arm: every joint's figures, with its limits as bars."""

from __future__ import annotations

from nicegui import ui

from rtcp.config.model import ArmConfig
from rtcp.panel.page import View, live_value, no_platform, table, text, tool_pose


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Arm")
    config = view.live.config
    if config is None:
        no_platform()
        return
    with ui.element("p"):
        text("span", "Mode ")
        live_value("control_mode", tag="b")
        text("span", ", drives in ")
        live_value("drive_mode", tag="b")
        text("span", ", bus ")
        live_value("bus", tag="b")
        text("span", ", tool ")
        live_value("tool_name", tag="b")
    _joints(config)
    if config.arm is None:
        return
    text("h2", "Tool")
    tool_pose()
    text("h2", "Distance from the singularities")
    distances = (("shoulder", "m"), ("elbow", "rad"), ("wrist", "rad"), ("smallest singular value", ""))
    with table(("", *distances), "Distances from the singularities", "numbers"), ui.element("tr"):
        text("th", "distance", scope="row")
        for at, (_, unit) in enumerate(distances):
            live_value(f"singular.{at}", 3, unit=unit)


def _joints(config: ArmConfig) -> None:
    headings = (
        "Joint",
        "Drive",
        ("Position", "rad"),
        "",
        ("Velocity", "rad/s"),
        "",
        ("Torque", "Nm"),
        "",
        ("Following error", "rad"),
        "°C",
    )
    with table(headings, "Joints", "numbers joints"):
        for at, joint in enumerate(config.joints):
            with ui.element("tr"):
                text("th", joint.name, scope="row")
                live_value(f"drive.{at}").classes("text")
                live_value(f"actual_position.{at}", 4, unit="rad")
                _bar(f"actual_position.{at}", "min max", "rad")
                live_value(f"actual_velocity.{at}", 3, unit="rad/s")
                _bar(f"actual_velocity.{at}", "velocity", "rad/s")
                live_value(f"actual_torque.{at}", 2)
                _bar(f"actual_torque.{at}", "torque", "Nm")
                live_value(f"error.{at}", 5, unit="rad")
                live_value(f"temperature.{at}", 1)


def _bar(name: str, limits: str, unit: str) -> None:
    """Show a value between the limits in force: two by their names, or one for both ways."""
    with ui.element("td"):
        bar = ui.element("div").classes("bar")
        bar.props.update({"data-bar": name, "data-limits": limits, "data-in": unit})
