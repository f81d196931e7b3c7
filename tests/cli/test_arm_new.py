"""`rtcp arm new`, and the page docs/your_own_arm.md: from an ESI file that nobody has seen to an arm that moves."""

from __future__ import annotations

import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from rtcp.cli.output import ExitCode
from rtcp.config import default_config, load, load_device
from rtcp.config.model import ConfigError
from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.states import State
from rtcp.testing.simulation import Simulation
from rtcp.virtual.segment import check_segment
from tests.drive_esi import Objects, write_esi

Rtcp = Callable[..., Any]
PAGE = (Path(__file__).parents[2] / "docs" / "your_own_arm.md").read_text(encoding="utf-8")
UNSET: Objects = {
    0x603F: ("UINT", 0), 0x6076: ("UDINT", 0), 0x608F: (0, 0), 0x6091: (1, 1), 0x6098: ("SINT", 37),
    0x60A9: ("UDINT", 0x00B44700),
}  # fmt: skip
"""A drive as delivered: no rated torque, no encoder, no gear; speeds in revolutions per minute."""


def block(first_key: str) -> str:
    """Return the YAML block of the page that begins with a key."""
    (text,) = re.findall(rf"```yaml\n({first_key}:.*?)```", PAGE, re.DOTALL)
    return text


def commands(title: str) -> list[str]:
    """Return the commands in a section of the page."""
    (section,) = re.findall(rf"^## \d\. {title}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    return re.findall(r"^    ((?:rtcp|export) .*)$", section, re.MULTILINE)


def fill_in(file: Path) -> None:
    """Fill in the figures of the page's `scaling`; everything else stays as `rtcp device new` wrote it."""
    text = file.read_text(encoding="utf-8")
    (figures,) = yaml.safe_load(block("scaling"))["scaling"]
    for key, value in figures.items():
        text, count = re.subn(rf"(?m)^([ -]+{key}:)[^#\n]*", rf"\1 {value}   ", text)
        assert count == 1, key
    file.write_text(text, encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with a maker's file, which is the current one."""
    place = tmp_path / "mine"
    place.mkdir()
    known = load_device(default_config().parent / "devices" / "synapticon-somanet.yaml")
    device = replace(known, name="Servo S7", vendor_id=0xABC, product_id=0x77)
    write_esi(place / "maker.xml", device, UNSET)
    monkeypatch.chdir(place)
    return place


def describe(rtcp: Rtcp, folder: Path) -> None:
    """Run the first two sections of the page."""
    (folder / "devices").mkdir()
    for line in commands("The drive"):
        if "device check" in line:
            fill_in(folder / "devices" / "my-drive.yaml")
        assert rtcp(*shlex.split(line)[1:]).code == 0, line
    (folder / "numbers.yaml").write_text(block("position_min"), encoding="utf-8")
    for line in commands("The arm"):
        assert rtcp(*shlex.split(line)[1:]).code == 0, line


@pytest.fixture
def moved(rtcp: Rtcp, folder: Path) -> Iterator[Simulation]:
    describe(rtcp, folder)
    with Simulation(load(folder / "my_arm.yaml")) as simulation:
        yield simulation


def test_the_page_leads_from_an_unknown_esi_file_to_an_arm_whose_joints_turn_as_commanded(moved: Simulation) -> None:
    moved.hold()
    (line,) = [line for line in commands("It moves") if line.startswith("rtcp move")]
    target = [float(word) for word in line.split()[2:]]
    moved.do(MoveJoints(tuple(target), 0.5, synchronized=True))
    assert moved.until(lambda: moved.state is State.HOLDING, 5.0)
    turned = [slave.device.servos[0].mechanics.position for slave in moved.bus.slaves]
    assert turned == pytest.approx(target, abs=2e-3)


def test_what_it_writes_has_the_limits_given_with_their_units(rtcp: Rtcp, folder: Path) -> None:
    describe(rtcp, folder)
    arm = load(folder / "my_arm.yaml")
    assert [joint.torque for joint in arm.joints] == [50, 50, 50, 30, 30, 20]
    assert {(joint.position.min, joint.position.max, joint.velocity, joint.jerk) for joint in arm.joints} == {
        (-2.0, 2.0, 0.5, 20.0)
    }
    text = (folder / "my_arm.yaml").read_text(encoding="utf-8")
    assert re.findall(r"^    (\w+): \S.*?# (.*)$", text, re.MULTILINE)[:5] == [
        ("position", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s^2"), ("jerk", "rad/s^3"), ("torque", "Nm"),
    ]  # fmt: skip


def test_of_several_devices_of_one_identity_the_segment_plays_the_chosen_one(rtcp: Rtcp, folder: Path) -> None:
    describe(rtcp, folder)
    file = folder / "maker.xml"
    text = file.read_text()
    begin, end = text.index("<Device "), text.index("</Devices>")
    file.write_text(text[:end] + text[begin:end].replace("Servo S7", "Servo S7 with brake") + text[end:])
    arguments = (
        "arm",
        "new",
        "--out",
        "b.yaml",
        "--device",
        "my-drive",
        "--esi",
        "maker.xml",
        "--answers",
        "numbers.yaml",
    )
    assert "give one by --product, --revision or --choice" in rtcp(*arguments).trouble
    assert rtcp(*arguments, "--choice", "2").code == 0
    assert (folder / "b_segment.yaml").read_text().count("choice: 2") == 6


def test_without_a_file_it_asks_and_enter_repeats_the_number_of_the_joint_before(
    rtcp: Rtcp, rtcp_process: Callable[..., Any], folder: Path
) -> None:
    describe(rtcp, folder)
    (line,) = [line for line in commands("One drive on the bench") if line.startswith("rtcp arm new")]
    asking = rtcp_process(*shlex.split(line)[1:-1], "2", stdin=subprocess.PIPE)
    shown, trouble = asking.communicate("-pi/2\nfar\n2\n0.5\n2\n20\n50\n" + "\n" * 5 + "7\n")
    assert (asking.returncode, trouble) == (0, "")
    assert "joint1: largest torque at the joint, behind all gears, Nm" in shown
    assert "found 'far', allowed is a number" in shown
    arm = load(folder / "bench.yaml")
    assert [joint.position.min for joint in arm.joints] == [pytest.approx(-1.5708, abs=1e-4)] * 2
    assert [joint.torque for joint in arm.joints] == [50, 7]


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ("velocity: 0.5", "missing: position_min, position_max, acceleration, jerk, torque; unknown: nothing"),
        (block("position_min").replace("jerk: 20.0", "jerk: fast"), "joint1, jerk: found 'fast'"),
        (block("position_min").replace("50, 50, 50", "50, 50"), "torque: found 5 numbers, needed are 1 or 6"),
        (block("position_min").replace("position_max: 2.0", "position_max: -3.0"), "position"),
    ],
)
def test_numbers_that_make_no_arm_leave_no_file(rtcp: Rtcp, folder: Path, numbers: str, words: str) -> None:
    describe(rtcp, folder)
    (folder / "wrong.yaml").write_text(numbers, encoding="utf-8")
    before = sorted(folder.iterdir())
    ended = rtcp(
        "arm", "new", "--out", "other.yaml", "--device", "my-drive", "--esi", "maker.xml", "--answers", "wrong.yaml"
    )
    assert ended.code == ExitCode.USAGE
    assert words in ended.trouble
    assert sorted(folder.iterdir()) == before


def test_stored_objects_of_a_described_slave_are_checked(rtcp: Rtcp, folder: Path) -> None:
    describe(rtcp, folder)
    segment = folder / "my_arm_segment.yaml"
    sound = segment.read_text(encoding="utf-8")
    for key, value, words in (
        ("0x6091:1", "-1", "found -1, allowed is a whole number from 0 to 4294967295"),
        ("0x6091:9", "1", "has no object '0x6091:9' with a number"),
    ):
        segment.write_text(sound.replace("'0x6091:1': 50", f"'{key}': {value}"), encoding="utf-8")
        with pytest.raises(ConfigError, match=words):
            check_segment(segment)
