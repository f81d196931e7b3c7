"""The page Processes, made from the heater's description, and used as a person would."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from rtcp.processes.shape_setting.config import ShapeSettingConfig
from tests.e2e.conftest import Platform
from tests.leftovers import Leftovers
from tests.panel.conftest import barriers, begun, show

pytestmark = [pytest.mark.platform, pytest.mark.browser]
HEATER = Path(__file__).parents[2] / "config/heater.yaml"


@pytest.fixture(scope="module")
def panel(leftovers: Leftovers) -> Iterator[str]:
    platform = Platform()
    leftovers.shared.add(str(platform.directory))
    try:
        platform.rtcp("start", "--detach", "--config", str(HEATER))
        platform.rtcp("enable")
        platform.rtcp("segment", "fault", "contacts", "slave=1", "closed=14")
        with begun(platform) as (_, url):
            yield url
    finally:
        platform.end()
        leftovers.shared.discard(str(platform.directory))


def test_the_heater_shows_what_it_publishes_and_is_armed_measured_refused_and_stopped(drawing: Page) -> None:
    show(drawing, "/processes")
    expect(drawing.locator("[data-live='processes.heater.state']")).to_have_text("ready")
    for kind in ShapeSettingConfig.COMMANDS:
        name = kind.name.replace("_", " ").capitalize()
        expect(drawing.get_by_role("button", name=name, exact=True)).to_be_visible()
    expect(drawing.locator(".lamps")).to_contain_text("red: off")
    expect(drawing.get_by_role("row", name="average current")).to_be_visible()
    expect(drawing.get_by_role("row", name="over_current 280")).to_be_visible()
    expect(drawing.locator("canvas")).not_to_have_count(0)
    assert barriers(drawing) == {}
    drawing.get_by_role("button", name="Arm heater", exact=True).click()
    expect(drawing.locator("[data-live='processes.heater.state']")).to_have_text("armed")
    expect(drawing.locator(".lamps")).to_contain_text("red: on")
    drawing.get_by_label("Straight and unloaded").select_option("yes")
    drawing.get_by_label("Phase").select_option("austenite")
    drawing.get_by_role("button", name="Measure resistance", exact=True).click()
    expect(drawing.locator("[data-live='processes.heater.fields.initial_resistance']")).to_contain_text(
        re.compile(r"0\.34|0\.3399")
    )
    drawing.get_by_role("button", name="Stop heating", exact=True).click()
    expect(drawing.locator(".lamps")).to_contain_text("red: off")
    expect(drawing.locator("[data-live='processes.heater.state']")).to_have_text("ready")
    drawing.get_by_role("button", name="Arm heater", exact=True).click()
    expect(drawing.locator(".lamps")).to_contain_text("red: on")
    drawing.locator("[data-stop]").click()
    expect(drawing.locator(".lamps")).to_contain_text("red: off")
    drawing.get_by_role("button", name="Start heating", exact=True).click()
    expect(drawing.get_by_text("the command needs it armed")).to_be_visible()
    drawing.get_by_role("button", name="Set heat profile", exact=True).click()
    expect(drawing.get_by_text("allowed is a number")).to_be_visible()
