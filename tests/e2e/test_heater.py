"""The heater without arms: `config/heater.yaml` alone, step by step as an operator does it, through a real gateway."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from typing import Any

import pytest

from rtcp.api import Robot, RtcpError
from rtcp.cli.__main__ import main
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import control_socket, segment_control
from rtcp.processes.shape_setting.heat_profile import heat_command
from rtcp.processes.shape_setting.profile import read_profile
from rtcp.virtual.faults.control import SegmentClient
from tests.e2e.conftest import Platform
from tests.leftovers import Leftovers
from tests.waiting import until

pytestmark = pytest.mark.platform

CONFIG = default_config().parent
AUTO, MANUAL, RELEASED = 0x31, 0x0E, 0x02
PROFILE = replace(
    read_profile(CONFIG / "shape_setting" / "nitinol.yaml"), ramp_k_s=50.0, hold_s=1.0, cool_c=400.0, initial_c=20.0
)


class Heater:
    """The heater's platform, and people at its box."""

    def __init__(self, platform: Platform) -> None:
        self.platform = platform
        platform.be_patient(500)
        file = platform.directory / "config" / "heater.yaml"
        file.write_text(file.read_text().replace("period_us: 500 ", "period_us: 4000 "))
        box = file.with_name("devices") / "shape-setter-box.yaml"
        box.write_text(box.read_text().replace("watchdog_ms: 5", "watchdog_ms: 20"))
        platform.rtcp("start", "--detach", "--config", str(file))
        platform.call("enable")

    def connect(self) -> Robot:
        return Robot("the tests", control_socket(self.platform.directory))

    def set_contacts(self, closed: int) -> None:
        with SegmentClient(segment_control(self.platform.directory)) as segment:
            # Without a clear between them, which would put the key at Auto for an instant.
            segment.fault({"fault": "contacts", "slave": 1, "closed": closed})
        before = self.platform.status()["cycles"]
        self.platform.until(lambda status: status["cycles"] > before + 20, "the debounce of the contacts")

    def truth(self) -> dict[str, Any]:
        with SegmentClient(segment_control(self.platform.directory)) as segment:
            box: dict[str, Any] = segment.truth()["slaves"][0]
        return box

    def until(self, met: Callable[[dict[str, Any]], bool], what: str) -> None:
        until(lambda: met(self.truth()), what)

    def assert_off(self) -> None:
        self.until(lambda truth: not (truth["gate"] or truth["relay"]), "heat off")
        for _ in range(20):
            truth = self.truth()
            assert not truth["gate"]
            assert not truth["relay"]
            time.sleep(0.01)


@pytest.fixture(scope="module")
def started(leftovers: Leftovers) -> Iterator[Heater]:
    platform = Platform()
    leftovers.shared.add(str(platform.directory))
    try:
        yield Heater(platform)
    finally:
        platform.end()
        leftovers.shared.discard(str(platform.directory))


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
    arm(heater, robot)
    robot.command("measure_resistance", straight_and_unloaded=True, phase="austenite")
    robot.command("set_heat_profile", **asdict(heat_command(PROFILE)))


def arm(heater: Heater, robot: Robot) -> None:
    """Arm; the command returns when the loop has seen that the relay is closed."""
    robot.command("arm_heater")
    assert robot.processes["heater"].fields["relay_closed"]


@contextlib.contextmanager
def heating(heater: Heater, robot: Robot) -> Iterator[list[RtcpError]]:
    """Begin to heat; yield the list for the error of the command when the rod gets hot; wait for its end."""
    prepare(heater, robot)
    errors: list[RtcpError] = []

    def heat() -> None:
        try:
            robot.command("start_heating")
        except RtcpError as error:
            errors.append(error)

    thread = threading.Thread(target=heat)
    start = heater.truth()["middle_temperature"]
    thread.start()
    heater.until(lambda truth: truth["middle_temperature"] > start + 5.0, "heat")
    yield errors
    heater.assert_off()
    thread.join()


def test_a_released_button_another_client_and_the_end_of_the_connection_end_the_heat(heater: Heater) -> None:
    with heater.connect() as robot:
        with heating(heater, robot) as errors:
            heater.set_contacts(RELEASED)
        assert [error.fields["row"] for error in errors] == ["button"]
        heater.set_contacts(MANUAL)
        heater.assert_off()
        assert robot.processes["heater"].state == "ready"
        with heater.connect() as other:
            with heating(heater, robot) as errors:
                with pytest.raises(RtcpError) as refused:
                    other.command("start_heating")
                assert refused.value.reason == "lease_held"
                other.command("stop_heating")
            assert len(errors) == 1
        with heating(heater, robot):
            robot._client._socket.shutdown(2)
    with heater.connect() as robot:
        assert robot.processes["heater"].fields["cause"] == 6


def test_the_steps_by_hand_of_the_page_heat_the_virtual_rod_and_a_process_may_refuse_a_command(
    heater: Heater, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in heater.platform.environment.items():
        monkeypatch.setenv(name, value)

    def rtcp(*arguments: str, code: int = 0) -> str:
        assert main(("process", *arguments)) == code
        return capsys.readouterr().out

    page = (CONFIG.parent / "docs" / "shape_setting.md").read_text()
    block = page.partition("## The same steps by hand")[2].split("```")[1]
    steps = [shlex.split(line, comments=True)[1:] for line in block.strip().splitlines()]
    assert [step[0] for step in steps[:3]] == ["start", "enable", "segment"]
    assert steps[-1] == ["process", "heater", "start_heating"]
    assert "shape_setting" in rtcp()
    assert "phase: unknown | austenite | martensite" in " ".join(rtcp("heater").split())
    heater.set_contacts(AUTO)
    before = heater.truth()["middle_temperature"]
    for step in steps[2:-1]:
        assert main(step) == 0, step
    # The command line takes signals, which only the main thread of a process can do.
    last = subprocess.Popen(
        [sys.executable, "-m", "rtcp.cli", *steps[-1]], env=os.environ | heater.platform.environment
    )
    heater.until(lambda truth: truth["middle_temperature"] > before + 20.0, "heat")
    last.send_signal(signal.SIGINT)
    assert last.wait() != 0
    heater.assert_off()
    assert "heater is ready" in rtcp("heater", "stop_heating")
    rtcp("heater", "measure_resistance", "straight_and_unloaded=yes", "phase=austenite", code=2)
    rtcp("heater", "melt", code=2)
    rtcp("heater", "reset_trips", "now", code=2)
    rtcp("pump", "reset_trips", code=3)
    rtcp("pump", code=3)
    # In Auto the heater needs the arms of its cell.
    heater.set_contacts(AUTO)
    with heater.connect() as robot, pytest.raises(RtcpError, match="interlock") as no_arms:
        robot.command("arm_heater")
    assert no_arms.value.kind == "refused"
    assert not heater.truth()["relay"]
