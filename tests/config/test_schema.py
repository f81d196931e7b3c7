"""Each mistake in the arm's file and the device files, and the sentence that names it."""

from __future__ import annotations

import copy
import dataclasses
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from rtcp.config import ConfigError, default_config, load, load_device, segment_path, with_period

ARM = "assistive_arm.yaml"
DRIVE = "devices/cubemars-orh.yaml"
BOX = "devices/diewu-io.yaml"
JOINT1 = "name: joint1\n    slave: drive1\n    position: {min: -3.1, max: 3.1}\n    velocity: 0.5"
TORQUE = "{index: 0x6071, sub_index: 0, type: int32, name: target_torque, factor: 0.0001}"

KEYS = (
    "name, joints, cycle, bus, drive_mode, control_mode, enable_timeout_s, lease_s, cartesian, jog, "
    "supervision, stops, inputs, outputs, gripper, slaves, kinematics"
)
Spoil = Callable[..., list[str]]


def test_the_default_configuration_loads_whole() -> None:
    arm = load(default_config())
    assert [slave.name for slave in arm.slaves] == ["io", *(f"drive{i}" for i in range(1, 7))]
    assert [joint.slave for joint in arm.joints] == [f"drive{i}" for i in range(1, 7)]
    assert arm.cycle.period_us == 500
    assert arm.source == default_config()
    assert segment_path(arm).is_file()


def test_the_drive_is_described_as_the_facts_say() -> None:
    drive = load(default_config()).slaves[1].device
    rpdo, tpdo = drive.rpdo[0], drive.tpdo[0]
    assert (rpdo.index, tpdo.index) == (0x1600, 0x1A00)
    assert [(c.index, c.type) for c in rpdo.channels] == [
        (0x6040, "uint16"), (0x607A, "int32"), (0x60FF, "int32"), (0x6071, "int32"), (0x6060, "int8"),
    ]  # fmt: skip
    assert [(c.index, c.type) for c in tpdo.channels] == [
        (0x6041, "uint16"), (0x6064, "int32"), (0x606C, "int32"), (0x6077, "int32"), (0x6061, "int8"),
    ]  # fmt: skip
    assert {c.factor for c in (*rpdo.channels, *tpdo.channels) if c.type == "int32"} == {0.0001}


def test_the_configuration_is_frozen() -> None:
    arm = load(default_config())
    with pytest.raises(dataclasses.FrozenInstanceError):
        arm.joints[0].velocity = 3.0  # type: ignore[misc]


def test_the_model_is_imported_without_the_validator() -> None:
    code = "import sys, rtcp.config.model; print('pydantic' in sys.modules, 'yaml' in sys.modules)"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
        == "False False\n"
    )


