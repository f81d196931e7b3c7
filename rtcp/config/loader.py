"""Reads the arm's file and its device files into one frozen `ArmConfig`, or lists every mistake."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, fields, make_dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

from kinematics.model import ArmModel, Capsule, DhRow, JointLimit, LinkMass
from kinematics.pose import Pose
from rtcp.config import rules
from rtcp.config.buses import bus_class
from rtcp.config.document import Document, read
from rtcp.config.find import class_of_kind, exists
from rtcp.config.findings import Finding, KeyPath
from rtcp.config.model import (
    JOINTS,
    MOST_AXES,
    UNLIMITED_TORQUE,
    VIRTUAL,
    ArmConfig,
    ArmFile,
    ArmSettings,
    BusConfig,
    ConfigError,
    ControlModeName,
    CycleConfig,
    DeviceDescription,
    EthercatBus,
    Joint,
    Kinematics,
    MechanicalLimit,
    NamedTool,
    PluginError,
    ProcessConfig,
    SlaveConfig,
)
from rtcp.config.numbers import Name
from rtcp.config.scaling import FACTOR_TOLERANCE, QUANTITIES, SOURCES, DriveScaling
from rtcp.config.validation import EVERY_KEY, Checker, FileRule, allowed, annotation, keys, rule

RENAMED = {
    "home": "rest_pose",
    "mode": "drive_mode",
    "motion": "control_mode",
    "watch": "supervision",
    "bus.virtual_patience": "bus.timeout_scale",
    "stops.watch": "stops.supervision",
}
"""Former keys of the arm's file, and their names now."""
_SYNC_ERROR_LIMIT = (0x10F1, 2)
_LONGEST_SCALED_LEASE_S, _LONGEST_SCALED_UNLOCKED_S = 3.0, 5.0
_LONGEST_WATCHDOG_MS = 6000.0


@dataclass(frozen=True)
class KinematicsFile:
    """An arm for computation alone: no slaves, no drives."""

    name: Name
    kinematics: Kinematics


@rule(KinematicsFile, "kinematics")
def _limits(file: KinematicsFile) -> Iterator[Finding]:
    if file.kinematics.limits is None:
        wanted = f"a list of {JOINTS} mappings with the keys {', '.join(keys(MechanicalLimit))}"
        need = f"in a file without joints it must be {wanted}"
        yield Finding(("kinematics",), "missing", key="limits", need=need)


@cache
def _arm_checker(bus: Any) -> Checker[ArmFile]:
    """Return the checker of an arm's file on this kind of bus."""
    keys_of_bus = [("bus", bus, field(default_factory=bus))]
    return Checker(make_dataclass(ArmFile.__name__, keys_of_bus, bases=(ArmFile,), frozen=True), RENAMED)


@dataclass(frozen=True)
class _Kind:
    """The key of `bus` that determines its other keys."""

    kind: Name = "ethercat"


@dataclass(frozen=True)
class _NamedKind:
    """The key of a process that determines its other keys."""

    kind: Name


_KINEMATICS, _DEVICE, _CYCLE = Checker(KinematicsFile), Checker(DeviceDescription), Checker(CycleConfig)
_NAMED_KIND, _SCALING = Checker(_NamedKind), Checker(DriveScaling)


