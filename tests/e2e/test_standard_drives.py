"""Arms of other drives, and a slave with known channels alone, by their files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

import rtcp
from rtcp.config import load_device
from rtcp.ipc.runtime_directory import control_socket
from tests.drive_esi import write_esi
from tests.e2e.arms import replace_drives
from tests.e2e.conftest import CUBEMARS, Platform
from tests.required import filled

pytestmark = [pytest.mark.platform, CUBEMARS]

VALVES = """
name: Valve terminal
kind: analog
vendor_id: 0xA55
product_id: 0x20
rpdo:
  - index: 0x1600
    channels:
      - {index: 0x7000, sub_index: 1, type: int16, name: current, factor: 0.001, unit: mA, min: 4, max: 20, safe: 4}
      - {index: 0x7000, sub_index: 2, type: uint16, name: ramp, unit: ms}
tpdo:
  - index: 0x1A00
    channels:
      - {index: 0x6000, sub_index: 1, type: uint16, name: pressure, factor: 0.01, offset: -1, unit: bar}
"""


STUCK = """
from rtcp.virtual.behaviour import Behaviour

class Stuck(Behaviour):
    def on_sdo_read(self, index, subindex):
        while index == 0x6000:
            pass

    def on_sdo_write(self, index, subindex, value):
        if index == 0x7000:
            self.device.objects = None
"""


def add_valves(folder: Path) -> None:
    """Add an analog terminal whose behaviour hangs behind the slaves of the configuration, and to its segment."""
    (folder / "stuck.py").write_text(STUCK)
    (folder / "devices" / "valves.yaml").write_text(VALVES)
    write_esi(folder / "valves.xml", load_device(folder / "devices" / "valves.yaml"), {})
    for file, slave in (
        ("assistive_arm.yaml", {"name": "valves", "device": "valves"}),
        ("segment.yaml", {"esi": "valves.xml", "behaviour": "stuck:Stuck"}),
    ):
        data = yaml.safe_load((folder / file).read_text())
        data["slaves"].append(slave)
        (folder / file).write_text(yaml.safe_dump(data))


def move_and_stop(platform: Platform) -> None:
    """Enable, move by the joints and on a line, press the virtual emergency stop."""
    goal = [0.2, 0.3, 0.4, -0.2, 0.4, 0.3]
    with rtcp.connect("a test", control_socket(platform.directory)) as robot:
        robot.enable()
        robot.move_joints(goal, speed=0.5)
        assert robot.positions == pytest.approx(goal, abs=5e-3)
        before = robot.status().pose[2]
        robot.mode("cartesian")
        robot.move_by((0.0, 0.0, -0.03, 0.0, 0.0, 0.0))
        assert robot.status().pose[2] - before == pytest.approx(-0.03, abs=5e-3)
    platform.rtcp("joystick", "estop", "--seconds", "0.3")
    platform.until(
        lambda status: status["state"] == "emergency_stop" and not status["robot"]["drives_powered"], "emergency stop"
    )


def test_an_arm_built_from_the_file_of_its_drives_maker_moves_and_stops_and_its_channels_work(
    platform: Platform,
) -> None:
    platform.be_patient(2000)
    folder = platform.directory / "config"
    replace_drives(folder, "two-axis")
    add_valves(folder)
    made, arm = folder / "devices" / "made.yaml", folder / "assistive_arm.yaml"
    assert "CHECK" in platform.rtcp("device", "new", "--esi", str(folder / "drive.xml"), "--out", str(made)).stdout
    figures = {"torque_at": "output", "velocity_unit": "counts/s", "velocity_at": "motor"}
    made.write_text(filled(made.read_text(), figures))
    arm.write_text(arm.read_text().replace("device: two-axis-drive", "device: made"))
    platform.rtcp("start", "--detach")
    with rtcp.connect("a test", control_socket(platform.directory)) as robot:
        robot.enable()
        platform.rtcp("segment", "set", "5", "0x6000:1", "350")
        platform.until(lambda status: robot.io["valves.pressure"] == pytest.approx(2.5), "the pressure")
        assert robot.io["valves.current"] == 4.0
        robot.io["valves.current"] = 12.5
        with pytest.raises(rtcp.Refused) as refused:
            robot.io["valves.current"] = 21
        assert (refused.value.reason, refused.value.fields["highest"]) == ("channel_out_of_range", 20.0)
        shown = json.loads(platform.rtcp("io", "valves.current", "--json").stdout)
        assert shown == {"valves.current": {"direction": "output", "value": 12.5, "unit": "mA"}}
        # Its behaviour hangs while the arm moves: the segment and the arm go on.
        moving = platform.background("move", "0.5", "0", "0", "0", "0", "0", "--speed", "0.3")
        platform.until_moving()
        with pytest.raises(rtcp.Refused, match="abort code 0x08000000"):
            platform.call("sdo_read", slave=5, index=0x6000, subindex=1)
        assert moving.wait() == 0
    sentences = (platform.directory / "segment.log").read_text().splitlines()
    assert [line for line in sentences if "on_sdo_read failed at " in line and "stuck.py:6: it has not" in line]
    # A slave that loses its supply is set up again, both axes with it.
    platform.rtcp("segment", "fault", "power", "slave=3")
    platform.until(lambda status: status["state"] == "fault", "the fault")
    platform.rtcp("segment", "clear")
    platform.call("reset")
    assert "4000" in platform.rtcp("segment", "get", "5", "0x7000:1").stdout
    move_and_stop(platform)
    # A device that cannot work leaves OP; the other slaves and the segment's socket continue.
    platform.call("reset")
    platform.rtcp("sdo", "write", "valves", "0x7000:1", "5000", "--type", "int16", check=None)
    assert "has set its `objects`" in platform.rtcp("segment", "get", "5", check=3).stderr
    assert "statusword" in platform.rtcp("segment", "get", "2").stdout


@pytest.mark.long("test_an_arm_built_from_the_file_of_its_drives_maker_moves_and_stops_and_its_channels_work")
@pytest.mark.parametrize("name", ["myactuator", "synapticon"])
def test_an_arm_of_other_drives_moves_and_stops(platform: Platform, name: str) -> None:
    platform.be_patient(2000)
    replace_drives(platform.directory / "config", name)
    platform.rtcp("start", "--detach")
    move_and_stop(platform)