IN_THE_ARM = {
    "a text for a number": (
        ("period_us: 500 ", 'period_us: "500"'),
        'cycle.period_us: found the text "500", allowed is a number from 100 to 100000; write it without quotes',
    ),
    "a number with its unit": (
        ("period_us: 500 ", "period_us: 500 us"),
        'cycle.period_us: found the text "500 us", allowed is a number from 100 to 100000; '
        "write the number alone, the key names its unit",
    ),
    "a leading zero": (
        ("priority: 80", "priority: 080"),
        'cycle.priority: found the text "080", allowed is an integer from 1 to 98; write it without leading zeros',
    ),
    "true for an integer": (
        ("priority: 80", "priority: true"),
        "cycle.priority: found true, allowed is an integer from 1 to 98",
    ),
    "a fraction for an integer": (
        ("lost_cycles: 40", "lost_cycles: 2.5"),
        "bus.lost_cycles: found 2.5, allowed is an integer from 1 to 1000",
    ),
    "no number": (
        ("receive_fraction: 0.3", "receive_fraction: .nan"),
        "bus.receive_fraction: found nan, allowed is a number greater than 0 and at most 0.6",
    ),
    "an infinite number": (
        ("velocity: 0.5", "velocity: .inf"),
        "joints[0].velocity: found inf, allowed is a number of at least 0.001",
    ),
    "a number too large for any computer": (
        ("velocity: 0.5", "velocity: 1e999"),
        "joints[0].velocity: found inf, allowed is a number of at least 0.001",
    ),
    "a number for a name": (
        ("name: joint1", "name: 1"),
        "joints[0].name: found 1, allowed is a text of 1 to 64 characters; write it in quotes",
    ),
    "nothing where a value belongs": (
        ("lease_s: 0.5", "lease_s:"),
        "lease_s: found nothing, allowed is a number greater than 0",
    ),
    "an end of an open interval": (
        ("send_phase: 0.5", "send_phase: 1"),
        "bus.send_phase: found 1, allowed is a number greater than 0 and less than 1",
    ),
    "a CPU that cannot be": (
        ("# cpu: 3", "cpu: -1"),
        "cycle.cpu: found -1, allowed is an integer of at least 0",
    ),
    "an unknown choice": (
        ("drive_mode: csp", "drive_mode: cps"),
        'drive_mode: found the text "cps", allowed is one of csp, csv, cst',
    ),
    "an unknown key at the top": (
        ("lease_s:", "leese_s:"),
        "leese_s: this key does not exist; did you mean lease_s? allowed are " + KEYS,
    ),
    "an unknown key that resembles none": (
        ("priority: 80", "zzz: 1"),
        "cycle.zzz: this key does not exist; allowed are period_us, priority, cpu, spin_us",
    ),
    "the program's own key": (
        ("lease_s: 0.5", "source: here"),
        "source: this key does not exist; allowed are " + KEYS,
    ),
    "a missing key": (
        ("    jerk: 20.0\n", ""),
        "joints[0]: the key jerk is missing; it must be a number of at least 0.001",
    ),
    "a mapping that is a list": (
        ("{min: -3.1, max: 3.1}", "[-3.1, 3.1]"),
        "joints[0].position: found a list, allowed is a mapping with the keys min, max",
    ),
    "min above max": (
        ("{min: -3.1, max: 3.1}", "{min: 3.1, max: -3.1}"),
        "joints[0].position: found min 3.1 and max -3.1; min must be less than max",
    ),
    "an empty range": (
        ("{min: -3.1, max: 3.1}", "{min: 1, max: 1}"),
        "joints[0].position: found min 1 and max 1; min must be less than max",
    ),
    "a limit beyond the wire": (
        ("max: 3.1", "max: 300000"),
        "joints[0].position.max: found 300000, allowed is -214748 to 214748: "
        "target_position of Cubemars ORH is int32 with factor 0.0001",
    ),
    "an unknown slave": (
        ("slave: drive1", "slave: drive9"),
        'joints[0].slave: found the text "drive9", which is no slave; allowed are the names under slaves: '
        "io, drive1, drive2, drive3, drive4, drive5, drive6",
    ),
    "a slave that moves nothing": (
        ("slave: drive1", "slave: io"),
        'joints[0].slave: found the text "io", which moves no joint: its device diewu-io is of kind io; '
        "allowed is kind cia402",
    ),
    "two joints on one slave": (
        ("slave: drive2", "slave: drive1"),
        'joints[1].slave: found the text "drive1", the slave of joints[0].slave; each needs its own',
    ),
    "two joints of one name": (
        ("name: joint2", "name: joint1"),
        'joints[1].name: found the text "joint1", the name of joints[0].name; each needs its own',
    ),
    "two slaves of one name": (
        ("{name: drive6,", "{name: io,"),
        'slaves[6].name: found the text "io", the name of slaves[0].name; each needs its own',
    ),
    "a device that is not described": (
        ("device: diewu-io", "device: diewu"),
        'slaves[0].device: found the text "diewu", but there is no file devices/diewu.yaml; '
        "in devices are cubemars-orh, diewu-io",
    ),
    "an impossible interface": (
        ("interface: virtual", "interface: a-very-long-name"),
        'bus.interface: found the text "a-very-long-name", allowed is virtual, or a network interface of at most '
        "15 characters without spaces and /",
    ),
}