def load(path: Path) -> ArmConfig:
    """Read the arm's file and the device files beside it.

    Raises:
        ConfigError: with one sentence for every mistake in all of these files: file, line, key, what was found and
            what is allowed.
    """
    document = _read(path)
    cycle, _ = _CYCLE.check(document.data.get("cycle", {}))
    kind, bus, missing = _bus_of(document)
    nodes = _nodes(document.data, bus, cycle)
    missing += _complete(document.data, bus, nodes)
    devices = {slave.device.name: slave.device for slave in nodes}
    in_devices: list[Finding] = []
    for key, where in _devices_named(document.data):
        file = device_path(path, key)
        if key in devices:
            continue
        if not exists(file):
            missing.append(_no_device(where, key, file))
            continue
        try:
            devices[key] = load_device(file, cycle.period_us if cycle else None)
        except ConfigError as error:
            in_devices += error.findings
    drives = FileRule(
        ("slaves", "joints", "gripper", "external_axes", "feed_forward"),
        partial(rules.drive_findings, devices=devices, unusual=document.unusual),
    )
    terminals = FileRule(("slaves", "inputs", "outputs", "gripper"), partial(rules.terminal_findings, devices=devices))
    suits = FileRule((EVERY_KEY,), lambda arm: arm.bus.findings(arm))
    usual = [_usual(needs, magnitudes, document) for needs, magnitudes in rules.OF_ARM.items()]
    checker: Checker[ArmFile] = _arm_checker(kind)  # type: ignore[arg-type]
    processes, wrong = _processes_of(document)
    data = {key: value for key, value in document.data.items() if key != "processes"}
    arm, findings = checker.check(data, drives, terminals, suits, *usual)
    findings += missing + wrong
    alone = document.data.get("processes") or data.get("external_axes")
    if "joints" not in data and not alone:
        wanted = f"a list of 1 to {MOST_AXES} mappings with the keys {', '.join(keys(Joint))}"
        need = f"it must be {wanted}; a platform of processes or external axes alone has none"
        findings.append(Finding((), "missing", key="joints", need=need))
    elif data.get("joints") == [] and not alone:
        findings.append(Finding(("joints",), "size", found=0, allowed=f"1 to {MOST_AXES} joints"))
    if arm is not None:
        limited = [place for magnitudes in rules.OF_ARM.values() for place in magnitudes(arm)]
        findings += rules.useless_marks(limited, document.unusual)
        described = {slave.name: slave.device for slave in nodes} or {
            slave.name: devices[slave.device] for slave in arm.slaves if slave.device in devices
        }
        findings += [
            finding.below("processes", number)
            for number, process in enumerate(processes)
            for finding in process.findings(described)
        ]
        findings += _shared_channels(processes)
    if findings or in_devices or arm is None:
        raise ConfigError(document.placed(findings) + in_devices)
    models = () if arm.kinematics is None else _arm_models(document, arm.name, arm.kinematics, arm.joints)
    return ArmConfig(
        **{entry.name: getattr(arm, entry.name) for entry in fields(ArmSettings) if entry.name != "processes"},
        slaves=nodes
        or tuple(
            SlaveConfig(slave.name, devices[slave.device], str(device_path(path, slave.device)), slave.alias)
            for slave in arm.slaves
        ),
        processes=processes,
        arm=models[0] if models else None,
        other_tools=models[1:],
        source=path,
    )


def _bus_of(document: Document) -> tuple[type[BusConfig], BusConfig, list[Finding]]:
    """Return a file's kind of bus, its keys if they are valid, and the findings of the kind."""
    data = document.data.get("bus", {})
    kind: type[BusConfig] = EthercatBus
    findings: list[Finding] = []
    if isinstance(data, dict) and "kind" in data:
        named, findings = Checker(_Kind).check({"kind": data["kind"]})
        findings = [finding.below("bus") for finding in findings]
        if named is not None:
            try:
                kind = bus_class(named.kind)
            except PluginError:
                raise
            except ConfigError as error:
                findings = [finding.below("bus") for finding in error.findings]
    bus, _ = Checker(kind).check(data)
    return kind, bus or kind(), findings


