"""The heater without arms: `config/heater.yaml` alone, step by step as an operator does it, through a real gateway."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

import pytest

from rtcp.api import Robot, RtcpError
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import control_socket, segment_control
from rtcp.processes.shape_setting.profile import heat_command, read_profile
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import Platform

pytestmark = pytest.mark.platform

CONFIG = default_config().parent
AUTO, MANUAL, RELEASED = 0x31, 0x0E, 0x02
PROFILE = replace(
    read_profile(CONFIG / "shape_setting" / "nitinol.yaml"), ramp_k_s=50.0, hold_s=1.0, cool_c=400.0, initial_c=20.0
)


class Heater:
    """The heater's platform, and people at its box."""

    def __init__(self) -> None:
        self.platform = platform = Platform()
        platform.be_patient(500)
        file = platform.directory / "config" / "heater.yaml"
        file.write_text(file.read_text().replace("period_us: 500 ", "period_us: 2000 "))
        platform.rtcp("start", "--detach", "--config", str(file))
        platform.rtcp("enable")

    def connect(self) -> Robot:
        return Robot("the tests", control_socket(self.platform.directory))

    def set_contacts(self, closed: int) -> None:
        with SegmentClient(segment_control(self.platform.directory)) as segment:
            # Without a clear between them, which would put the key at Auto for an instant.
            segment.fault({"fault": "contacts", "slave": 1, "closed": closed})
        time.sleep(0.1)

    def truth(self) -> dict[str, Any]:
        with SegmentClient(segment_control(self.platform.directory)) as segment:
            box: dict[str, Any] = segment.truth()["slaves"][0]
        return box

    def until(self, met: Callable[[dict[str, Any]], bool], what: str) -> None:
        end = time.monotonic() + 20.0
        while not met(truth := self.truth()):
            assert time.monotonic() < end, f"{what}: {truth}"
            time.sleep(0.01)

    def assert_off(self) -> None:
        self.until(lambda truth: not (truth["gate"] or truth["relay"]), "heat off")
        for _ in range(50):
            truth = self.truth()
            assert not truth["gate"]
            assert not truth["relay"]
            time.sleep(0.01)


@pytest.fixture(scope="module")
def started() -> Iterator[Heater]:
    made = Heater()
    yield made
    made.platform.end()


@pytest.fixture
def heater(started: Heater) -> Heater:
    """Key at Manual, the button held, nothing latched."""
    started.set_contacts(MANUAL)
    with started.connect() as robot:
        robot.command("stop_heating")
        started.until(lambda truth: not truth["relay_closed"], "relay open")
        robot.command("reset_trips")
    return started


def prepare(heater: Heater, robot: Robot) -> None:
    """Arm, measure, and send the profile to the loop."""
    robot.command("arm_heater")
    heater.until(lambda truth: truth["relay_closed"], "relay closed")
    time.sleep(0.1)
    robot.command("measure_resistance", straight_and_unloaded=True, phase="austenite")
    robot.command("set_heat_profile", **asdict(heat_command(PROFILE)))


def heating(heater: Heater, robot: Robot) -> tuple[threading.Thread, list[RtcpError]]:
    """Begin to heat; return the command's thread when the rod gets hot, and the list for its error."""
    prepare(heater, robot)
    errors: list[RtcpError] = []

    def heat() -> None:
        try:
            robot.command("start_heating")
        except RtcpError as error:
            errors.append(error)

    thread = threading.Thread(target=heat)
    thread.start()
    start = heater.truth()["middle_temperature"]
    heater.until(lambda truth: truth["middle_temperature"] > start + 5.0, "heat")
    return thread, errors


def test_by_hand_in_manual_without_arms_a_released_button_ends_the_heat(heater: Heater) -> None:
    with heater.connect() as robot:
        thread, errors = heating(heater, robot)
        heater.set_contacts(RELEASED)
        heater.assert_off()
        thread.join()
        assert [error.fields["row"] for error in errors] == ["button"]
        heater.set_contacts(MANUAL)
        heater.assert_off()
        assert robot.processes["heater"].state == "ready"


def test_the_command_line_shows_a_process_and_sends_it_any_of_its_commands(heater: Heater) -> None:
    rtcp = heater.platform.rtcp
    assert "shape_setting" in rtcp("process").stdout
    shown = rtcp("process", "heater").stdout
    assert "phase: unknown | austenite | martensite" in " ".join(shown.split())
    rtcp("process", "heater", "arm_heater")
    heater.until(lambda truth: truth["relay_closed"], "relay closed")
    time.sleep(0.1)
    rtcp("process", "heater", "measure_resistance", "straight_and_unloaded=true", "phase=austenite")
    with heater.connect() as robot:
        assert robot.processes["heater"].fields["initial_resistance"] > 0.0
    assert "heater is ready" in rtcp("process", "heater", "stop_heating").stdout
    rtcp("process", "heater", "measure_resistance", "straight_and_unloaded=yes", "phase=austenite", check=2)
    rtcp("process", "heater", "melt", check=2)
    rtcp("process", "heater", "reset_trips", "now", check=2)
    rtcp("process", "pump", "reset_trips", check=3)
    rtcp("process", "pump", check=3)


def test_a_connection_that_closes_ends_the_heat(heater: Heater) -> None:
    with heater.connect() as robot:
        thread, _ = heating(heater, robot)
        robot._client._socket.shutdown(2)
        heater.assert_off()
        thread.join()
    with heater.connect() as robot:
        assert robot.processes["heater"].fields["cause"] == 6


def test_auto_without_the_arms_of_the_cell_is_refused(heater: Heater) -> None:
    heater.set_contacts(AUTO)
    with heater.connect() as robot, pytest.raises(RtcpError, match="interlock") as refused:
        robot.command("arm_heater")
    assert refused.value.kind == "refused"
    assert not heater.truth()["relay"]


def test_another_client_may_stop_the_heat_and_may_not_begin_any(heater: Heater) -> None:
    with heater.connect() as robot, heater.connect() as other:
        thread, errors = heating(heater, robot)
        with pytest.raises(RtcpError) as refused:
            other.command("start_heating")
        assert refused.value.reason == "lease_held"
        other.command("stop_heating")
        heater.assert_off()
        thread.join()
        assert len(errors) == 1
