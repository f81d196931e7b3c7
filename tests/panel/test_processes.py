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
        platform.rtcp("start", "--detach", "--config", str(HEATER), "--cycle-us", "2000")
        platform.rtcp("enable")
        platform.rtcp("segment", "fault", "contacts", "slave=1", "closed=14")
        with begun(platform) as (_, url):
            yield url
    finally:
        platform.end()
        leftovers.shared.discard(str(platform.directory))


def test_the_heater_shows_what_it_publishes_and_is_armed_measured_refused_and_stopped(page: Page) -> None:
    show(page, "/processes")
    expect(page.locator("[data-live='processes.heater.state']")).to_have_text("ready")
    for kind in ShapeSettingConfig.COMMANDS:
        name = kind.name.replace("_", " ").capitalize()
        expect(page.get_by_role("button", name=name, exact=True)).to_be_visible()
    expect(page.locator(".lamps")).to_contain_text("red: off")
    expect(page.get_by_role("row", name="average current")).to_be_visible()
    expect(page.get_by_role("row", name="over_current 280")).to_be_visible()
    expect(page.locator("canvas")).not_to_have_count(0)
    assert barriers(page) == {}
    page.get_by_role("button", name="Arm heater", exact=True).click()
    expect(page.locator("[data-live='processes.heater.state']")).to_have_text("armed")
    expect(page.locator(".lamps")).to_contain_text("red: on")
    measurement = page.get_by_role("group", name="Measure resistance")
    measurement.get_by_label("Straight and unloaded").select_option("yes")
    measurement.get_by_label("Phase").select_option("austenite")
    measurement.get_by_role("button", name="Measure resistance", exact=True).click()
    expect(page.locator("[data-live='processes.heater.fields.initial_resistance']")).to_contain_text(
        re.compile(r"0\.34|0\.3399")
    )
    page.get_by_role("button", name="Stop heating", exact=True).click()
    expect(page.locator(".lamps")).to_contain_text("red: off")
    expect(page.locator("[data-live='processes.heater.state']")).to_have_text("ready")
    page.get_by_role("button", name="Arm heater", exact=True).click()
    expect(page.locator(".lamps")).to_contain_text("red: on")
    page.locator("[data-stop]").click()
    expect(page.locator(".lamps")).to_contain_text("red: off")
    page.get_by_role("button", name="Start heating", exact=True).click()
    expect(page.get_by_text("the command needs it armed")).to_be_visible()
    page.get_by_role("button", name="Set heat profile", exact=True).click()
    expect(page.get_by_text("allowed is a number")).to_be_visible()