IN_A_DEVICE = {
    "an unknown kind": (
        DRIVE,
        ("kind: cia402", "kind: servo"),
        'kind: found the text "servo", allowed is one of cia402, io',
    ),
    "an index out of range": (
        DRIVE,
        ("index: 0x6071", "index: 0x16071"),
        "rpdo[0].channels[3].index: found 90225, allowed is an integer from 0 to 65535",
    ),
    "a hexadecimal number in quotes": (
        DRIVE,
        ("index: 0x6071", 'index: "0x6071"'),
        'rpdo[0].channels[3].index: found the text "0x6071", allowed is an integer from 0 to 65535; '
        "write it without quotes",
    ),
    "texts for yes and no": (
        DRIVE,
        ("configurable_pdos: true", "configurable_pdos: yes"),
        'configurable_pdos: found the text "yes", allowed is true or false; yes, no, on and off are texts here',
    ),
    "an unknown type": (
        DRIVE,
        ("type: int8, name: modes_of_operation}", "type: int24, name: modes_of_operation}"),
        'rpdo[0].channels[4].type: found the text "int24", allowed is one of bool, int8, uint8, int16, uint16, int32, '
        "uint32, int64, uint64, float32, float64",
    ),
    "a channel that the kind needs": (
        DRIVE,
        ("name: target_torque,", "name: targettorque,"),
        "rpdo: kind cia402 needs a channel named target_torque; its channels are controlword, target_position, "
        "target_velocity, targettorque, modes_of_operation",
    ),
    "several channels that the kind needs": (
        BOX,
        ("kind: io", "kind: cia402"),
        "rpdo: kind cia402 needs channels named controlword, target_position, target_velocity, target_torque, "
        "modes_of_operation; its channels are outputs",
    ),
    "a channel of a type that the driver cannot use": (
        DRIVE,
        ("type: uint16, name: controlword", "type: uint32, name: controlword"),
        "rpdo[0].channels[0].type: found uint32 for controlword, allowed is uint16",
    ),
    "a bit for a torque": (
        DRIVE,
        (TORQUE, TORQUE.replace("int32", "bool")),
        "rpdo[0].channels[3].type: found bool for target_torque, allowed is int8 or uint8 or int16 or uint16 "
        "or int32 or uint32 or int64 or uint64",
    ),
    "process data that end within a byte": (
        DRIVE,
        (TORQUE, TORQUE + "\n      - {index: 0, sub_index: 0, type: bool}"),
        "rpdo: found 121 bits in all, allowed are whole bytes; "
        "fill up with padding (`{index: 0, sub_index: 0, type: bool}`)",
    ),
    "a channel named twice": (
        DRIVE,
        ("name: target_velocity", "name: target_position"),
        'rpdo[0].channels[2].name: found the text "target_position" again; each channel of the rpdo needs its own',
    ),
    "a factor of nothing": (
        DRIVE,
        (TORQUE, TORQUE.replace("0.0001", "0")),
        "rpdo[0].channels[3].factor: found 0, allowed is any number but 0",
    ),
    "a PDO in the wrong direction": (
        DRIVE,
        ("index: 0x1A00", "index: 0x1600"),
        "tpdo[0].index: found 0x1600, allowed is 0x1a00 to 0x1bff, the objects of a tpdo",
    ),
    "an empty PDO": (
        BOX,
        ("    channels:\n      - {index: 0x7000, sub_index: 1, type: uint16, name: outputs}", "    channels: []\n"),
        "rpdo[0].channels: found an empty list, allowed is a list with at least one entry",
    ),
    "a start-up value that its type cannot hold": (
        DRIVE,
        ("type: int16, value: 6", "type: int16, value: 40000"),
        "sdo[2].value: found 40000, allowed is an integer from -32768 to 32767, the range of int16",
    ),
    "a start-up value between two integers": (
        DRIVE,
        ("type: int16, value: 6", "type: int16, value: 6.5"),
        "sdo[2].value: found 6.5, allowed is an integer from -32768 to 32767, the range of int16",
    ),
    "a DC word without SYNC0": (
        DRIVE,
        ("assign_activate: 0x0300", "assign_activate: 0x0100"),
        "assign_activate: found 0x0100, allowed is 0 for no distributed clocks, or a word that activates SYNC0, "
        "as 0x0300 or 0x0700",
    ),
    "a watchdog that a late frame trips": (
        DRIVE,
        ("watchdog_ms: 20", "watchdog_ms: 1"),
        "watchdog_ms: found 1 ms, allowed is more than 2 cycles, 1 ms (the cycle period is 500 us): "
        "one late frame must not trip it",
    ),
    "a watchdog that stops a drive too late": (
        DRIVE,
        ("watchdog_ms: 20", "watchdog_ms: 500"),
        "watchdog_ms: found 500 ms, allowed is at most 100 ms (the cycle period is 500 us): "
        "until it expires the drive keeps its last target",
    ),
    "a SYNC0 shift of more than a cycle": (
        DRIVE,
        ("sync0_shift_us: 0", "sync0_shift_us: -500"),
        "sync0_shift_us: found -500 us, allowed is less than one cycle in either direction "
        "(the cycle period is 500 us)",
    ),
}


def without_place(sentence: str) -> str:
    return re.sub(r"^[^:]+:\d+: ", "", sentence)


@pytest.mark.parametrize(("change", "sentence"), IN_THE_ARM.values(), ids=IN_THE_ARM.keys())
def test_a_mistake_in_the_arms_file_is_named(problems_after: Spoil, change: tuple[str, str], sentence: str) -> None:
    assert sentence in map(without_place, problems_after(ARM, change))


@pytest.mark.parametrize(("file", "change", "sentence"), IN_A_DEVICE.values(), ids=IN_A_DEVICE.keys())
def test_a_mistake_in_a_device_file_is_named(
    problems_after: Spoil, file: str, change: tuple[str, str], sentence: str
) -> None:
    problems = problems_after(file, change)
    assert sentence in map(without_place, problems)
    assert all(problem.startswith(file) or problem.startswith(ARM) for problem in problems)


