"""The keys of a bus of kind `egm`, and the sentence for each mistake on one."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.buses import EgmBus, bus_class
from rtcp.config.model import ArmConfig, ConfigError, EthercatBus
from rtcp.config.serialization import from_json, to_json

IRB = "abb_irb120.yaml"
KIND, JOINT, PERIOD, END = "kind: egm", "{name: joint_1, ", "period_us: 4032", "\nsupervision:"
MISTAKES = [
    ((KIND, "kind: profinet"), 'bus.kind: found the text "profinet", allowed is one of egm, ethercat, rapid'),
    ((KIND, "kind: 3"), "bus.kind: found 3, allowed is a text of 1 to 64 characters"),
    ((KIND, "kind: egm\n  send_phase: 0.5"), "bus.send_phase: this key does not exist; allowed are "),
    (("port: 6511", "port: 0"), "bus.port: found 0, allowed is an integer from 1 to 65535"),
    ((KIND, "kind: egm\n  comm_timeout_s: 2"), "bus.comm_timeout_s: found 2, allowed is a number greater than 0 and "),
    (("interface: virtual", "interface: eth0"),
     'bus.interface: found the text "eth0", allowed is virtual, or an IPv4 address'),
    ((END, "\nslaves: []\n" + END), "slaves: a bus of kind egm has no slaves: leave it out"),
    ((JOINT, JOINT + "slave: drive1, "), "joints[0].slave: a bus of kind egm has no slaves: leave it out"),
    ((JOINT, JOINT + "torque: 10, "), "joints[0].torque: the robot controller takes no torque and measures none for"),
    ((END, "\ndrive_mode: cst\n" + END),
     'drive_mode: found the text "cst" on a bus of kind egm: the robot controller takes no torque'),
    ((END, "\ncontrol_mode: torque\n" + END),
     'control_mode: found the text "torque" on a bus of kind egm: the robot controller takes no torque'),
    ((END, "\nstops: {drive_fault: torque_off}\n" + END),
     'stops.drive_fault: found the text "torque_off" on a bus of kind egm, which cannot switch motors off'),
    ((PERIOD, "period_us: 5000"), "cycle.period_us: found 5000 us, allowed by EGM is 4032 or a multiple"),
    ((PERIOD, "period_us: 1000"), "cycle.period_us: found 1000 us, allowed by EGM is 4032 or a multiple"),
]  # fmt: skip


@pytest.mark.parametrize(("change", "sentence"), MISTAKES, ids=[sentence[:50] for _, sentence in MISTAKES])
def test_a_mistake_is_named_with_file_and_line(
    problems_after: Callable[..., list[str]], change: tuple[str, str], sentence: str
) -> None:
    problems = problems_after(IRB, change)
    assert [problem for problem in problems if sentence in problem]
    assert all(re.match(rf"{IRB}:\d+: ", problem) for problem in problems)


@pytest.mark.parametrize("period", ["4032", "4000", "8064", "12096"])
def test_multiples_of_the_controllers_period_are_accepted(directory: Path, period: str) -> None:
    file = directory / IRB
    file.write_text(file.read_text().replace(PERIOD, f"period_us: {period}"))
    assert load(file).cycle.period_us == float(period)


def test_every_joint_is_a_node_of_the_bus_and_the_unit_the_last() -> None:
    config = load(default_config().parent / IRB)
    assert isinstance(config.bus, EgmBus)
    assert [slave.name for slave in config.slaves] == [*(joint.name for joint in config.joints), "robot"]
    assert [slave.device.kind for slave in config.slaves] == ["joint"] * 6 + ["generic"]
    assert [joint.slave for joint in config.joints] == [joint.name for joint in config.joints]


def test_a_session_keeps_the_kind_of_bus() -> None:
    for name, kind in ((IRB, EgmBus), ("assistive_arm.yaml", EthercatBus)):
        config = load(default_config().parent / name)
        again = from_json(ArmConfig, to_json(config))
        assert isinstance(again.bus, kind)
        assert again == config


def test_the_kinds_of_bus_are_found_by_name() -> None:
    assert bus_class("egm") is EgmBus
    with pytest.raises(ConfigError, match="allowed is one of egm, ethercat, rapid"):
        bus_class("can")
