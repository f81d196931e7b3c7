"""The example's thermometer in a whole platform, without a line elsewhere: shown, recorded, measured, and commanded."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from urllib.request import urlopen

import pytest

from rtcp.api import Robot, RtcpError
from rtcp.api.feed import Feed
from rtcp.ipc import recording
from rtcp.ipc.runtime_directory import control_socket
from rtcp.panel.scope import signals_of
from rtcp.telemetry.reading import Reader, read
from tests.e2e.conftest import Platform
from tests.panel.conftest import begun

from .conftest import add_thermometer

pytestmark = pytest.mark.platform


@pytest.fixture(scope="module")
def seen(installed: Path) -> Iterator[SimpleNamespace]:
    """Outputs of a platform with a thermometer, until the thermometer was too warm and stopped the arm."""
    platform, seen = Platform(), SimpleNamespace()
    try:
        platform.be_patient(lost_ms=2000)
        add_thermometer(platform.directory / "config")
        platform.environment["PYTHONPATH"] = str(installed)
        platform.rtcp("start", "--detach")
        platform.call("enable")
        kept = platform.directory / "kept"
        signals = ("--signals", "thermometer_*")
        platform.rtcp("record", "start", "--format", "mcap,csv", *signals, "--out", str(kept))
        seen.status = json.loads(platform.rtcp("status", "--json").stdout)
        feed = Feed(platform.directory)
        seen.scope = signals_of(feed.config, feed.schema)
        feed.close()
        with begun(platform) as (_, url):
            platform.until(lambda _: b"rtcp_up 1" in urlopen(f"{url}/metrics").read(), "the state at the panel")
            seen.metrics = urlopen(f"{url}/metrics").read().decode()
        with Robot("a test", control_socket(platform.directory)) as robot:
            with pytest.raises(RtcpError) as refused:
                robot.command("set_alarm", kelvin=200.0)
            seen.refused = refused.value
            seen.alarm = robot.status().raw["devices"]["thermometer"]["second"]["value"] + 3.0
            robot.command("set_alarm", kelvin=seen.alarm)
        platform.until(lambda shown: shown["state"] == "fault", "the fault")
        platform.until(lambda _: any(platform.directory.glob("state/faults/*.mcap")), "the recording of the fault")
        platform.rtcp("record", "stop")
        (seen.mcap,), (seen.csv,) = kept.glob("*.mcap"), kept.glob("*.csv")
        (seen.black_box,) = platform.directory.glob("state/faults/*.mcap")
        yield seen
    finally:
        platform.end()


def test_its_values_are_in_the_status_with_their_unit(seen: SimpleNamespace) -> None:
    device = seen.status["devices"]["thermometer"]
    assert device["first"] == {"value": pytest.approx(300.0), "unit": "K"}
    assert device["second"]["value"] > 300.0


def test_its_values_are_recorded_with_unit_and_meaning(seen: SimpleNamespace) -> None:
    recording, reader = read(seen.mcap), Reader(seen.mcap)
    list(reader)
    assert recording.records.dtype.names == ("number", "time_ns", "thermometer_first", "thermometer_second")
    assert reader.schema["thermometer_first"].unit == "K"
    assert b"float64 thermometer_first  # thermometer, K: Input 0x6000:01" in reader.schema.definition()
    assert recording.records["thermometer_first"] == pytest.approx(300.0)
    # 10 K a second.
    assert recording.records["thermometer_second"][-1] > seen.alarm + 10.0


def test_chosen_they_are_columns_of_a_csv(seen: SimpleNamespace) -> None:
    header, first, *_ = seen.csv.read_text().splitlines()
    row = dict(zip(header.split(","), first.split(","), strict=True))
    assert row["thermometer_first"] == "300"


def test_they_are_signals_of_the_scope(seen: SimpleNamespace) -> None:
    assert seen.scope["thermometer_second"] == "thermometer second"


def test_they_are_metrics(seen: SimpleNamespace) -> None:
    assert 'rtcp_device_value{device="thermometer",field="first",unit="K"} 300.0' in seen.metrics


def test_its_command_is_refused_over_the_control_socket_in_its_own_words(seen: SimpleNamespace) -> None:
    assert seen.refused.kind == "refused"
    assert str(seen.refused).startswith("an alarm at 200 K would be active at once: the second channel has")


def test_its_command_leads_to_its_event_and_its_fault_in_the_recordings_log(seen: SimpleNamespace) -> None:
    log = [line.message for line in read(seen.mcap).log]
    assert any(message.startswith("the second channel has") and message.endswith(" K") for message in log)
    assert any(message.endswith("more than 10 K above the alarm") for message in log)


def test_its_values_are_in_the_black_box_around_its_fault(seen: SimpleNamespace) -> None:
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