def _processes_of(document: Document) -> tuple[tuple[ProcessConfig, ...], list[Finding]]:
    """Return the valid processes of a file, and the findings of the others."""
    entries = document.data.get("processes", [])
    if not isinstance(entries, list):
        wanted = "a list of mappings with the key kind"
        return (), [Finding(("processes",), "type", found=entries, allowed=wanted)]
    processes: list[ProcessConfig] = []
    findings: list[Finding] = []
    for number, entry in enumerate(entries):
        where = ("processes", number)
        named, wrong = _NAMED_KIND.check({"kind": entry.get("kind")} if isinstance(entry, dict) else entry)
        findings += [finding.below(*where) for finding in wrong]
        if named is None:
            continue
        try:
            kind = class_of_kind(ProcessConfig, ProcessConfig.ENTRY_POINTS, named.kind)
        except PluginError:
            raise
        except ConfigError as error:
            findings += [finding.below(*where) for finding in error.findings]
            continue
        process, wrong = Checker(kind).check(entry)
        findings += [finding.below(*where) for finding in wrong]
        if process is not None:
            if process.name in [earlier.name for earlier in processes]:
                findings.append(
                    Finding((*where, "name"), "twice", found=process.name, unit=" twice", allowed="a name each")
                )
            processes.append(process)
    return tuple(processes), findings


def _shared_channels(processes: Sequence[ProcessConfig]) -> Iterator[Finding]:
    """Yield channels that two processes would write, and a second process of a kind, whose commands collide."""
    written: dict[str, int] = {}
    kinds: dict[str, int] = {}
    for number, process in enumerate(processes):
        if (first := kinds.setdefault(process.kind, number)) != number:
            yield Finding(("processes", number, "kind"), "kind_twice", found=process.kind, of=f"processes[{first}]")
        for key, image, channel in process.channels():
            if image == "rpdo" and (first := written.setdefault(channel, number)) != number:
                yield Finding(("processes", number, key), "channel_written", found=channel, of=f"processes[{first}]")


def _nodes(data: Any, bus: BusConfig, cycle: CycleConfig | None) -> tuple[SlaveConfig, ...]:
    joints = data.get("joints")
    names = [joint.get("name") for joint in joints if isinstance(joint, dict)] if isinstance(joints, list) else []
    period_us = (cycle or CycleConfig()).period_us
    return bus.nodes([name for name in names if isinstance(name, str)], period_us)


def _complete(data: Any, bus: BusConfig, nodes: Sequence[SlaveConfig]) -> list[Finding]:
    """Add slaves, and the one of each joint, to the file of an arm on a bus without slaves; return its findings."""
    if not nodes:
        return []
    findings: list[Finding] = []
    if "slaves" in data:
        findings.append(Finding(("slaves",), "bus_without_slaves", bus=bus.kind))
    data["slaves"] = [{"name": slave.name, "device": slave.device.name} for slave in nodes]
    for i, joint in enumerate(data["joints"] if isinstance(data.get("joints"), list) else ()):
        if isinstance(joint, dict):
            if "slave" in joint:
                findings.append(Finding(("joints", i, "slave"), "bus_without_slaves", bus=bus.kind))
            joint["slave"] = joint.get("name")
            if "torque" in bus.LACKS:
                if "torque" in joint:
                    findings.append(Finding(("joints", i, "torque"), "bus_without_torque", lack=bus.LACKS["torque"]))
                joint["torque"] = UNLIMITED_TORQUE
    return findings


def load_device(path: Path, period_us: float | None = None) -> DeviceDescription:
    """Read a device file; with a cycle period (us) its watchdog is checked against it.

    Raises:
        ConfigError: with one sentence for every mistake.
    """
    document = _read(path)
    timing = partial(rules.period_findings, period_us=period_us or 0.0)
    more = [FileRule(("kind", "watchdog_ms", "sync0_shift_us"), timing)] if period_us is not None else []
    empty = [*_without_value(document)]
    data, missing = _with_factors(document.data)
    device, findings = _DEVICE.check(data, _usual(("scaling",), rules.of_scaling, document), *more)
    if empty:
        # What follows from the missing values is not named beside them.
        places = {finding.where for finding in empty}
        findings, missing = [*empty, *(finding for finding in findings if finding.where not in places)], []
    elif device is not None:
        findings += rules.useless_marks(rules.of_scaling(device), document.unusual)
    if device is None or findings or missing:
        raise ConfigError(document.placed(findings + missing))
    return device


