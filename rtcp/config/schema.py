"""Reads the arm's file and the device files that it names into one frozen `ArmConfig`, or names every mistake."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from annotated_types import MaxLen, MinLen

from rtcp.config import device_rules, operation_rules, rules
from rtcp.config.arm_model import arm_model, kinematics_part
from rtcp.config.checking import Checker
from rtcp.config.document import Finding, dotted, read
from rtcp.config.errors import ConfigError
from rtcp.config.find import exists
from rtcp.config.geometry import Kinematics, kinematics_findings
from rtcp.config.model import (
    ArmConfig,
    BusConfig,
    CycleConfig,
    DeviceDescription,
    DriveModeName,
    GripperConfig,
    Joint,
    Name,
    Positive,
    SlaveConfig,
)
from rtcp.config.operation import (
    CartesianConfig,
    InputsConfig,
    JogConfig,
    MotionName,
    OutputsConfig,
    WatchConfig,
)
from rtcp.config.stops import StopsConfig


@dataclass(frozen=True)
class SlaveEntry:
    """A slave as the arm's file lists it: its name and the file that describes its kind."""

    name: Name
    device: Name


@dataclass(frozen=True)
class ArmFile:
    """The arm's file: an `ArmConfig` whose slaves only name their device."""

    name: Name
    slaves: Annotated[tuple[SlaveEntry, ...], MinLen(1)]
    joints: Annotated[tuple[Joint, ...], MinLen(1), MaxLen(rules.MOST_AXES)]
    cycle: CycleConfig = field(default_factory=CycleConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    mode: DriveModeName = ArmConfig.mode
    enable_timeout_s: Positive = ArmConfig.enable_timeout_s
    lease_s: Positive = ArmConfig.lease_s
    motion: MotionName = ArmConfig.motion
    cartesian: CartesianConfig = field(default_factory=CartesianConfig)
    jog: JogConfig = field(default_factory=JogConfig)
    watch: WatchConfig = field(default_factory=WatchConfig)
    stops: StopsConfig = field(default_factory=StopsConfig)
    inputs: InputsConfig = field(default_factory=InputsConfig)
    outputs: OutputsConfig = field(default_factory=OutputsConfig)
    gripper: GripperConfig | None = None
    kinematics: Kinematics | None = None
    """The arm's geometry, of which `ArmConfig.arm` is made."""


_ARM, _DEVICE, _CYCLE = Checker(ArmFile), Checker(DeviceDescription), Checker(CycleConfig)


def load(path: Path) -> ArmConfig:
    """Read the arm's file and the device files beside it.

    Raises:
        ConfigError: with one sentence for every mistake in all of these files: file, line, key, what was found and
            what is allowed.
    """
    document = read(path)
    arm, findings = _ARM.check(document.data)
    wrong_kinematics = kinematics_findings(document.data)
    part = None if wrong_kinematics else kinematics_part(document.data)
    findings += rules.arm_findings(document.data) + wrong_kinematics
    findings += operation_rules.operation_findings(document.data) + operation_rules.box_findings(document.data, part)
    period_us = rules.period_us(document.data)

    devices: dict[str, DeviceDescription] = {}
    in_devices: list[str] = []
    for key, where in rules.devices_named(document.data).items():
        file = device_path(path, key)
        if not exists(file):
            findings.append(((*where,), _no_device(key, file)))
            continue
        try:
            devices[key] = load_device(file, period_us)
        except ConfigError as error:
            in_devices += error.problems
    findings += rules.joint_findings(document.data, devices)
    findings += operation_rules.terminal_findings(document.data, devices)
    if findings or in_devices or arm is None:
        raise ConfigError(document.sentences(findings) + in_devices)
    try:
        model = None if arm.kinematics is None else arm_model(arm.name, arm.kinematics, arm.joints)
    except ValueError as error:
        raise ConfigError(document.sentences([(("kinematics",), str(error))])) from error
    return ArmConfig(
        name=arm.name,
        slaves=tuple(SlaveConfig(slave.name, devices[slave.device]) for slave in arm.slaves),
        joints=arm.joints,
        cycle=arm.cycle,
        bus=arm.bus,
        mode=arm.mode,
        enable_timeout_s=arm.enable_timeout_s,
        lease_s=arm.lease_s,
        motion=arm.motion,
        cartesian=arm.cartesian,
        jog=arm.jog,
        watch=arm.watch,
        stops=arm.stops,
        inputs=arm.inputs,
        outputs=arm.outputs,
        gripper=arm.gripper,
        arm=model,
        source=path,
    )


def load_device(path: Path, period_us: float | None = None) -> DeviceDescription:
    """Read a device file; with a cycle period (us) its watchdog is checked against it.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    document = read(path)
    device_rules.name_padding(document.data)
    device, findings = _DEVICE.check(document.data)
    findings += device_rules.device_findings(document.data)
    if period_us is not None:
        findings += device_rules.period_findings(document.data, period_us)
    if findings or device is None:
        raise ConfigError(document.sentences(findings))
    return device


def device_path(arm: Path, key: str) -> Path:
    """Return the file of a device: `devices/<key>.yaml` beside the arm's file, or the path that the key is."""
    if "/" in key or key.endswith((".yaml", ".yml")):
        return arm.parent / key
    return arm.parent / "devices" / f"{key}.yaml"


def segment_path(config: ArmConfig) -> Path:
    """Return the file of the virtual segment's slaves, which the arm's file names."""
    return config.source.parent / config.bus.segment


def with_period(config: ArmConfig, period_us: float) -> ArmConfig:
    """Return the same arm with another cycle period (us), as a command's `--cycle-us` asks for.

    Raises:
        ConfigError: the period is out of range or does not suit a device's watchdog.
    """
    cycle, findings = _CYCLE.check({**dataclasses.asdict(config.cycle), "period_us": period_us})
    problems = [f"cycle.{finding[0][-1]}: {finding[1]}" for finding in findings]
    for device in {slave.device.name: slave.device for slave in config.slaves}.values():
        found: list[Finding] = device_rules.period_findings(dataclasses.asdict(device), period_us) if cycle else []
        problems += [f"{device.name}: {dotted(where)}: {text}" for where, text in found]
    if cycle is None or problems:
        raise ConfigError(problems)
    return dataclasses.replace(config, cycle=cycle)


def with_motion(config: ArmConfig, motion: MotionName) -> ArmConfig:
    """Return the same arm that takes other commands at its start, as `rtcp start --mode` asks for.

    Raises:
        ConfigError: the arm lacks what this motion needs: its geometry, a stick.
    """
    if lacking := operation_rules.motion_lacks(
        motion, geometry=config.arm is not None, stick=config.inputs.joystick is not None
    ):
        raise ConfigError([f"motion: {lacking}"])
    return dataclasses.replace(config, motion=motion)


def _no_device(key: str, file: Path) -> str:
    there = sorted(other.stem for other in file.parent.glob("*.yaml")) if file.parent.is_dir() else []
    listed = f"in {file.parent} are {', '.join(there)}" if there else f"{file.parent} holds no device files"
    return f'found the text "{key}", but there is no file {file}; {listed}'
