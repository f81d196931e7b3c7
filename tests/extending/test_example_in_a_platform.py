"""The example's thermometer in a whole platform, without a line elsewhere: shown, recorded, measured, and commanded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from rtcp.api import Robot, RtcpError
from rtcp.api.feed import Feed
from rtcp.ipc import recording
from rtcp.ipc.runtime_directory import control_socket
from rtcp.panel.live import Live
from rtcp.panel.metrics import exposition
from rtcp.panel.scope import signals_of
from rtcp.telemetry.reading import Reader, read
from tests.e2e.conftest import Platform
from tests.leftovers import Leftovers

from .conftest import add_thermometer

pytestmark = pytest.mark.platform


@pytest.fixture(scope="module")
def seen(installed: Path, leftovers: Leftovers) -> Iterator[SimpleNamespace]:
    """Outputs of a platform with a thermometer, until the thermometer was too warm and stopped the arm."""
    platform, seen = Platform(), SimpleNamespace()
    leftovers.shared.add(str(platform.directory))
    try:
        platform.be_patient(lost_ms=2000)
        add_thermometer(platform.directory / "config")
        platform.environment["PYTHONPATH"] = str(installed)
        platform.rtcp("start", "--detach")
        platform.call("enable")
        kept = platform.directory / "kept"
        platform.call("record_start", formats=["mcap", "csv"], signals=["thermometer_*"], out=str(kept))
        seen.status = platform.status()
        feed = Feed(platform.directory)
        seen.scope = signals_of(feed.config, feed.schema)
        feed.close()
        with Robot("a test", control_socket(platform.directory)) as robot:
            shown = robot.status()
            seen.metrics = exposition(cast(Live, SimpleNamespace(status=shown, pages={}))).decode()
            with pytest.raises(RtcpError) as refused:
                robot.command("set_alarm", kelvin=200.0)
            seen.refused = refused.value
            seen.alarm = robot.status().raw["devices"]["thermometer"]["second"]["value"] + 3.0
            robot.command("set_alarm", kelvin=seen.alarm)
        platform.until(lambda shown: shown["state"] == "fault", "the fault")
        platform.until(lambda _: any(platform.directory.glob("state/faults/*.mcap")), "the recording of the fault")
        platform.call("record_stop")
        (seen.mcap,), (seen.csv,) = kept.glob("*.mcap"), kept.glob("*.csv")
        (seen.black_box,) = platform.directory.glob("state/faults/*.mcap")
        yield seen
    finally:
        platform.end()
        leftovers.shared.discard(str(platform.directory))


def test_its_values_are_shown_recorded_and_measured_with_their_unit(seen: SimpleNamespace) -> None:
    device = seen.status["devices"]["thermometer"]
    assert device["first"] == {"value": pytest.approx(300.0), "unit": "K"}
    assert device["second"]["value"] > 300.0
    assert seen.scope["thermometer_second"] == "thermometer second"
    assert 'rtcp_device_value{device="thermometer",field="first",unit="K"} 300.0' in seen.metrics
    recording, reader = read(seen.mcap), Reader(seen.mcap)
    list(reader)
    assert recording.records.dtype.names == ("number", "time_ns", "thermometer_first", "thermometer_second")
    assert reader.schema["thermometer_first"].unit == "K"
    assert b"float64 thermometer_first  # thermometer, K: Input 0x6000:01" in reader.schema.definition()
    assert recording.records["thermometer_first"] == pytest.approx(300.0)
    # 10 K a second.
    assert recording.records["thermometer_second"][-1] > seen.alarm + 10.0
    header, first, *_ = seen.csv.read_text().splitlines()
    row = dict(zip(header.split(","), first.split(","), strict=True))
    assert row["thermometer_first"] == "300"


def test_its_command_is_refused_in_its_own_words_or_leads_to_its_event_and_its_fault_in_the_black_box(
    seen: SimpleNamespace,
) -> None:
    assert seen.refused.kind == "refused"
    assert str(seen.refused).startswith("an alarm at 200 K would be active at once: the second channel has")
    log = [line.message for line in read(seen.mcap).log]
    assert any(message.startswith("the second channel has") and message.endswith(" K") for message in log)
    assert any(message.endswith("more than 10 K above the alarm") for message in log)
    fault = recording.read(seen.black_box)
    assert fault.about.what.endswith("more than 10 K above the alarm")
    assert fault.records["thermometer_second"][fault.about.at] > seen.alarm + 9.9
    assert fault.schema["thermometer_second"].unit == "K"


def test_an_arm_on_a_bus_of_another_package_is_moved_and_what_the_bus_lacks_is_said(installed: Path) -> None:
    platform = Platform()
    try:
        file = platform.directory / "bench.yaml"
        limits = "position: {min: -1, max: 1}, velocity: 1, acceleration: 5, jerk: 50"
        joints = "".join(f"  - {{name: {name}, {limits}}}\n" for name in ("lift", "tilt"))
        file.write_text(
            f"name: bench\nbus: {{kind: bench, start: 0.25}}\ncycle: {{period_us: 4000}}\njoints:\n{joints}"
        )
        platform.environment |= {"PYTHONPATH": str(installed), "RTCP_CONFIG": str(file)}
        assert "a bench of 2 joints" in platform.rtcp("start", "--detach").stdout
        platform.call("enable")
        assert "arrived" in platform.rtcp("move", "0.5", "-0.5").stdout
        status = platform.status()
        assert status["joints"]["actual_position"] == pytest.approx([0.5, -0.5], abs=1e-6)
        assert (status["bus_kind"], status["drive_states"][0]) == ("bench", "operation enabled")
        refused = platform.rtcp("sdo", "read", "1", "0x6041", check=None)
        assert "a bench has no objects" in refused.stderr
    finally:
        platform.end()
