"""Arms of other drives, and a slave with known channels alone, by their files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

import rtcp
from rtcp.config import load_device
from rtcp.ipc.runtime_directory import control_socket
from tests.drive_esi import TWO_AXIS, write_esi
from tests.e2e.arms import replace_drives
from tests.e2e.conftest import CUBEMARS, Platform
from tests.fieldbus.terminals import ESI_FILES

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


def build(folder: Path) -> None:
    """Replace the six drives of the configuration in `folder` by three of two axes, and add the valves."""
    replace_drives(folder, "two-axis")
    add_valves(folder)


def add_valves(folder: Path, behaviour: str = "") -> None:
    """Add an analog terminal behind the slaves of the configuration in `folder`, and to its segment."""
    (folder / "devices" / "valves.yaml").write_text(VALVES)
    write_esi(folder / "valves.xml", load_device(folder / "devices" / "valves.yaml"), {})
    for file, slave in (
        ("assistive_arm.yaml", {"name": "valves", "device": "valves"}),
        ("segment.yaml", {"esi": "valves.xml"} | ({"behaviour": behaviour} if behaviour else {})),
    ):
        data = yaml.safe_load((folder / file).read_text())
        data["slaves"].append(slave)
        (folder / file).write_text(yaml.safe_dump(data))


@pytest.fixture
def started(platform: Platform) -> Platform:
    platform.be_patient(2000)
    build(platform.directory / "config")
    platform.rtcp("start", "--detach")
    return platform


def move_and_stop(platform: Platform) -> None:
    """Enable, move by the joints and on a line, press the virtual emergency stop, end the platform."""
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
    platform.rtcp("stop")


@pytest.mark.parametrize("name", ["myactuator", "synapticon"])
def test_an_arm_of_other_drives_moves_and_stops(platform: Platform, name: str) -> None:
    platform.be_patient(2000)
    replace_drives(platform.directory / "config", name)
    platform.rtcp("start", "--detach")
    move_and_stop(platform)


def test_an_arm_of_two_axis_drives_moves_is_recovered_and_its_channels_are_read_and_set(started: Platform) -> None:
    with rtcp.connect("a test", control_socket(started.directory)) as robot:
        robot.enable()
        started.rtcp("segment", "set", "5", "0x6000:1", "350")
        started.until(lambda status: robot.io["valves.pressure"] == pytest.approx(2.5), "the pressure")
        assert robot.io["valves.current"] == 4.0
        robot.io["valves.current"] = 12.5
        with pytest.raises(rtcp.Refused) as refused:
            robot.io["valves.current"] = 21
        assert (refused.value.reason, refused.value.fields["highest"]) == ("channel_out_of_range", 20.0)
        assert "12500" in started.rtcp("segment", "get", "5", "0x7000:1").stdout
        shown = json.loads(started.rtcp("io", "valves.current", "--json").stdout)
        assert shown == {"valves.current": {"direction": "output", "value": 12.5, "unit": "mA"}}
        robot.disable()
    started.rtcp("io", "valves.current", "7.5")
    assert "7500" in started.rtcp("segment", "get", "5", "0x7000:1").stdout
    # A slave that loses its supply is set up again, both axes with it.
    started.rtcp("segment", "fault", "power", "slave=3")
    started.until(lambda status: status["state"] == "fault", "the fault")
    started.rtcp("segment", "clear")
    started.call("reset")
    assert "4000" in started.rtcp("segment", "get", "5", "0x7000:1").stdout
    move_and_stop(started)


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


def test_segment_and_arm_go_on_beside_a_slave_whose_behaviour_hangs(platform: Platform) -> None:
    platform.be_patient(2000)
    folder = platform.directory / "config"
    (folder / "stuck.py").write_text(STUCK)
    add_valves(folder, "stuck:Stuck")
    platform.rtcp("start", "--detach")
    platform.call("enable")
    moving = platform.background("move", "1.5", "0", "0", "0", "0", "0", "--speed", "0.5")
    platform.until_moving()
    refused = platform.rtcp("sdo", "read", "valves", "0x6000:1", check=3)
    assert "refused the read of 0x6000:1: abort code 0x08000000" in refused.stderr
    assert moving.wait() == 0
    sentences = (platform.directory / "segment.log").read_text().splitlines()
    assert [line for line in sentences if "on_sdo_read failed at " in line and "stuck.py:6: it has not" in line]
    # A device that cannot work leaves OP; the other slaves and the segment's socket continue.
    platform.call("disable")
    platform.rtcp("sdo", "write", "valves", "0x7000:1", "5000", "--type", "int16", check=None)
    assert "has set its `objects`" in platform.rtcp("segment", "get", "8", check=3).stderr
    assert "Statusword" in platform.rtcp("segment", "get", "2").stdout


def test_an_arm_is_built_from_the_makers_file_and_moves(platform: Platform) -> None:
    platform.be_patient(2000)
    folder = platform.directory / "config"
    build(folder)
    made, arm = folder / "devices" / "made.yaml", folder / "assistive_arm.yaml"
    said = platform.rtcp("device", "new", "--esi", str(folder / "drive.xml"), "--out", str(made)).stdout
    assert "CHECK" in said
    made.write_text(made.read_text().replace("torque_at: motor", "torque_at: output"))
    arm.write_text(arm.read_text().replace("device: two-axis-drive", "device: made"))
    compared = platform.rtcp("device", "check", str(made), "--bus", "virtual").stdout
    assert compared.count("as the file says") == 3
    platform.rtcp("start", "--detach")
    goal = [0.2, 0.3, 0.4, -0.2, 0.4, 0.3]
    with rtcp.connect("a test", control_socket(platform.directory)) as robot:
        robot.enable()
        robot.move_joints(goal, speed=0.5)
        assert robot.positions == pytest.approx(goal, abs=5e-3)


def test_a_drive_that_counts_otherwise_than_its_file_does_not_start(platform: Platform) -> None:
    platform.be_patient(2000)
    folder = platform.directory / "config"
    build(folder)
    write_esi(
        folder / "drive.xml", load_device(folder / "devices/two-axis-drive.yaml"), {**TWO_AXIS, 0x688F: (1024, 1)}
    )
    refused = platform.rtcp("start", "--detach", check=None)
    assert refused.returncode != 0
    said = " ".join((refused.stdout + refused.stderr).split())
    assert "slave 2 (drive1), axis 2: the drive counts otherwise than its file: 0x688F holds 1024" in said


def test_what_a_slave_has_otherwise_than_its_file_is_told_in_words(platform: Platform) -> None:
    platform.be_patient(2000)
    folder = platform.directory / "config"
    (folder / "segment.yaml").write_text(f"slaves:\n  - {{esi: {ESI_FILES / 'analog.xml'}}}\n")
    sound, wrong = folder / "devices" / "sound.yaml", folder / "devices" / "wrong.yaml"
    platform.rtcp("device", "new", "--esi", str(ESI_FILES / "analog.xml"), "--out", str(sound))
    assert "as the file says" in platform.rtcp("device", "check", str(sound), "--bus", "virtual").stdout
    text = sound.read_text()
    for old, new in (
        ("index: 0x8001", "index: 0x8011"),
        ("index: 0x7000, sub_index: 2, type: int16", "index: 0x7000, sub_index: 2, type: int32"),
        ("index: 0x1A00 ", "index: 0x1A05 "),
    ):
        assert text.count(old) == 1
        text = text.replace(old, new)
    wrong.write_text(text)
    said = " ".join(platform.rtcp("device", "check", str(wrong), "--bus", "virtual", check=None).stdout.split())
    for sentence in (
        "sdo: 0x8011:0 (its tag): the slave has no such object",
        "rpdo: 0x7000:2 (value): the file says 4 bytes, the slave has 2",
        "tpdo: PDO 0x1A05: the slave has no such object",
    ):
        assert sentence in said
    wrong.write_text(sound.read_text().replace("product_id: 0x00000041", "product_id: 0x00000042"))
    refused = platform.rtcp("device", "check", str(wrong), "--bus", "virtual", check=None)
    assert "no slave has vendor 0x00000E51, product 0x00000042" in " ".join((refused.stdout + refused.stderr).split())