def _read(path: Path) -> Document:
    """Read a file in which values may be marked as unusual; raises as `read`."""
    document = read(path)
    document.take_marks()
    return document


def _usual(needs: tuple[str, ...], magnitudes: Callable[[Any], Iterator[rules.Magnitude]], of: Document) -> FileRule:
    """Return the rule that these values are plausible in their unit, or marked."""
    return FileRule(needs, partial(rules.implausible, magnitudes=magnitudes, unusual=of.unusual))


def _without_value(document: Document) -> Iterator[Finding]:
    """Yield the keys of a device's file that `rtcp device new` left for a person to fill in."""
    for where in sorted(document.empty_keys(), key=document.line):
        try:
            need = f"it must be {allowed(annotation(DeviceDescription, where))}"
        except (KeyError, IndexError):
            continue  # of an unknown key, which the checker names
        source = SOURCES.get(str(where[-1]))
        yield Finding(where, "no_value", need=need, where_from=f"; see {source}" if source else "")


def _with_factors(data: Any) -> tuple[Any, list[Finding]]:
    """Return a device's file with the factors that follow from its scaling, and findings where they cannot.

    A factor in the file must be the same. An invalid scaling is left to the checker.
    """
    written = data.get("scaling")
    scalings = [_SCALING.check(entry)[0] for entry in written] if isinstance(written, list) else []
    if not scalings or None in scalings:
        return data, []
    findings: list[Finding] = []
    images: dict[str, Any] = {}
    for image in ("rpdo", "tpdo"):
        images[image] = []
        for i, pdo in enumerate(data.get(image) or () if isinstance(data.get(image), list) else ()):
            channels = pdo.get("channels") if isinstance(pdo, dict) else None
            if not isinstance(channels, list):
                images[image].append(pdo)
                continue
            images[image].append({**pdo, "channels": []})
            for j, channel in enumerate(channels):
                images[image][-1]["channels"].append(channel)
                quantity = QUANTITIES.get(str(channel.get("name"))) if isinstance(channel, dict) else None
                if quantity is None:
                    continue
                axis = channel.get("axis") or pdo.get("axis", 1)
                number = 1 if len(scalings) == 1 else axis
                scaling = scalings[number - 1] if number in range(1, len(scalings) + 1) else None
                factor = None if scaling is None else scaling.factor(quantity)
                if "factor" in channel:
                    stated = channel["factor"]
                    if factor is None or not isinstance(stated, int | float):
                        continue
                    if not math.isclose(stated, factor, rel_tol=FACTOR_TOLERANCE):
                        where = (image, i, "channels", j, "factor")
                        findings.append(Finding(where, "unlike_scaling", found=stated, scaled=factor))
                elif factor is not None:
                    images[image][-1]["channels"][-1] = {**channel, "factor": factor}
                elif scaling is not None:
                    need = "without it scaling needs rated_torque, or rated_current and torque_constant"
                    findings.append(Finding((image, i, "channels", j), "missing", key="factor", need=need))
    return {**data, **{image: pdos for image, pdos in images.items() if image in data}}, findings


def load_kinematics(path: Path) -> ArmModel:
    """Read an arm's file and return its kinematics, with the first tool.

    A file with any key of a whole arm is checked as one, with its device files; its joints' `position` and `velocity`
    are then the limits of the model, and `kinematics.limits` are the mechanical ones that they must lie within.

    Raises:
        ConfigError: with one sentence for every mistake: file, line, key, what was found and what is allowed.
    """
    document = _read(path)
    if _is_whole_arm(document):
        arm = load(path).arm
        if arm is None:
            finding = Finding((), "missing", key="kinematics", need=f"it must be {allowed(Kinematics)}")
            raise ConfigError(document.placed([finding]))
        return arm
    file = _KINEMATICS.read(document, _usual(("kinematics",), rules.of_kinematics, document))
    return _arm_models(document, file.name, file.kinematics, ())[0]


