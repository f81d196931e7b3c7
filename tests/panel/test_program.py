"""A program taught, run, stepped and paused by clicks; the file and the API show the result."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from rtcp.config.motion_file import read_motion
from tests.e2e.conftest import Platform
from tests.panel.conftest import BENT, barriers, show
from tests.waiting import until

pytestmark = [pytest.mark.platform, pytest.mark.browser]


def file_of(platform: Platform, name: str) -> Path:
    (path,) = platform.directory.rglob(f"programs/{name}.yaml")
    return path


def click(page: Page, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def opened(page: Page, platform: Platform, name: str) -> None:
    for file in platform.directory.rglob(f"programs/{name}.yaml"):
        file.unlink()  # of a test that is repeated
    show(page, "/program")
    page.get_by_label("Program", exact=True).fill(name)
    click(page, "Open")
    expect(page.get_by_text(re.compile("^New; saved as"))).to_be_visible()


def expect_notice(page: Page, text: str) -> None:
    """Wait until the page has the text, possibly after a motion."""
    expect(page.get_by_text(text, exact=True)).to_be_visible()


def kind(page: Page, name: str, its_field: str) -> None:
    """Choose the kind of the new step; its fields follow."""
    page.get_by_label("Kind").select_option(name)
    expect(page.get_by_label(its_field)).to_be_visible()


def keep(page: Page, name: str, kind: str = "q") -> None:
    page.get_by_label("Name of the pose").fill(name)
    page.get_by_label("Kept as").select_option(kind)
    click(page, "Keep where the arm is")
    expect(page.get_by_role("row", name=re.compile(f"^{name} "))).to_be_visible()


def test_a_program_taught_by_clicks_is_checked_stepped_paused_run_stepped_back_and_stopped(
    page: Page, holding: Platform
) -> None:
    there = [0.5, *BENT[1:]]
    opened(page, holding, "clicks")
    keep(page, "here")
    holding.call("move_joints", q=there)
    until(lambda: holding.status()["joints"]["commanded_position"][0] == pytest.approx(0.5), "there")
    keep(page, "there")
    page.get_by_label("Pose", exact=True).select_option("here")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("move to here"))).to_be_visible()
    kind(page, "wait_s", "Time, s")
    page.get_by_label("Time, s").fill("0.2")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("wait 0.2 s"))).to_be_visible()
    page.get_by_label("Pose", exact=True).select_option("there")
    page.get_by_label(re.compile("^Speed .*, rad/s$")).fill("0.2")
    page.get_by_label("Where").select_option("before step 2")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("^2 move to there at 0.2 rad"))).to_be_visible()
    # The wait moves between both and back; then one undo too many.
    click(page, "Move step 3 up")
    expect(page.get_by_role("row", name=re.compile("^2 wait 0.2 s"))).to_be_visible()
    click(page, "Delete step 2")
    expect(page.get_by_role("row", name=re.compile("^2 move to there"))).to_be_visible()
    click(page, "Undo")
    expect(page.get_by_role("row", name=re.compile("^2 wait 0.2 s"))).to_be_visible()
    expect(page.locator(".q-notification")).to_have_count(0)  # one that fades has no contrast
    assert barriers(page) == {}
    steps = read_motion(file_of(holding, "clicks")).program
    assert [(step.move, step.wait_s, step.speed) for step in steps] == [
        ("here", None, None),
        (None, 0.2, None),
        ("there", None, 0.2),
    ]

    click(page, "Check")
    expect(page.get_by_text(re.compile(r"^It can be run: 2 motions"))).to_be_visible()
    for number in (1, 2):
        click(page, "Step")
        expect_notice(page, f"Step {number} is done")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(BENT, abs=2e-3)
    click(page, "Step")
    holding.until_moving()
    click(page, "Pause")
    until(lambda: holding.status()["speed_override"] == 0.0, "paused")
    click(page, "Pause")  # a second press starts nothing
    expect(page.get_by_text("paused: the motion rests on its path")).to_be_visible()
    assert holding.status()["speed_override"] == 0.0
    # Another tab keeps the run.
    page.get_by_role("link", name="Jog", exact=True).click()
    expect(page.get_by_label("Movement")).to_be_visible()
    page.get_by_role("link", name="Program", exact=True).click()
    expect(page.get_by_label("Movement")).to_have_count(0)
    click(page, "Go on")
    expect_notice(page, "Step 3 is done")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(there, abs=2e-3)
    click(page, "Step back")
    expect_notice(page, "Step 3 is next")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(BENT, abs=2e-3)
    click(page, "Run from step 1")
    expect_notice(page, "Done")
    assert holding.status()["joints"]["actual_position"] == pytest.approx(there, abs=2e-3)
    keep(page, "pose", "pose")
    kind(page, "line", "Speed (empty: the program's), m/s")
    page.get_by_label("Pose", exact=True).select_option("pose")
    page.get_by_label("Where").select_option("")
    click(page, "Add the step")
    expect(page.get_by_role("row", name=re.compile("line to pose"))).to_be_visible()
    click(page, "Run from step 1")
    holding.until_moving()
    page.get_by_role("button", name="STOP").click()
    expect_notice(page, "It has ended early")
    until(lambda: holding.status()["state"] == "holding", "held")
