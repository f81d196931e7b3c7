"""The keys of a bus of kind `egm`, and each mistake on one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.buses import EgmBus, bus_class
from rtcp.config.findings import Finding
from rtcp.config.model import ArmConfig, ConfigError, EthercatBus
from rtcp.config.serialization import from_json, to_json
from tests.findings import summary

IRB = "abb_irb120.yaml"
KIND, JOINT, PERIOD, END = "kind: egm", "{name: joint_1, ", "period_us: 4032", "\nsupervision:"
MISTAKES = [
    ((KIND, "kind: profinet"), "bus.kind: choice"),
    ((KIND, "kind: 3"), "bus.kind: type"),
    ((KIND, "kind: egm\n  send_phase: 0.5"), "bus.send_phase: unknown"),
    (("port: 6511", "port: 0"), "bus.port: range"),
    ((KIND, "kind: egm\n  comm_timeout_s: 2"), "bus.comm_timeout_s: range"),
    (("interface: virtual", "interface: eth0"), "bus.interface: interface"),
    ((END, "\nslaves: []\n" + END), "slaves: bus_without_slaves bus=egm"),
    ((JOINT, JOINT + "slave: drive1, "), "joints[0].slave: bus_without_slaves bus=egm"),
    ((JOINT, JOINT + "torque: 10, "), "joints[0].torque: bus_without_torque"),
    ((END, "\ndrive_mode: cst\n" + END), "drive_mode: torque_on_bus bus=egm"),
    ((END, "\ncontrol_mode: torque\n" + END), "control_mode: torque_on_bus bus=egm"),
    ((END, "\nstops: {drive_fault: torque_off}\n" + END), "stops.drive_fault: torque_off_on_bus bus=egm"),
    ((PERIOD, "period_us: 5000"), "cycle.period_us: period_of_egm period_us=4032.0"),
    ((PERIOD, "period_us: 1000"), "cycle.period_us: period_of_egm period_us=4032.0"),
]


@pytest.mark.parametrize(("change", "expected"), MISTAKES, ids=[expected for _, expected in MISTAKES])
def test_a_mistake_is_named_with_file_and_line(
    findings_after: Callable[..., list[Finding]], change: tuple[str, str], expected: str
) -> None:
    findings = findings_after(IRB, change)
    assert expected in [summary(finding, expected) for finding in findings]
    assert all(str(finding.file) == IRB and finding.line for finding in findings)


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