def load_mechanics(path: Path) -> ArmModel:
    """Read an arm's file and return its kinematics with the mechanical limits, where it has `kinematics.limits`.

    Raises:
        ConfigError: as `load_kinematics`.
    """
    model = load_kinematics(path)
    part, _ = Checker(Kinematics).check(_read(path).data["kinematics"])
    return model if part is None or part.limits is None else replace(model, limits=_mechanical(part.limits))


def whole_arm(path: Path) -> ArmConfig | None:
    """Return a whole arm; None where the file has kinematics alone.

    Raises:
        ConfigError: as `load_kinematics`.
    """
    return load(path) if _is_whole_arm(read(path)) else None


def device_path(arm: Path, key: str) -> Path:
    """Return the file of a device: `devices/<key>.yaml` beside the arm's file, or `key` as a path."""
    if "/" in key or key.endswith((".yaml", ".yml")):
        return arm.parent / key
    return arm.parent / "devices" / f"{key}.yaml"


def segment_path(config: ArmConfig) -> Path:
    """Return the file of the virtual segment that the arm's file names."""
    return config.source.parent / config.bus.segment


def with_period(config: ArmConfig, period_us: float) -> ArmConfig:
    """Return the same arm with another cycle period (us), as a command's `--cycle-us` asks for.

    Raises:
        ConfigError: the period is out of range or does not suit a device's watchdog.
    """
    cycle, findings = _CYCLE.check({**asdict(config.cycle), "period_us": period_us})
    if cycle is None:
        raise ConfigError(finding.below("cycle") for finding in findings)
    problems = [
        finding.within(f"{device.name}: ")
        for device in {slave.device.name: slave.device for slave in config.slaves}.values()
        for finding in rules.period_findings(device, period_us)
    ]
    if problems:
        raise ConfigError(problems)
    return replace(config, cycle=cycle)


def with_control_mode(config: ArmConfig, control_mode: ControlModeName) -> ArmConfig:
    """Return the same arm with another control mode at its start, as `rtcp start --mode` asks for.

    Raises:
        ConfigError: the arm lacks the geometry or joystick that this mode needs.
    """
    geometry, joystick = config.arm is not None, config.inputs.joystick is not None
    if lacking := [*rules.missing_for(control_mode, geometry=geometry, joystick=joystick)]:
        raise ConfigError(lacking)
    return replace(config, control_mode=control_mode)


def widen(config: ArmConfig) -> ArmConfig:
    """Return the configuration with `bus.timeout_scale` applied: only where its bus is `virtual`.

    Master and virtual slaves are processes of one host: when it takes the CPU away for 30 ms, as virtual machines do,
    both stand still, and a limit that suits a cable would end every second run. The scale multiplies `bus.lost_cycles`,
    `watchdog_ms` of every device, up to 3 s `lease_s`, up to 5 s `bus.clock_lost_s`, and `supervision.acceleration`: a
    virtual joint whose targets come late catches up faster than any joint with a mass. The sync error counter limit
    among the start-up SDOs (0x10F1:02, ETG.1020) becomes 0, which disables that check: the counter rises by 3 at a
    missed SYNC0 and falls by 1 at any other, so that a host which misses a quarter of its ticks exceeds any limit in
    the end.
    """
    scale = config.bus.timeout_scale
    if config.bus.interface != VIRTUAL or scale == 1:
        return config

    def widened(device: DeviceDescription) -> DeviceDescription:
        unlimited = ((entry.index, entry.sub_index) == _SYNC_ERROR_LIMIT for entry in device.sdo)
        sdo = tuple(replace(e, value=0.0) if off else e for e, off in zip(device.sdo, unlimited, strict=True))
        return replace(device, watchdog_ms=min(device.watchdog_ms * scale, _LONGEST_WATCHDOG_MS), sdo=sdo)

    bus = replace(config.bus, lost_cycles=round(config.bus.lost_cycles * scale))
    if isinstance(bus, EthercatBus):
        clock_lost_s = max(bus.clock_lost_s, min(bus.clock_lost_s * scale, _LONGEST_SCALED_UNLOCKED_S))
        bus = replace(bus, clock_lost_s=clock_lost_s)
    return replace(
        config,
        lease_s=max(config.lease_s, min(config.lease_s * scale, _LONGEST_SCALED_LEASE_S)),
        bus=bus,
        supervision=replace(config.supervision, acceleration=config.supervision.acceleration * scale),
        slaves=tuple(replace(slave, device=widened(slave.device)) for slave in config.slaves),
    )


