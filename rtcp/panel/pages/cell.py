"""Cell: all arms of the cell that this panel's arm belongs to: their states, commands to all, motions in step."""

from __future__ import annotations

from collections.abc import Sequence

from nicegui import ui

from rtcp.api import RtcpError
from rtcp.config.cell import CellConfig, Member
from rtcp.config.numbers import angle, plain_number
from rtcp.panel.page import Field, View, button, field, live_value, number, table, text
from rtcp.panel.partners import arm_state


def build(view: View) -> None:
    """Build the page."""
    text("h1", "Cell")
    cell, own = view.live.partners.cell, view.live.partners.own
    if cell is None or own is None:
        text("p", "This arm is in no cell that runs: rtcp cell start, docs/cell.md.")
        return
    _arms(cell, own)
    with ui.element("div").classes("buttons"):
        button("Enable all", lambda: view.act_in_cell(lambda arms: arms.enable(), "The drives of all arms hold"))
        button(
            "Disable all",
            lambda: view.act_in_cell(lambda arms: arms.disable(), "No arm has torque", instead=True),
            plain=True,
        )
        button("Reset all", lambda: view.act_in_cell(lambda arms: arms.reset(), "Reset"), plain=True)
        button("Halt all", view.halt, plain=True)
    InStep(view, cell)
    commands = ", ".join(f"rtcp --name {arm.name} panel --port 8081" for arm in cell.arms if arm is not own)
    text("p", f"This panel operates {own.name}, and STOP stops all. A panel of another arm: {commands}")


def _arms(cell: CellConfig, own: Member) -> None:
    with table(("Arm", "State", "In step", "Commanded by", "What happened last"), "Arms"):
        for arm in cell.arms:
            where = "" if arm is own else f"partners.{arm.name}."
            with ui.element("tr").props(f"data-arm={arm.name}"):
                text("th", arm.name, scope="row")
                with ui.element("td"):
                    live_value(f"{where}state", tag="span")
                for key in ("step", "holder", "message"):
                    live_value(f"{where}{key}")


class InStep:
    """Joint positions of the arms, and a motion that all begin and end together."""

    def __init__(self, view: View, cell: CellConfig) -> None:
        self._view = view
        text("h2", "Motion in step")
        with ui.element("div").classes("page"):
            self._joints = {arm.name: field(f"Joints of {arm.name}, rad (empty: it stays)") for arm in cell.arms}
        with ui.element("div").classes("fields"):
            self._speed = number("Speed (empty: the limit)", unit="rad/s", min="0")
        with ui.element("div").classes("buttons"):
            button("Here", self._here, plain=True)
            button("Move in step", self._move)
        self._notice = text("p", "", role="status", **{"aria-live": "polite"})

    def _here(self) -> None:
        live = self._view.live
        states = {name: arm_state(live.feed) for name in self._joints} | live.partners.state()
        for name, control in self._joints.items():
            control.value = ", ".join(f"{q:.4g}" for q in states[name].get("q", ()))

    async def _move(self) -> None:
        try:
            targets = {name: _numbers(name, control) for name, control in self._joints.items() if control.value.strip()}
            speed = self._speed.number() if self._speed.value.strip() else None
        except RtcpError as error:
            self._view.warn(error.message)
            return
        self._notice.text = "Moving"
        arrived = await self._view.act_in_cell(lambda arms: arms.move_joints(targets, speed))
        errors = (f"{name} {end.error:.5f} rad" for name, end in (arrived or {}).items())
        self._notice.text = "" if arrived is None else f"There; largest errors of a joint: {', '.join(errors)}"


def _numbers(name: str, control: Field) -> Sequence[float]:
    """Return the joint positions of a field; raises Invalid."""
    try:
        return [plain_number(angle(value.strip())) for value in control.value.split(",")]
    except ValueError:
        allowed = "allowed are joint positions, rad, with commas between"
        raise RtcpError("invalid", f'joints of {name}: found "{control.value}", {allowed}') from None