def test_one_mistake_gives_one_sentence_with_file_and_line(directory: Path, problems_after: Spoil) -> None:
    line = (directory / ARM).read_text().split("velocity: 0.5")[0].count("\n") + 1
    wanted = f"{ARM}:{line}: joints[0].velocity: found -0.5, allowed is a number of at least 0.001"
    assert problems_after(ARM, ("velocity: 0.5", "velocity: -0.5")) == [wanted]


def test_the_mistakes_of_all_files_come_at_once(directory: Path, problems_after: Spoil) -> None:
    box = directory / BOX
    box.write_text(box.read_text().replace("kind: io", "kind: oi"))
    drive = directory / DRIVE
    drive.write_text(drive.read_text().replace("watchdog_ms: 20", "watchdog_ms: 0"))
    problems = problems_after(ARM, ("drive_mode: csp", "drive_mode: off"), (JOINT1, JOINT1.replace("0.5", "fast")))
    assert [problem.split(": ")[1] for problem in problems] == [
        "drive_mode",
        "joints[0].velocity",
        "kind",
        "watchdog_ms",
    ]


def test_a_device_used_by_six_slaves_is_complained_of_once(problems_after: Spoil) -> None:
    assert len(problems_after(DRIVE, ("kind: cia402", "kind: servo"))) == 1


def test_the_error_reads_as_its_sentences_line_by_line(directory: Path) -> None:
    Path(ARM).write_text("drive_mode: csp\n")
    with pytest.raises(ConfigError) as caught:
        load(Path(ARM))
    assert str(caught.value).splitlines() == caught.value.problems
    assert len(caught.value.problems) == 3  # name, slaves, joints


@pytest.mark.usefixtures("directory")
def test_a_device_may_be_named_by_its_path() -> None:
    Path("elsewhere").mkdir()
    Path(BOX).rename("elsewhere/box.yaml")
    Path(ARM).write_text(Path(ARM).read_text().replace("device: diewu-io", "device: elsewhere/box.yaml"))
    assert load(Path(ARM)).slaves[0].device.kind == "io"


@pytest.mark.usefixtures("directory")
def test_padding_needs_no_name() -> None:
    padding = "\n      - {index: 0, sub_index: 0, type: uint8}"
    Path(DRIVE).write_text(Path(DRIVE).read_text().replace(TORQUE, TORQUE + padding + padding))
    assert [channel.name for channel in load_device(Path(DRIVE)).rpdo[0].channels].count("padding") == 2


@pytest.mark.usefixtures("directory")
def test_numbers_may_be_written_without_a_point_with_exponent_or_in_hexadecimal() -> None:
    text = Path(ARM).read_text().replace("velocity: 0.5", "velocity: 5e-1", 1).replace("jerk: 20.0", "jerk: 20", 1)
    Path(ARM).write_text(text.replace("priority: 80", "priority: 0x50"))
    arm = load(Path(ARM))
    assert (arm.joints[0].velocity, arm.joints[0].jerk, arm.cycle.priority) == (0.5, 20.0, 80)
    assert isinstance(arm.joints[0].jerk, float)


def test_another_period_is_checked_like_the_files() -> None:
    arm = load(default_config())
    assert with_period(arm, 1000).cycle.period_us == 1000
    with pytest.raises(ConfigError, match=r"cycle\.period_us: found 20, allowed is a number from 100 to 100000"):
        with_period(arm, 20)
    with pytest.raises(
        ConfigError, match=r"Cubemars ORH: watchdog_ms: found 20 ms, allowed is more than 2 cycles, 20 ms"
    ):
        with_period(arm, 10_000)


def problems_of_loading() -> list[str]:
    try:
        load(Path(ARM))
    except ConfigError as error:
        return error.problems or ["no sentence"]
    return []


def places(node: object, where: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place in a file, of lists the first entry alone: the others are checked alike."""
    if where:
        yield where
    if isinstance(node, dict):
        for key, value in node.items():
            yield from places(value, (*where, key))
    elif isinstance(node, list):
        yield from places(node[0], (*where, 0))


@pytest.mark.parametrize("value", [None, -1, "x", [], {"a": 1}], ids=repr)
@pytest.mark.parametrize("file", [ARM, DRIVE])
@pytest.mark.usefixtures("directory")
def test_whatever_stands_in_whatever_place_is_accepted_or_named(file: str, value: object) -> None:
    shipped = yaml.safe_load(Path(file).read_text())
    for where in places(shipped):
        spoilt = copy.deepcopy(shipped)
        node = spoilt
        for key in where[:-1]:
            node = node[key]
        node[where[-1]] = value
        Path(file).write_text(yaml.safe_dump(spoilt))
        assert all(re.match(r"[\w/.-]+:\d+: ", sentence) for sentence in problems_of_loading())
