"""Every page of the panel, used as a person would; the API and the files show the result."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect
from prometheus_client.parser import text_string_to_metric_families

from kinematics.forward import forward
from rtcp.config.loader import load
from rtcp.panel.server import PAGES
from rtcp.telemetry.reading import read
from rtcp.virtual.faults.registry import installed
from tests.e2e.conftest import Platform
from tests.panel.conftest import BENT, HOSTILE, PERIOD_US, barriers, show, show_targets, visitor
from tests.waiting import until

pytestmark = [pytest.mark.platform, pytest.mark.browser]
REPOSITORY = Path(__file__).parents[2]
DRIVE_IDENTITY = re.compile(r"vendor_id: (\w+)[\s\S]*product_id: (\w+)")


def tool_of(platform: Platform) -> tuple[float, ...]:
    arm = load(Path(platform.environment["RTCP_CONFIG"])).arm
    assert arm is not None
    return forward(arm, platform.status()["joints"]["commanded_position"]).position


def test_a_platform_is_started_enabled_moved_ended_and_started_as_chosen(
    drawing_browser: Browser, panel: str, platform: Platform
) -> None:
    platform.rtcp("stop", check=None)
    with visitor(drawing_browser, panel) as page:
        page.set_viewport_size({"width": 400, "height": 844})
        show(page, "/jog")
        state = page.locator("header [data-live=state]")
        expect(state).to_have_text("off")
        step = page.locator("#lead li[aria-current]")
        expect(step).to_contain_text("Start the virtual arm")
        step.get_by_role("button").click()
        expect(step).to_contain_text("Enable")
        expect(page.locator(".arm-view canvas")).to_be_visible()  # without a reload
        page.get_by_role("button", name="Enable").click()
        expect(step).to_contain_text("Move it")
        page.get_by_label("Frame").select_option("joints")  # straight up the tool has no way to go
        page.get_by_role("button", name="joint1 +").hover()
        page.mouse.down()
        expect(page.locator("#lead")).to_be_hidden()
        page.mouse.up()
        page.get_by_label("Frame").select_option("base")
        for name in ("Forward, +X", "Back, \N{MINUS SIGN}X", "Yaw +", "Pitch \N{MINUS SIGN}", "Close gripper"):
            expect(page.get_by_role("button", name=name)).to_be_in_viewport(ratio=1)
        page.evaluate("scrollTo(0, document.body.scrollHeight)")
        expect(page.get_by_role("button", name="STOP not the emergency stop")).to_be_in_viewport(ratio=1)
        page.get_by_role("link", name="Alarms", exact=True).click()
        tab = page.get_by_role("link", name="Alarms", exact=True)
        expect(tab).to_be_in_viewport(ratio=1)
        assert tab.evaluate("tab => tab.parentElement.clientHeight") < 60
        page.get_by_role("link", name="Start", exact=True).click()
        page.set_viewport_size({"width": 1200, "height": 700})
        page.get_by_role("button", name="Disable", exact=True).click()
        expect(state).to_have_text("ready")
        page.get_by_role("button", name="Stop the platform").click()
        expect(state).to_have_text("off")
        for name in ("Stop the platform", "Enable", "Disable", "Reset", "Halt"):
            expect(page.get_by_role("button", name=name, exact=True)).to_be_disabled()
        page.get_by_label("Configuration").fill("/nowhere.yaml")
        page.get_by_role("button", name="Start", exact=True).click()
        expect(page.locator("pre")).to_contain_text("/nowhere.yaml")
        page.get_by_label("Configuration").fill(platform.environment["RTCP_CONFIG"])
        page.get_by_label("Bus").select_option("virtual")
        page.get_by_label("Mode", exact=True).select_option("cartesian")
        page.get_by_label("Cycle, us").fill(f"{PERIOD_US // 2}")
        page.get_by_role("button", name="Start", exact=True).click()
        expect(state).to_have_text("ready")
        status = platform.status()
        assert (status["bus"], status["control_mode"], status["cycle_ns"]) == ("virtual", "cartesian", 500 * PERIOD_US)
        page.get_by_label("Control mode").select_option("joint")
        page.get_by_role("button", name="Set control mode").click()
        until(lambda: platform.status()["control_mode"] == "joint", "mode joint")
        expect(page.get_by_role("button", name="Start", exact=True)).to_be_disabled()
        page.get_by_role("button", name="Scan the bus").click()
        drive = DRIVE_IDENTITY.search((platform.directory / "config/devices/cubemars-orh.yaml").read_text())
        assert drive is not None
        for figure in drive.groups():
            expect(page.get_by_role("cell", name=f"0x{int(figure, 0):08X}")).not_to_have_count(0)
        page.get_by_label("Drive mode").select_option("csv")
        page.get_by_role("button", name="Set drive mode").click()
        until(lambda: platform.status()["drive_mode"] == "csv", "csv")
        page.get_by_label("Drive mode").select_option("csp")
        page.get_by_role("button", name="Set drive mode").click()
        until(lambda: platform.status()["drive_mode"] == "csp", "csp")
        page.get_by_role("button", name="Enable").click()
        until(lambda: platform.status()["state"] == "holding", "holding")
        page.get_by_role("button", name="Check this host").click()
        finding = page.get_by_role("row", name=re.compile("^preempt-rt"))
        expect(finding).to_contain_text(re.compile("kernel.*without it", re.DOTALL))


def test_the_arm_is_drawn_as_the_platform_reports_it_with_a_ghost_at_its_goal(drawing: Page, holding: Platform) -> None:
    def camera() -> list[float]:
        place: list[float] = drawing.evaluate("JSON.parse(sessionStorage.getItem('rtcp-camera'))?.at ?? []")
        return place

    show(drawing, "/arm")
    expect(drawing.locator('#menu [data-path="/cell"]')).to_be_hidden()
    expect(drawing.locator("[data-live='temperature.1']")).to_have_text(re.compile(r"^[23]\d\.\d$"))
    for at, value in enumerate(holding.status()["joints"]["actual_position"]):
        value_shown = float(drawing.locator(f"[data-live='actual_position.{at}']").inner_text())
        assert value_shown == pytest.approx(value, abs=1e-3)
    expect(drawing.locator("[data-live='drive.0']")).to_have_text("operation enabled")
    bar = drawing.locator("[data-bar='actual_position.2']")
    assert float(bar.evaluate("e => parseFloat(e.style.getPropertyValue('--at'))")) == pytest.approx(
        100 * (1.57 + 2.4) / 4.8, abs=1
    )
    assert drawing.locator(".arm-view canvas").bounding_box()["height"] > 200
    # Straight up it stands on two singularities, bent it does not.
    expect(drawing.locator(".arm-view")).to_have_attribute("data-near", "0.00")
    holding.call("move_joints", q=[0.0] * 6)
    expect(drawing.locator(".arm-view")).to_have_attribute("data-near", "1.00")
    expect(drawing.locator(".arm-view")).to_have_attribute("data-trail", re.compile(r"^\d{2}"))
    limits = holding.call("limits")["limits"]
    boxes = [limits["box"], *limits["keep_out"].values()]
    shown_boxes = json.loads(drawing.locator(".arm-view").get_attribute("data-boxes") or "")
    assert [(box["min"], box["max"]) for box, _ in shown_boxes] == [(box["min"], box["max"]) for box in boxes]
    assert [is_kept_out for _, is_kept_out in shown_boxes] == [False, True, True]
    canvas = drawing.locator(".arm-view canvas")
    canvas.press("ArrowUp")
    above = camera()
    canvas.press("ArrowLeft")
    turned = camera()
    assert turned[2] == pytest.approx(above[2])
    assert math.hypot(*turned[:2]) == pytest.approx(math.hypot(*above[:2]))
    assert turned[0] != pytest.approx(above[0], abs=0.05)
    show(drawing, "/arm")
    canvas.press("ArrowRight")
    assert camera() == pytest.approx(above)
    canvas.press("+")
    assert math.dist(camera(), [0, 0, 0.5]) < math.dist(above, [0, 0, 0.5])
    drawing.evaluate("window.canvas = document.querySelector('.arm-view canvas')")
    drawing.get_by_role("link", name="Health", exact=True).click()
    expect(drawing.get_by_role("heading", level=1)).to_have_text("Health")
    assert drawing.evaluate("canvas.isConnected && canvas.clientHeight > 100")
    drawing.get_by_role("link", name="Arm", exact=True).click()
    holding.call("move_joints", q=BENT)
    show_targets(drawing)
    view = drawing.locator(".arm-view")
    drawing.get_by_label("joint1, rad").fill("0.2")
    drawing.get_by_role("button", name="Plan").click()
    expect(view).to_have_attribute("data-ghost", "plan")
    drawing.get_by_role("link", name="Arm", exact=True).click()
    expect(view).to_have_attribute("data-ghost", "")
    command = holding.background("move", "1.2", *(str(q) for q in BENT[1:]), "--speed", "0.1")
    expect(drawing.locator("#operator")).to_have_text(f"rtcp move (pid {command.pid}) operates the arm")
    expect(view).to_have_attribute("data-ghost", "goal")
    assert drawing.evaluate("rtcp.state.goal") == pytest.approx([1.2, *BENT[1:]])
    drawing.get_by_role("button", name="STOP").click()
    holding.end_commands()
    expect(view).to_have_attribute("data-ghost", "")
    expect(drawing.locator("#operator")).to_have_text("Nobody operates the arm")


def test_the_frame_shows_the_joysticks_mode_and_what_it_controls_in_every_control_mode(
    page: Page, holding: Platform
) -> None:
    show(page, "/arm")
    assert holding.status()["control_mode"] != "joystick"
    expect(page.locator("#joystick")).to_have_text("Joystick X-Y, controls the arm")


@pytest.fixture
def limits_of_the_file(holding: Platform) -> Iterator[Platform]:
    yield holding
    of_the_file = {"joint2.max": 2.0, "box.max.z": 1.4, "cup.angle": 3.0, "supervision.following_error": 0.15}
    holding.call("set_limits", changes=of_the_file)


def test_limits_are_narrowed_and_only_widened_on_purpose_in_the_units_of_the_browser(
    drawing: Page, limits_of_the_file: Platform
) -> None:
    platform = limits_of_the_file
    show(drawing, "/limits")
    drawing.get_by_label("joint2 max").fill("1.5")
    drawing.get_by_label("box max z").fill("1.35")
    drawing.get_by_role("button", name="Set the limits").click()
    until(lambda: platform.call("limits")["limits"]["max"][1] == 1.5, "the limit of joint 2")
    assert platform.call("limits")["limits"]["box"]["max"][2] == 1.35
    with drawing.context.new_page() as second:
        show(second, "/arm")
        expect(second.locator("[data-bar='actual_position.1']")).to_have_attribute("title", re.compile(" to 1.5 rad$"))
        expect(second.locator(".arm-view")).to_have_attribute("data-boxes", re.compile(r"1\.35\]"))
    drawing.get_by_label("joint2 max").fill("3")
    drawing.get_by_role("button", name="Set the limits").click()
    refusal = drawing.locator(".q-notification", has_text="joint2")
    expect(refusal).to_be_visible()
    colour = "element => getComputedStyle(element).color"
    assert refusal.get_by_role("button", name="Close").evaluate(colour) == refusal.evaluate(colour)
    assert platform.call("limits")["limits"]["max"][1] == 1.5
    platform.call("set_limits", changes={"joint3.max": 2.1})  # not from this drawing
    drawing.get_by_role("button", name="As the file allows").click()
    until(lambda: platform.call("limits")["limits"] == platform.call("limits")["configured"], "the limits of the file")
    expect(drawing.get_by_label("joint2 max")).to_have_value("2")
    show(drawing, "/targets")
    drawing.get_by_label("Angles").select_option("deg")
    drawing.get_by_label("Lengths").select_option("mm")
    expect(drawing.get_by_label("joint3, deg")).to_have_value(re.compile(r"^(89\.9|90)"))
    drawing.get_by_label("joint1, deg").fill("10")
    drawing.get_by_label("joint4, slider").press("ArrowRight")
    drawing.get_by_role("spinbutton", name="Speed (empty: the limit), deg/s").fill("20")
    drawing.get_by_role("button", name="Plan").click()
    drawing.get_by_role("button", name="Send", exact=True).click()
    until(lambda: abs(platform.status()["joints"]["actual_position"][0] - math.radians(10)) < 1e-4, "10 degrees")
    step = pytest.approx(0.001, abs=1e-6)
    until(lambda: platform.status()["joints"]["commanded_position"][3] == step, "a step of the slider")
    show(drawing, "/arm")  # loaded anew: the browser has kept them
    expect(drawing.locator("[data-live='actual_position.0']")).to_have_text("10.00")
    expect(drawing.locator("[data-live='tool.2']")).to_have_text(f"{1000 * tool_of(platform)[2]:.1f}")
    expect(drawing.locator("[data-bar='actual_position.0']")).to_have_attribute("title", "-177.6 to 177.6 deg")
    show(drawing, "/limits")
    expect(drawing.get_by_label("box max z, mm")).to_have_value("1400")
    drawing.get_by_label("Lengths").select_option("m")
    expect(drawing.get_by_label("box max z, m")).to_have_value("1.4")
    drawing.get_by_label("Angles").select_option("rad")
    expect(drawing.get_by_label("joint2 max, rad")).to_have_value("2")
    drawing.get_by_label("cup angle").fill("2.9")
    drawing.get_by_label("supervision following error").fill("0.1")
    drawing.get_by_role("button", name="Set the limits").click()
    until(lambda: platform.call("limits")["limits"]["cones"]["cup"]["angle"] == 2.9, "the cone")
    assert platform.call("limits")["limits"]["supervision"]["following_error"] == 0.1
    platform.call("disable")
    drawing.get_by_label("joint2 max").fill("2.05")
    drawing.get_by_role("button", name="Beyond the file").click()
    drawing.get_by_role("button", name="Widen the limits").click()
    until(lambda: platform.call("limits")["limits"]["max"][1] == 2.05, "the wider limit of joint 2")


def test_a_recording_is_made_and_drawn_and_a_motion_file_is_run(page: Page, holding: Platform, tmp_path: Path) -> None:
    show(page, "/recorder")
    page.get_by_label("File name").fill("cup")
    page.get_by_role("button", name="Record", exact=True).click()
    running = page.get_by_text(re.compile(r"cup\.mcap: [1-9]\d* samples, 0 missing"))
    expect(running).to_be_visible()
    page.get_by_role("button", name="Stop recording").click()
    expect(page.get_by_text("Nothing is recorded")).to_be_visible()
    page.get_by_role("button", name="Show the files").click()
    with page.expect_download() as download:
        page.get_by_role("link", name="Download cup.mcap").click()
    download.value.save_as(tmp_path / "cup.mcap")
    assert len(read(tmp_path / "cup.mcap").records) > 100
    page.get_by_role("button", name="Plot cup.mcap").click()
    picture = page.get_by_alt_text("Plot of cup.mcap")
    expect(picture).to_be_visible()
    assert picture.evaluate("image => image.naturalWidth") > 100
    # If a visitor leaves while the panel works, the panel prints no traceback: `begun` would find it.
    page.get_by_role("button", name="Plot cup.mcap").click()
    show(page, "/")
    page.get_by_role("button", name="Scan the bus").click()
    there = [0.2, *BENT[1:]]
    program = tmp_path / "program.yaml"
    program.write_text(f"trajectory:\n  - {{t: 0, q: {BENT}}}\n  - {{t: 2, q: {there}}}\n")
    show(page, "/recorder")
    page.get_by_label("Motion file").fill(str(tmp_path / "none.yaml"))
    page.get_by_role("button", name="Check", exact=True).click()
    expect(page.get_by_text(re.compile(r"No: .*none\.yaml"))).to_be_visible()
    beyond = tmp_path / "beyond.yaml"
    beyond.write_text(f"trajectory:\n  - {{t: 0, q: {BENT}}}\n  - {{t: 9, q: {[3.3, *BENT[1:]]}}}\n")
    page.get_by_label("Motion file").fill(str(beyond))
    page.get_by_role("button", name="Run").click()
    expect(page.get_by_text(re.compile("No: .*joint1.*3.1 rad"))).to_be_visible()
    page.get_by_label("Motion file").fill(str(program))
    page.get_by_role("button", name="Check", exact=True).click()
    expect(page.get_by_text(re.compile("It can be run"))).to_be_visible()
    page.get_by_role("button", name="Run").click()
    expect(page.get_by_label("Progress")).to_have_attribute("value", re.compile(r"^0\.[1-9]"))
    expect(page.get_by_text("Done")).to_be_visible()
    expect(page.get_by_label("Progress")).to_have_attribute("value", "1")
    assert holding.status()["joints"]["actual_position"][0] == pytest.approx(0.2, abs=1e-3)
    page.get_by_role("button", name="Run").click()
    holding.until(lambda status: status["state"] == "moving", "moving")
    page.get_by_role("button", name="Stop the program").click()
    holding.until(lambda status: status["state"] == "holding", "holding")
    expect(page.get_by_text("It has not reached its end")).to_be_visible()
    expect(page.locator(".q-notification")).not_to_have_count(0)
    expect(page.locator(".q-notification.bg-negative")).to_have_count(0)


def test_the_scope_shows_and_keeps_what_moves(page: Page, holding: Platform, tmp_path: Path) -> None:
    show(page, "/scope")
    page.get_by_label("Time base").fill("1")
    page.get_by_label("Signal", exact=True).select_option("actual_velocity.0")
    page.get_by_role("button", name="Add the signal").click()
    page.get_by_label("Trigger", exact=True).select_option("commanded_position.0")
    page.get_by_label("Level", exact=True).fill("0.05")
    token = page.evaluate("rtcp.token")
    until(lambda: page.evaluate("rtcp.token") > token + 1e9, "messages of a scope that waits for its trigger")
    before = page.locator("[data-shown]").get_attribute("data-shown") if page.locator("[data-shown]").count() else "0"
    holding.call("move_joints", q=[0.2, *BENT[1:]])
    until(
        lambda: (
            page.locator("[data-shown]").count() and page.locator("[data-shown]").get_attribute("data-shown") != before
        ),
        "the trigger",
    )
    page.get_by_role("button", name="Freeze").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="CSV").click()
    download.value.save_as(tmp_path / "scope.csv")
    head, *lines = (tmp_path / "scope.csv").read_text().splitlines()
    assert head == "Time,actual_position.0,commanded_position.0,actual_velocity.0"
    rows = [[float(value) for value in line.split(",")] for line in lines]
    at_trigger = min(rows, key=lambda row: abs(row[0]))
    assert at_trigger[2] == pytest.approx(0.05, abs=2e-3)
    assert rows[0][0] == pytest.approx(-0.2, abs=0.01)
    assert max(row[3] for row in rows) > 0.1
    picture = page.get_by_role("group", name="Signals over time")
    picture.press("Enter")
    picture.press("Shift+ArrowRight")
    # The record nearest to 0.35 s: a cycle can be lost on this host.
    expect(page.get_by_text(re.compile(r"^A 0\.3[45]"))).to_be_visible()
    picture.click(position={"x": 300, "y": 100})
    expect(page.get_by_text(re.compile(r"^A 0\.3[45].*B - A"))).to_be_visible()
    for _ in range(2):
        picture.press("+")
    with page.expect_download() as download:
        page.get_by_role("button", name="CSV").click()
    download.value.save_as(tmp_path / "zoomed.csv")
    zoomed = (tmp_path / "zoomed.csv").read_text().splitlines()
    assert len(lines) / 6 < len(zoomed) < len(lines) / 2
    assert set(zoomed) < {head, *lines}


def test_faults_of_the_segment_are_made_and_objects_read_and_written(page: Page, holding: Platform) -> None:
    show(page, "/segment")
    expect(page.get_by_role("row")).to_have_count(8)
    expect(page.get_by_text(re.compile("Distributed clocks locked, offset -?\\d"))).to_be_visible()
    page.get_by_label("Index, hex").fill("1018")
    page.get_by_label("Subindex").fill("1")
    page.get_by_role("button", name="Read").click()
    vendor = int.from_bytes(bytes.fromhex(holding.call("sdo_read", slave=2, index=0x1018, subindex=1)["hex"]), "little")
    expect(page.get_by_text(f"({vendor})")).to_be_visible()
    expect(page.get_by_role("button", name="Write")).to_be_disabled()  # the drives have torque
    mark = page.get_by_text(re.compile(r"^Joint values are [\d.]+ s old"))
    expect(mark).to_be_hidden()
    expect(page.get_by_label("Kind", exact=True)).to_be_visible()
    assert page.get_by_label("Kind", exact=True).locator("option").all_inner_texts() == list(installed())
    page.get_by_label("Kind", exact=True).select_option("corrupt")
    expect(page.get_by_text("Frames are damaged on the cable behind slave")).to_be_visible()
    page.get_by_label("after:").fill("4")
    page.get_by_label("burst:").fill("40")
    page.get_by_role("button", name="Make the fault").click()
    # Errors on the outward path are counted at the next slave's port towards the master.
    damaged = page.get_by_role("row", name=re.compile("^5 ")).get_by_role("cell").nth(5)
    expect(damaged).to_have_text(re.compile(r"^[1-9]\d* / 0 / 0 / 0$"))
    since = holding.last_event()
    page.get_by_label("Kind", exact=True).select_option("power")
    page.get_by_label("slave:").fill("3")
    page.get_by_label("Lasts").fill("")
    page.get_by_role("button", name="Make the fault").click()
    until(lambda: "slave_lost" in holding.events(since) or holding.status()["state"] == "fault", "the slave is lost")
    expect(page.get_by_text(re.compile(r"^fault \d+: power, for"))).to_be_visible()
    expect(mark).to_be_visible()
    assert barriers(page) == {}
    page.get_by_role("button", name="Clear all").click()
    expect(page.locator("[data-live=state]")).to_have_text("fault")
    holding.until(lambda status: all(slave["state"] == "OP" for slave in status["slaves"]), "OP again")
    expect(page.locator("td", has_text=re.compile("^OP$"))).to_have_count(7)
    expect(mark).to_be_hidden()
    holding.call("reset")
    for value in ("d1070000", "d0070000"):
        page.get_by_label("Index, hex").fill("6065")
        page.get_by_label("Subindex").fill("0")
        page.get_by_label("Bytes, hex").fill(value)
        page.get_by_role("button", name="Write").click()
        expect(page.get_by_text("Written").last).to_be_visible()
        assert holding.call("sdo_read", slave=2, index=0x6065, subindex=0)["hex"] == value


def test_health_is_drawn_and_served_and_an_alarm_waits_until_it_is_acknowledged(
    page: Page, holding: Platform, panel: str
) -> None:
    show(page, "/health")
    for name in ("Wake-up", "Exchange", "Compute"):
        path = page.get_by_label(f"Histogram: {name}").locator("path")
        expect(path).to_have_attribute("d", re.compile(r"^M\d+ 1V0\.\d+"))
    expect(page.get_by_role("row", name=re.compile("^wake-up [0-9]"))).to_contain_text(re.compile(r"\d+\.\d"))
    expect(page.get_by_text(re.compile(r"^\d+ of \d+ cycles skipped"))).to_be_visible()
    line = page.get_by_role("row", name=re.compile("^joint3 torque")).locator("polyline")
    expect(line).to_have_attribute("points", re.compile(r"^\d"))
    expect(page.get_by_role("row", name=re.compile(r"^wake-up p99 [\d.]+ [\d.]+ [\d.]+ us"))).to_be_visible()
    page.get_by_role("link", name="Alarms", exact=True).click()
    holding.call("halt")
    expect(page.get_by_role("row", name="halted at rest").first).to_be_visible()
    while page.locator("tr.waits").count():
        page.locator("tr.waits").get_by_role("button", name=re.compile("^Acknowledge")).first.click()
        page.wait_for_timeout(200)
    expect(page.locator("#alarmed")).to_be_hidden()
    holding.rtcp("segment", "fault", "drive", "slave=3", "error=over-current")
    holding.until(lambda status: status["state"] == "fault", "fault")
    recorded = Path(holding.environment["RTCP_STATE_DIR"], "faults")
    until(lambda: list(recorded.glob("fault-*.mcap")), "the fault is recorded")
    page.get_by_role("button", name="Show the recorded faults").click()
    page.get_by_role("button", name="Picture of fault").first.click()
    picture = page.get_by_alt_text(re.compile("What happened around fault"))
    expect(picture).to_be_visible()
    assert picture.evaluate("image => image.naturalWidth") > 100
    text = page.request.get(f"{panel}/metrics").text()
    metrics = {family.name: family for family in text_string_to_metric_families(text)}
    assert {sample.labels["state"] for sample in metrics["rtcp_state"].samples if sample.value} == {"fault"}
    assert metrics["rtcp_cycles"].samples[0].value > 0
    assert len(metrics["rtcp_joint_position_radians"].samples) == 6
    assert len(metrics["rtcp_tool_pose_metres"].samples) == 3
    assert metrics["rtcp_tool_pose_metres"].samples[2].value > 0.0
    drawn = set(re.findall(r"\brtcp_\w+", (REPOSITORY / "config/grafana/rtcp.json").read_text()))
    assert drawn
    assert drawn <= {sample.name for family in metrics.values() for sample in family.samples}
    expect(page.locator("#alarmed")).to_have_text("1 alarm")
    alarm = page.locator("tr.waits")
    expect(alarm).to_contain_text(re.compile("joint2: the drive is in fault.*Remove the cause, then Reset and Enable"))
    alarm.get_by_role("button", name="Acknowledge").click()
    expect(alarm).to_have_count(0)
    expect(page.get_by_role("row", name=re.compile("by local"))).not_to_have_count(0)
    expect(page.locator("#alarmed")).to_be_hidden()
    page.get_by_role("button", name="Reset").click()
    holding.until(lambda now: now["state"] == "ready", "reset")


FOCUSABLE = "button:not([disabled]), a[href], input, select, [tabindex='0']"
WATCH_FOCUS = """(controls) => {
    window.wanted = new Set([...document.querySelectorAll(controls)]
        .filter((one) => one.checkVisibility() && one.tabIndex >= 0));
    window.unseen = [];
    if (!window.watching) document.addEventListener("focusin", ({ target }) => {
        wanted.delete(target);
        const style = getComputedStyle(target);
        if (style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2) return;
        unseen.push(target.outerHTML.slice(0, 150));
    });
    window.watching = true;
    return window.wanted.size;
}"""
NOT_FOCUSED = """[unseen, [...wanted].filter((one) => one.isConnected && !one.disabled && one.checkVisibility())
    .map((one) => one.outerHTML.slice(0, 150))]"""


def test_every_page_is_usable_on_a_phone_in_the_dark_by_keys_and_shows_names_as_text(
    page: Page, holding: Platform
) -> None:
    problems: dict[str, object] = {}
    page.set_viewport_size({"width": 360, "height": 800})
    show(page, "/jog")
    page.get_by_label("Frame").select_option("joints")
    for path, tab in PAGES.items():
        if path in ("/cell", "/processes"):
            continue  # shown in a cell, and where a process runs
        page.get_by_role("link", name=tab.name, exact=True).click()
        expect(page.get_by_role("heading", level=1)).to_have_text(tab.name)
        expect(page).to_have_url(re.compile(f"{path}$"))
        page.wait_for_timeout(300)
        problems |= {f"{path} {rule}": nodes for rule, nodes in barriers(page).items()}
        if page.evaluate("document.documentElement.scrollWidth > innerWidth"):
            problems[f"{path} is wider than the screen"] = page.evaluate("document.documentElement.scrollWidth")
        expect(page.get_by_role("button", name="STOP not the emergency stop")).to_be_in_viewport()
        page.emulate_media(color_scheme="dark")
        page.set_viewport_size({"width": 1920, "height": 800})
        problems |= {f"{path} in the dark {rule}": nodes for rule, nodes in barriers(page, "color-contrast").items()}
        for _ in range(page.evaluate(WATCH_FOCUS, FOCUSABLE) + 5):
            page.keyboard.press("Tab")
        unseen, left = page.evaluate(NOT_FOCUSED)
        problems |= {f"{path} {what}": some for what, some in (("no focus", unseen), ("not reached", left)) if some}
        page.emulate_media(color_scheme="light")
        page.set_viewport_size({"width": 360, "height": 800})
        assert page.locator("img[src=x]").count() == 0
        if path == "/segment":
            expect(page.get_by_role("cell", name=f"drive6 {HOSTILE}")).to_be_visible()
        if path == "/arm":
            expect(page.get_by_role("rowheader", name=f"joint6 {HOSTILE}")).to_be_visible()
    page.get_by_role("link", name="Jog", exact=True).click()
    expect(page.get_by_label("Frame")).to_have_value("joints")
    assert problems == {}


def test_terminals_have_their_names_and_outputs_are_set_by_hand(page: Page, holding: Platform) -> None:
    show(page, "/io")
    expect(page.get_by_role("listitem").filter(has_text="emergency stop")).to_contain_text(re.compile(r"io\.10.*high"))
    output = page.get_by_role("switch", name="io.12")

    def is_on() -> bool:
        return bool(holding.status()["devices"]["io"]["outputs"]["value"] >> 11 & 1)

    for value in (True, False):
        output.click()
        until(is_on if value else lambda: not is_on(), "set")
        expect(output).to_have_attribute("aria-checked", str(value).lower())
    holding.rtcp("segment", "fault", "input", "number=1", "how=low")
    expect(page.get_by_role("listitem").filter(has_text="forward")).to_contain_text("low")
    holding.rtcp("segment", "clear")
