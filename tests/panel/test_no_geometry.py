"""An arm of 7 joints without `kinematics`: the panel says so, and offers what such an arm supports."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect
from ruamel.yaml import YAML

from tests.e2e.conftest import Platform
from tests.leftovers import Leftovers
from tests.panel.conftest import PERIOD_US, begun, show, visitor
from tests.waiting import until

pytestmark = [pytest.mark.platform, pytest.mark.browser]


@pytest.fixture(scope="module")
def platform(leftovers: Leftovers) -> Iterator[Platform]:
    """An enabled platform with seven joints."""
    started = Platform()
    leftovers.shared.add(str(started.directory))
    try:
        started.be_patient(lost_ms=2000, period_us=PERIOD_US)
        without_geometry(started, 7)
        started.rtcp("start", "--detach")
        started.call("enable")
        yield started
    finally:
        started.end()
        leftovers.shared.discard(str(started.directory))


def without_geometry(platform: Platform, joints: int) -> None:
    """Remove the geometry from the platform's files, and set the number of joints."""
    yaml, directory = YAML(typ="safe"), platform.directory / "config"
    arm = yaml.load((directory / "assistive_arm.yaml").read_text())
    segment = yaml.load((directory / "segment.yaml").read_text())
    for key in ("kinematics", "cartesian", "jog", "rest_pose"):
        del arm[key]
    last = arm["joints"][-1]
    names = [f"drive{n}" for n in range(1, joints + 1)]
    arm["joints"] = [*arm["joints"], {**last, "name": "joint7", "slave": "drive7"}][:joints]
    arm["slaves"] = [arm["slaves"][0], *({"name": name, "device": "cubemars-orh"} for name in names)]
    segment["slaves"] = [*segment["slaves"], segment["slaves"][-1]][: joints + 1]
    for file, data in (("assistive_arm.yaml", arm), ("segment.yaml", segment)):
        with (directory / file).open("w") as written:
            yaml.dump(data, written)


def test_pages_say_that_there_is_no_geometry_and_offer_joints_alone(browser: Browser, platform: Platform) -> None:
    with begun(platform) as (_, url), visitor(browser, url) as page:
        for path in ("/arm", "/jog"):
            show(page, path)
            expect(page.locator("#space")).to_contain_text("The arm has no geometry (the key kinematics is missing)")
            expect(page.get_by_text("No platform runs")).to_have_count(0)
            expect(page.locator("[data-live^='tool.'], [data-live^='singular.']")).to_have_count(0)
        expect(page.get_by_label("Frame").locator("option")).to_have_text(["Joints"])
        expect(page.get_by_role("button", name="Up, +Z")).to_have_count(0)
        expect(page.get_by_label("Speed, m/s")).to_be_hidden()
        page.get_by_role("button", name="joint7 +").hover()
        page.mouse.down()
        until(lambda: abs(platform.status()["joints"]["actual_position"][-1]) > 1e-3, "the jog")
        page.mouse.up()
        platform.until(lambda status: status["state"] == "holding", "rest")
        show(page, "/targets")
        expect(page.get_by_label("Target", exact=True).locator("option")).to_have_text(["Joint positions"])
        expect(page.get_by_role("button", name="Solutions")).to_have_count(0)
        page.get_by_label("joint7, rad", exact=True).fill("0.2")
        page.get_by_role("button", name="Plan", exact=True).click()
        page.get_by_role("button", name="Send").click()
        expect(page.get_by_text("There; largest error")).to_be_visible()
        assert platform.status()["joints"]["actual_position"][-1] == pytest.approx(0.2, abs=1e-3)