def _is_whole_arm(document: Document) -> bool:
    own = {field.name for field in fields(KinematicsFile)}
    return any(field.name in document.data for field in fields(ArmFile) if field.name not in own)


def _devices_named(data: Any) -> Iterator[tuple[str, KeyPath]]:
    """Yield the devices that an arm's file names, each with its first place; works on files with mistakes."""
    slaves = data.get("slaves")
    named: set[str] = set()
    for i, slave in enumerate(slaves if isinstance(slaves, list) else ()):
        key = slave.get("device") if isinstance(slave, dict) else None
        if isinstance(key, str) and key and key not in named:
            named.add(key)
            yield key, ("slaves", i, "device")


def _arm_models(document: Document, name: str, part: Kinematics, joints: Sequence[Joint]) -> tuple[ArmModel, ...]:
    """Return the model of an arm with each tool; names, ranges and speeds are those of `joints`, if it has any."""
    try:
        limits = tuple(JointLimit(joint.position.min, joint.position.max, joint.velocity) for joint in joints)
        bare = ArmModel(
            name=name,
            rows=tuple(DhRow(row.alpha, row.a, row.d, row.offset) for row in part.dh),
            limits=limits or _mechanical(part.limits or ()),
            links=tuple(LinkMass(link.mass, _point(link.centre)) for link in part.links or ()),
            joint_names=tuple(joint.name for joint in joints) or ArmModel.joint_names,
            bodies=tuple(
                Capsule(body.link, _point(body.start), _point(body.end), body.radius) for body in part.bodies or ()
            ),
        )
        return tuple(_with_tool(bare, tool) for tool in part.every_tool)
    except ValueError as error:
        raise ConfigError(document.placed([Finding(("kinematics",), "no_arm_model", text=str(error))])) from error


def _with_tool(bare: ArmModel, tool: NamedTool) -> ArmModel:
    """Return the model of an arm with a tool at its flange, whose weight the last link carries."""
    x, y, z, rx, ry, rz = *tool.position, *tool.rpy
    links = bare.links
    if links and tool.mass:
        mass = links[-1].mass + tool.mass
        moments = zip(links[-1].centre, tool.centre, strict=True)
        centre = tuple((links[-1].mass * a + tool.mass * b) / mass for a, b in moments)
        links = (*links[:-1], LinkMass(mass, _point(centre)))
    bodies = tool.bodies
    return replace(
        bare,
        links=links,
        tool=Pose.from_xyzrpy(x, y, z, rx, ry, rz),
        tool_name=tool.name,
        tool_bodies=None
        if bodies is None
        else tuple(Capsule(JOINTS, _point(body.start), _point(body.end), body.radius) for body in bodies),
    )


def _point(vector: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = vector
    return x, y, z


def _mechanical(limits: Sequence[MechanicalLimit]) -> tuple[JointLimit, ...]:
    return tuple(JointLimit(limit.min, limit.max, limit.velocity or math.inf) for limit in limits)


def _no_device(where: KeyPath, key: str, file: Path) -> Finding:
    there = sorted(device.stem for device in file.parent.glob("*.yaml")) if file.parent.is_dir() else []
    listed = f"in {file.parent} are {', '.join(there)}" if there else f"{file.parent} holds no device files"
    return Finding(where, "no_device", found=key, file=file, there=listed)
