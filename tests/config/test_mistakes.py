"""Each mistake in the arm's file, the device files and a file of kinematics, and how it is named."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import ConfigError, default_config, load, load_kinematics, loader
from rtcp.config.document import Document, read
from rtcp.config.findings import Finding
from tests.findings import summary
from tests.samples import some

ARM, IRB, DRIVE, BOX = "assistive_arm.yaml", "geometry.yaml", "devices/cubemars-orh.yaml", "devices/diewu-io.yaml"
TOOL_BOX = "{min: [-1.2, -1.0, -0.42], max: [0.8, 1.0, 1.4]}"
USER = "{name: user, min: [0.42, -0.35, -0.1], max: [1.1, 0.35, 0.85]}"
TOGGLE = "arm_toggle: {number: 9, active: high, debounce_ms: 5}"
TORQUE = "{index: 0x6071, sub_index: 0, type: int32, name: target_torque, factor: 0.0001}"
GEOMETRY = "\nkinematics:\n" + default_config().read_text().split("\nkinematics:\n")[1]
LIMIT1 = "{min: -11*pi/12, max: 11*pi/12, velocity: 25*pi/18}"
BODIES = "kinematics:\n  bodies: [{link: 2, start: [0, 0, 0], end: [0.27, 0, 0], radius: 0.05}]\n"
MECHANICAL = "kinematics:\n  limits:\n" + "    - {min: -pi, max: pi, velocity: 1.0}\n" * 6
ON_AN_OUTPUT = 'gripper: {output: 4, closed: "on"}'
FINGER = (
    "{name: finger, slave: drive7, position: {min: -0.1, max: 1.5}, velocity: 1.0, acceleration: 4.0, jerk: 40.0, "
    "torque: 2.0}"
)
DRIVEN = f"gripper: {{joint: {FINGER}, open_position: 1.4, closed_position: 0.0}}"
CONES = [f"{{name: cone{n}, direction: [0, 0, 1], angle: 1}}" for n in range(9)]
SIXTH = "  - {name: drive6, device: cubemars-orh}\n"

ON_IO = [("joystick: {", "joystick: {box: io, "), ("arm_toggle: {", "arm_toggle: {box: io, "),
         ("emergency_stop: {number", "emergency_stop: {box: io, number"), ("outputs:\n", "outputs:\n  box: io\n"),
         ("gripper: {", "gripper: {box: io, ")]  # fmt: skip
DESK = (SIXTH, SIXTH + "  - {name: desk, device: diewu-io}\n")
TWO_BOXES = [DESK, *ON_IO]

Changes = list[tuple[str, str]]


def driven(old: str, new: str) -> Changes:
    """The changes that give the arm a gripper with a drive, with one text in them replaced."""
    assert old in DRIVEN
    return [(SIXTH, SIXTH + SIXTH.replace("drive6", "drive7")), (ON_AN_OUTPUT, DRIVEN.replace(old, new, 1))]


def external(old: str, new: str) -> Changes:
    """The changes that give the arm an external axis, with one text in them replaced."""
    axis = "{name: belt, slave: drive7, velocity: 0.5, acceleration: 1.0, modes: [velocity]}"
    assert old in axis
    axis, slave = axis.replace(old, new, 1), SIXTH.replace("drive6", "drive7")
    return [(SIXTH, SIXTH + slave),
            (ON_AN_OUTPUT, f"{ON_AN_OUTPUT}\nexternal_axes: [{axis}]")]  # fmt: skip


MISTAKES: list[tuple[str, Changes, str]] = [
    (ARM, [("priority: 80", "priority: true")], "cycle.priority: type"),
    (ARM, [("lost_cycles: 40", "lost_cycles: 2.5")], "bus.lost_cycles: type"),
    (ARM, [("velocity: 0.5", "velocity: .inf")], "joints[0].velocity: range"),
    (ARM, [("# cpu: 3", "cpu: -1")], "cycle.cpu: range"),
    (ARM, [("rest_pose: [0, 0.3, pi/2, 0, 0.5, 0]", "rest_pose: [0, 0.3, pi/2, 0, 0.5]")], "rest_pose: count"),
    (ARM, [("rest_pose: [0, 0.3, pi/2,", "rest_pose: [0, 0.3, pi,")], "rest_pose[2]: outside low=-2.4 high=2.4"),
    (ARM, [("lease_s: 0.5", "source: here")], "source: unknown"),
    (ARM, [("{min: -3.1, max: 3.1}", "{min: 3.1, max: -3.1}")], "joints[0].position: out_of_order"),
    (DRIVE, [("int32, name: position, factor: 0.0001", "int32, name: position, factor: 0.0001, modulo: 62832")],
     "tpdo[0].channels[1].modulo: position_wraps"),
    (DRIVE, [("type: int32, name: position,", "type: uint32, name: position,")],
     "joints[0].position.min: beyond_wire low=0.0 high=429496.7295"),
    (ARM, [("max: 3.1", "max: 300000")], "joints[0].position.max: beyond_wire low=-214748.3648 high=214748.3647"),
    (ARM, [("drive_torque: 37", "drive_torque: 37\n    absolute: {velocity: 1.0e+9}")],
     "joints[4].absolute.velocity: beyond_wire low=-214748.3648 high=214748.3647"),
    (ARM, [("drive_torque: 37", "drive_torque: 37\n    absolute: {position: {min: -300000, max: 2}}")],
     "joints[4].absolute.position.min: beyond_wire low=-214748.3648 high=214748.3647"),
    (ARM, [("slave: drive1", "slave: drive9")], "joints[0].slave: no_slave"),
    (ARM, [("slave: drive1", "slave: io")], "joints[0].slave: moves_no_joint kind=io"),
    (ARM, [("slave: drive2", "slave: drive1")], "joints[1].slave: repeated of=joints[0].slave"),
    (ARM, [("{name: drive6,", "{name: io,")], "slaves[6].name: repeated of=slaves[0].name"),
    (ARM, [("device: diewu-io", "device: diewu")], "slaves[0].device: no_device"),
    (ARM, [("interface: virtual", "interface: a-very-long-name")], "bus.interface: interface"),
    (ARM, [("control_mode: joint", "control_mode: joystick"), ("  joystick:", "  # joystick:")],
     "control_mode: needs key=inputs.joystick"),
    (ARM, [("control_mode: joint", "control_mode: cartesian"), (GEOMETRY, "")], "control_mode: needs key=kinematics"),
    (ARM, [(GEOMETRY, "")], "cartesian.keep_out[0]: box_needs key=kinematics"),
    (ARM, [("  speed: 0.25", "  speed: 0.5")], "cartesian.speed: range"),
    (ARM, [(USER, "{name: user, min: [0.42, 0.35, -0.1], max: [1.1, -0.35, 0.85]}")],
     "cartesian.keep_out[0]: out_of_order"),
    (ARM, [(USER, "{name: user, min: [-0.1, -0.1, -0.1], max: [0.1, 0.1, 0.05]}")],
     "cartesian.keep_out[0]: box_around_base"),
    (ARM, [(USER, "{name: user, min: [2, -0.35, 0], max: [3, 0.35, 0.85]}")],
     "cartesian.keep_out[0]: box_out_of_reach high=1.13"),
    (ARM, [(TOOL_BOX, "{min: [-4, -1, 0], max: [-3, 1, 1]}")], "cartesian.box: box_out_of_reach high=1.13"),
    (ARM, [(TOOL_BOX, "{min: [0.5, -0.3, 0.1], max: [0.8, 0.3, 0.3]}")], "cartesian.keep_out[0]: box_around_box"),
    (ARM, [("name: chair", "name: user")], "cartesian.keep_out[1].name: repeated of=cartesian.keep_out[0].name"),
    (ARM, [("shoulder: 0.03", "shoulder: -0.03")], "cartesian.singularity.shoulder: range"),
    (ARM, [("  angular_speed: 0.3", "  angular_speed: 0.6")],
     "jog.angular_speed: above high=0.5 of=cartesian.angular_speed"),
    (ARM, [("  speed: 0.25 ", "  speed: 0.05 "), ("  speed: 0.1 ", "  # ")],
     "jog.speed: above high=0.05 of=cartesian.speed"),
    (ARM, [("  torque: 1.01 ", "  torque: 0.5 ")], "supervision.torque: range"),
    (ARM, [("  torque: 1.01 ", "  torque: 1.5 ")], "supervision.torque: never_trips found=1.5 high=1.0204081632653061"),
    (ARM, [("drive_torque: 37", "drive_torque: 27")], "joints[4].drive_torque: not_more found=27.0 low=27.0"),
    (ARM, [("  torque: 1.01 ", "  absolute: {torque: 1.1}\n  torque: 1.01 ")],
     "supervision.absolute.torque: never_trips found=1.1"),
    (ARM, [("drive_torque: 37", "drive_torque: 37\n    absolute: {torque: 36.7}")],
     "joints[4].absolute.torque: never_trips found=36.7"),
    (ARM, [("drive_torque: 37", "drive_torque: 37\n    absolute: {position: {min: -1, max: 2}}")],
     "joints[4].absolute.position.min: above high=-2.0"),
    (ARM, [("drive_torque: 37", "drive_torque: 37\n    absolute: {velocity: 0.4}")],
     "joints[4].absolute.velocity: below low=0.5"),
    (ARM, [("  torque: 1.01 ", "  absolute: {speed: 1.2}\n  torque: 1.01 ")],
     "supervision.absolute.speed: below low=1.5"),
    (ARM, [("  singularity:", "  cones: [{name: cup, direction: [0, 0, 0], angle: 1}]\n  singularity:")],
     "cartesian.cones[0].direction: no_direction"),
    (ARM, [("  singularity:", "  cones: [{name: cup, direction: [0, 0, 1], angle: 0.01}]\n  singularity:")],
     "cartesian.cones[0].angle: range"),
    (ARM, [("  singularity:", "  cones: [{name: user, direction: [0, 0, 1], angle: 1}]\n  singularity:")],
     "cartesian.cones[0].name: repeated of=cartesian.keep_out[0].name"),
    (ARM, [("name: user", "name: box")], "cartesian.keep_out[0].name: limit_key means=cartesian.box"),
    (ARM, [("name: user", "name: joints")], "cartesian.keep_out[0].name: limit_key"),
    (ARM, [("name: chair", "name: joint2")], "cartesian.keep_out[1].name: limit_key means=joints[1]"),
    (ARM, [("name: user", "name: user.min")], "cartesian.keep_out[0].name: dot"),
    (ARM, [("name: joint3", "name: joints")], "joints[2].name: limit_key"),
    (ARM, [("emergency_stop: {number: 10", "emergency_stop: {number: 1")],
     "inputs.emergency_stop.number: repeated of=inputs.joystick.forward"),
    (ARM, [("number: 10", "number: 17")], "inputs.emergency_stop.number: range"),
    (ARM, [("    jerk: 20.0\n", "")], "joints[0]: missing key=jerk"),
    (ARM, [("{number: 10, active: low", "{number: 10")], "inputs.emergency_stop: missing key=active"),
    (ARM, [("outputs:\n", "outputs:\n  named: [{name: blower, number: 4}]\n")],
     "outputs.named[0].number: repeated of=gripper.output"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: part, number: 9}]\n")],
     "inputs.named[0].number: repeated of=inputs.arm_toggle.number"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: state_lamp, number: 12}]\n")],
     "inputs.named[0].name: name_of_function"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: io.1, number: 12}]\n")], "inputs.named[0].name: name_of_function"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: part, number: 12, box: shelf}]\n")], "inputs.named[0].box: no_box"),
    (ARM, [("{output: 4", "{output: 2")], "gripper.output: repeated of=outputs.motion_lamp"),
    (ARM, [("  - {name: io, device: diewu-io}\n", "")], "inputs.emergency_stop.number: no_box_at_all kind=input"),
    (ARM, [DESK, *ON_IO[1:]], "inputs.joystick: missing key=box"),
    (ARM, [("joystick: {", "joystick: {analog: {forward: {channel: io.inputs}, left: {channel: io.outputs}}, ")],
     "inputs.joystick.analog.left.channel: channel"),
    (ARM, [("joystick: {", "joystick: {analog: {forward: {channel: io.x, full: 0}, left: {channel: io.y}}, ")],
     "inputs.joystick.analog.forward.full: range"),
    (ARM, [("joystick: {", "joystick: {analog: {forward: {channel: io.x, neutral: 2.5, full: 2.5}, "
            "left: {channel: io.y, neutral: 2.5, full: -2}}, ")],
     "inputs.joystick.analog.forward.neutral: cut_wire found=2.5 low=2.75"),
    (ARM, [("joystick: {", "joystick: {analog: {forward: {channel: io.x}, left: {channel: io.x}}, ")],
     "inputs.joystick.analog.left.channel: repeated of=forward"),
    (ARM, [DESK, *ON_IO[:3], ON_IO[4]], "outputs: missing key=box"),
    (ARM, [*TWO_BOXES, ("gripper: {box: io", "gripper: {box: drive1")], "gripper.box: no_box"),
    (ARM, [*TWO_BOXES, ("emergency_stop: {box: io, number: 10", "emergency_stop: {box: io, number: 1")],
     "inputs.emergency_stop.number: repeated of=inputs.joystick.forward"),
    (ARM, [ON_IO[2], ("number: 10", "number: 1")], "inputs.emergency_stop.number: repeated of=inputs.joystick.forward"),
    (ARM, [("lost_frames: quick_stop", "lost_frames: controlled_stop")], "stops.lost_frames: choice"),
    (ARM, [("lease_ended: controlled_stop", "lease_ended: hold")], "stops.lease_ended: choice"),
    (ARM, [("emergency_stop: quick_stop", "emergency_stop: controlled_stop")], "stops.emergency_stop: choice"),
    (ARM, [("clock_lost: quick_stop", "clock_lost: fast")], "stops.clock_lost: choice"),
    (ARM, [("supervision: quick_stop", "supervision: off")], "stops.supervision: choice"),
    (ARM, [(ON_AN_OUTPUT, 'gripper: {closed: "on"}')], "gripper: one_of_both"),
    (ARM, driven("{joint:", "{output: 4, joint:"), "gripper: one_of_both"),
    (ARM, [(ON_AN_OUTPUT, "gripper: {output: 4, open_position: 1.0}")], "gripper.open_position: other_gripper"),
    (ARM, driven("open_position", 'closed: "on", open_position'), "gripper.closed: other_gripper"),
    (ARM, driven("open_position: 1.4, ", ""), "gripper: missing key=open_position"),
    (ARM, driven("1.4", "1.6"), "gripper.open_position: outside low=-0.1 high=1.5 of=gripper.joint.position"),
    (ARM, driven("closed_position: 0.0", "closed_position: 1.4"), "gripper.closed_position: ends_alike"),
    (ARM, driven("drive7", "drive6"), "gripper.joint.slave: repeated of=joints[5].slave"),
    (ARM, external("[velocity]", "[position]"), "external_axes[0].slave: axis_not_mapped lacking=['profile_velocity']"),
    (ARM, external("[velocity]", "[]"), "external_axes[0].modes: length"),
    (ARM, external("[velocity]", "[position, homing]"), "external_axes[0].modes: home_without_ends"),
    (ARM, external("name: belt", "name: drive2"), "external_axes[0].name: name_of_part"),
    (ARM, external("name: belt", "name: joint2"), "external_axes[0].name: repeated of=joints[1].name"),
    (ARM, external("drive7", "drive6"), "external_axes[0].slave: repeated of=joints[5].slave"),
    (ARM, external("drive7", "io"), "external_axes[0].slave: moves_no_joint"),
    (ARM, external("velocity: 0.5", "velocity: 0.5, position: {min: 1, max: -1}"),
     "external_axes[0].position: out_of_order"),
    (ARM, external("velocity: 0.5", "velocity: 1.0e+9"), "external_axes[0].velocity: beyond_wire"),
    (BOX, [("kind: io", "kind: cia402")], "rpdo: channels_lacking kind=cia402"),
    (DRIVE, [("type: uint16, name: controlword", "type: uint32, name: controlword")],
     "rpdo[0].channels[0].type: type_of_channel channel=controlword"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0x2000, sub_index: 1, type: bool, name: light, factor: 2}")],
     "rpdo[0].channels[4].factor: bool_scaled"),
    (DRIVE, [(TORQUE, "{index: 0x6071, sub_index: 0, type: bool, name: target_torque}")],
     "rpdo[0].channels[3].type: type_of_channel channel=target_torque"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0, sub_index: 0, type: bits}")],
     "rpdo[0].channels[4]: missing key=bits"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0x6072, sub_index: 0, type: bits, bits: 65, name: wide}")],
     "rpdo[0].channels[4].bits: too_many_bits"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0x6072, sub_index: 0, type: bytes, bits: 12, name: field}")],
     "rpdo[0].channels[4].bits: bits_of_bytes"),
    (DRIVE, [(TORQUE, TORQUE.replace("type: int32", "type: int32, bits: 8"))], "rpdo[0].channels[3].bits: bits_fixed"),
    (DRIVE, [(f"index: {n}", f"sync_manager: 2\n    index: {n}") for n in ("0x1600", "0x1A00")],
     "tpdo[0].sync_manager: shared_sync_manager"),
    (DRIVE, [("configurable_pdos: true", "coe: false")], "sdo: without_coe"),
    (DRIVE, [("type: uint32, limit: velocity", "type: float32, limit: velocity")], "limits[2].type: choice"),
    (DRIVE, [("limit: velocity", "limit: velocity, axis: 2")], "limits[2].axis: axis"),
    (DRIVE, [("limit: velocity, factor: 0.0001", "limit: velocity, factor: 0")], "limits[2].factor: range"),
    (ARM, [("\nsupervision:", "\nfeed_forward: {velocity: 1}\nsupervision:")],
     "joints[0].slave: no_offset lacking=['velocity_offset']"),
    (DRIVE, [("assign_activate: 0x0300", "assign_activate: 0x0300\nsync0_factor: 0")], "sync0_cycle_us: no_cycle"),
    (DRIVE, [("name: target_velocity", "name: target_position")], "rpdo[0].channels[2].name: repeated_channel"),
    (DRIVE, [(TORQUE, "{index: 0x6071, sub_index: 0, type: int32, name: target_torque, factor: 0}")],
     "rpdo[0].channels[3].factor: zero"),
    (DRIVE, [("index: 0x1A00", "index: 0x1600")], "tpdo[0].index: index_of_other low=5632 high=6143"),
    (BOX, [("    channels:\n      - {index: 0x7000, sub_index: 1, type: uint16, name: outputs}", "    channels: []\n")],
     "rpdo[0].channels: length"),
    (DRIVE, [("type: int16, value: 6", "type: int16, value: 40000")], "sdo[2].value: outside_type"),
    (DRIVE, [("type: int16, value: 6", "type: bytes, data: 54 4")], "sdo[2].data: no_bytes"),
    (DRIVE, [("sub_index: 0, type: int16, value: 6", 'sub_index: 2, type: bytes, data: "06 00", complete: true')],
     "sdo[2].sub_index: complete_access"),
    (DRIVE, [("type: int16, value: 6", "type: int16, value: 6, complete: true")], "sdo[2].complete: only_for_bytes"),
    (DRIVE, [("type: int16, value: 6", "type: int16")], "sdo[2]: missing key=value"),
    (DRIVE, [("watchdog_ms: 20", "watchdog_ms: 500")], "watchdog_ms: watchdog_too_long"),
    (DRIVE, [("sync0_shift_us: 0", "sync0_shift_us: -500")], "sync0_shift_us: shift_too_long"),
    (IRB, [("alpha: -pi/2", "alpha: pi*2")], "kinematics.dh[1].alpha: type"),
    (IRB, [("kinematics:\n", "kinematics:\n  tool: {rpy: [0, 180, 0]}\n")], "kinematics.tool.rpy[1]: range"),
    (IRB, [("alpha: -pi/2", "alpha: .nan")], "kinematics.dh[1].alpha: range"),
    (IRB, [("d: 0.290", "d: .inf")], "kinematics.dh[0].d: range"),
    (IRB, [("{alpha: 0, a: 0, d: 0.290}", "{alpha: 0, d: 0.290}")], "kinematics.dh[0]: missing key=a"),
    (IRB, [(LIMIT1, "{min: pi/2, max: -pi/2}")], "kinematics.limits[0]: out_of_order"),
    (IRB, [(LIMIT1, "{min: -1, max: 1, velocity: 0}")], "kinematics.limits[0].velocity: range"),
    (IRB, [("kinematics:\n", BODIES.replace("link: 2", "link: 7"))], "kinematics.bodies[0].link: range"),
    (IRB, [("kinematics:\n", "kinematics:\n  tool: {position: [0, 0, 1]}\n  tools: [{name: a}]\n")],
     "kinematics.tool: tool_and_tools"),
    (IRB, [("kinematics:\n", "kinematics:\n  tools: [{name: a}, {name: a}]\n")],
     "kinematics.tools[1].name: repeated of=tools[0].name"),
    (IRB, [("kinematics:\n", BODIES + "  tools: [{name: a, bodies: []}, {name: b}]\n")],
     "kinematics.tools[1]: missing key=bodies"),
    (IRB, [("kinematics:\n", "kinematics: []\nother:\n")], "kinematics: type"),
    (ARM, [("kinematics:\n", MECHANICAL.replace("max: pi", "max: 3.0", 1))], "joints[0].position.max: above high=3.0"),
    (ARM, [("kinematics:\n", MECHANICAL.replace("min: -pi", "min: -pi/2", 1))],
     "joints[0].position.min: below low=-1.5707963267948966"),
    (ARM, [("kinematics:\n", MECHANICAL.replace("velocity: 1.0", "velocity: 0.25", 1))],
     "joints[0].velocity: above high=0.25"),
    (ARM, [("rest_pose: [", "home: [")], "home: renamed new=rest_pose"),
    (ARM, [("drive_mode: csp", "mode: csp")], "mode: renamed new=drive_mode"),
    (ARM, [("control_mode: joint", "motion: joint")], "motion: renamed new=control_mode"),
    (ARM, [("\nsupervision:", "\nwatch:")], "watch: renamed new=supervision"),
    (ARM, [("  supervision: quick_stop", "  watch: quick_stop")], "stops.watch: renamed new=stops.supervision"),
    (ARM, [("timeout_scale: 100", "virtual_patience: 100")], "bus.virtual_patience: renamed new=bus.timeout_scale"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "changes", "expected"), MISTAKES, ids=[expected for *_, expected in MISTAKES])
def test_a_mistake_is_named_with_file_and_line(
    findings_after: Callable[..., list[Finding]], file: str, changes: Changes, expected: str
) -> None:
    findings = findings_after(file, *changes)
    assert expected in [summary(finding, expected) for finding in findings]
    assert all(str(finding.file) in (file, ARM) and finding.line for finding in findings)


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        (ARM, "velocity: 0.5", "velocity: -0.5",
         "joints[0].velocity: found -0.5, allowed is a number of at least 0.001"),
        (ARM, USER, USER.replace("-0.1", "0.9"),
         "cartesian.keep_out[0]: found min 0.9 and max 0.85 in z; min must be less than max"),
        (ARM, "period_us: 500 ", 'period_us: "500"',
         'cycle.period_us: found the text "500", allowed is a number from 100 to 100000; '
         "write it without quotes"),
        (ARM, "period_us: 500 ", "period_us: 500 us",
         'cycle.period_us: found the text "500 us", allowed is a number from 100 to 100000; '
         "write the number alone, the key names its unit"),
        (ARM, "priority: 80", "priority: 080",
         'cycle.priority: found the text "080", allowed is an integer from 1 to 98; '
         "write it without leading zeros"),
        (ARM, "receive_fraction: 0.3", "receive_fraction: .nan",
         "bus.receive_fraction: found nan, allowed is a number greater than 0 and at most 0.6"),
        (ARM, "name: joint1", "name: 1",
         "joints[0].name: found 1, allowed is a text of 1 to 64 characters; write it in quotes"),
        (ARM, "lease_s: 0.5", "lease_s:",
         "lease_s: found nothing, allowed is a number greater than 0"),
        (ARM, "drive_mode: csp", "drive_mode: cps",
         'drive_mode: found the text "cps", allowed is one of csp, csv, cst'),
        (ARM, "priority: 80", "zzz: 1",
         "cycle.zzz: this key does not exist; allowed are period_us, priority, cpu, spin_us"),
        (ARM, "{number: 9, ", "{",
         "inputs.arm_toggle: the key number is missing; it must be an integer from 1 to 16"),
        (ARM, "{min: -3.1, max: 3.1}", "[-3.1, 3.1]",
         "joints[0].position: found a list, allowed is a mapping with the keys min, max"),
        (ARM, "toggle: {number", "togle: {number",
         "inputs.arm_togle: this key does not exist; did you mean arm_toggle? allowed are joystick, arm_toggle, "
         "enabling_switch, emergency_stop, named"),
        (ARM, "left: 3", "left: 2",
         "inputs.joystick.left: found 2, the input of inputs.joystick.backward; each needs its own"),
        (ARM, "  singularity:", f"  cones: [{', '.join(CONES)}]\n  singularity:",
         "cartesian.cones: found a list of 9, allowed is a list of at most 8 entries"),
        (DRIVE, "type: uint32, limit: velocity", "type: bool, limit: velocity",
         'limits[2].type: found the text "bool", allowed is one of int8, uint8, int16, uint16, int24, uint24, int32, '
         "uint32, int40, uint40, int48, uint48, int56, uint56, int64, uint64"),
        (DRIVE, "configurable_pdos: true", "configurable_pdos: yes",
         'configurable_pdos: found the text "yes", allowed is true or false; yes, no, on and off are texts here'),
        (DRIVE, "assign_activate: 0x0300", "assign_activate: 0x0100",
         "assign_activate: found 0x0100, allowed is 0 for no distributed clocks, or a word that activates SYNC0, as "
         "0x0300 or 0x0700"),
        (DRIVE, "watchdog_ms: 20", "watchdog_ms: 1",
         "watchdog_ms: found 1 ms, allowed is more than 2 cycles, 1 ms (the cycle period is 500 us): one late frame "
         "must not trip it"),
        (IRB, "alpha: -pi/2", "alpha: -90",
         "kinematics.dh[1].alpha: found -90, allowed is a number from -6.28319 to 6.28319, or a fraction of pi, as "
         "-pi/2 or 11*pi/12; angles are in rad: write 90 degrees as pi/2"),
        (IRB, "[0.0000977, -0.00012, -0.05159]", "[0.0000977, -0.00012]",
         "kinematics.links[0].centre: found a list of 2, allowed is a list of 3 numbers"),
        (DRIVE, "kind: cia402", "kind: servo",
         'kind: found the text "servo", allowed is one of analog, cia402, coupler, encoder, generic, io, joint'),
    ],
)  # fmt: skip
def test_one_mistake_gives_one_sentence_with_its_line(
    directory: Path, findings_after: Callable[..., list[Finding]], file: str, old: str, new: str, sentence: str
) -> None:
    line = (directory / file).read_text().split(old)[0].count("\n") + 1
    assert [*map(str, findings_after(file, (old, new)))] == [f"{file}:{line}: {sentence}"]


def test_the_mistakes_of_all_files_come_at_once(directory: Path, findings_after: Callable[..., list[Finding]]) -> None:
    for file, old, new in ((BOX, "kind: io", "kind: oi"), (DRIVE, "watchdog_ms: 20", "watchdog_ms: 0")):
        path = directory / file
        path.write_text(path.read_text().replace(old, new))
    findings = findings_after(
        ARM, ("drive_mode: csp", "drive_mode: off"), ("velocity: 0.5", "velocity: fast"),
        (USER, USER.replace("0.42", "2").replace("1.1", "3")), ("{output: 4", "{output: 1"),
    )  # fmt: skip
    keys = ["drive_mode", "joints[0].velocity", "cartesian.keep_out[0]", "gripper.output", "kind", "watchdog_ms"]
    assert [finding.key for finding in findings] == keys


def test_the_error_reads_as_its_sentences_line_by_line(directory: Path) -> None:
    Path(ARM).write_text("drive_mode: csp\n")
    with pytest.raises(ConfigError) as caught:
        load(Path(ARM))
    assert str(caught.value).splitlines() == caught.value.problems
    assert [finding.fields["key"] for finding in caught.value.findings] == ["name", "slaves", "joints"]


def test_an_external_axis_is_the_last_of_all_axes_in_its_own_unit(directory: Path) -> None:
    text = Path(ARM).read_text()
    for old, new in external("modes", "unit: m, modes"):
        text = text.replace(old, new, 1)
    Path(ARM).write_text(text)
    arm = load(Path(ARM))
    assert [axis.name for axis in arm.axes] == [*(joint.name for joint in arm.joints), "belt"]
    assert (arm.first_external, arm.unit_of(6), arm.unit_of(5)) == (6, "m", "rad")


def test_there_is_room_for_ten_axes(directory: Path, findings_after: Callable[..., list[Finding]]) -> None:
    def joint(name: str) -> str:
        return "\n  - " + FINGER.replace("finger", name).replace("drive7", name)

    more = "".join(joint(f"more{i}") for i in range(4))
    slaves = "".join(
        f"  - {{name: {name}, device: cubemars-orh}}\n" for name in ("drive7", *(f"more{i}" for i in range(5)))
    )
    text = Path(ARM).read_text().replace(GEOMETRY, "\n").replace(SIXTH, SIXTH + slaves)
    text = text.replace("    cst_integral: 250\n", f"    cst_integral: 250{more}\n")
    Path(ARM).write_text(text.split("\nrest_pose:")[0] + "\njog:" + text.split("\njog:")[1])
    assert len(load(Path(ARM)).axes) == 10
    (finding,) = findings_after(ARM, (ON_AN_OUTPUT, DRIVEN))
    assert summary(finding, " joints=") == "gripper.joint: too_many_axes joints=10"
    (finding,) = findings_after(ARM, (DRIVEN, ON_AN_OUTPUT), (more, more + joint("more4")))
    assert summary(finding, " found=") == "joints: size found=11"


REST_POSE = "rest_pose: [0, 0.3, pi/2, 0, 0.5, 0]"


def test_an_arm_of_another_number_of_joints_has_no_kinematics(findings_after: Callable[..., list[Finding]]) -> None:
    sixth = "  - name: joint6\n" + Path(ARM).read_text().split("  - name: joint6\n")[1].split("\n\n")[0]
    (finding,) = findings_after(ARM, (sixth, ""), (REST_POSE, ""))
    assert summary(finding, " joints=") == "kinematics: too_many_axes joints=5"


# -- any value anywhere ------------------------------------------------------------------------------------------------


def places(node: object, where: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place in a file; of lists only the first entry, as the others are checked alike."""
    if where:
        yield where
    entries = node.items() if isinstance(node, dict) else enumerate(node[:1] if isinstance(node, list) else ())
    for key, value in entries:
        yield from places(value, (*where, key))


def problems_of(reader: Callable[[Path], object], file: str) -> list[str]:
    try:
        reader(Path(file))
    except ConfigError as error:
        return error.problems or ["no sentence"]
    return []


@pytest.mark.parametrize("file", [ARM, DRIVE, IRB])
def test_any_value_in_any_place_is_accepted_or_named(
    directory: Path, monkeypatch: pytest.MonkeyPatch, file: str
) -> None:
    known = {name: read(Path(name)).data for name in (ARM, DRIVE, BOX, IRB)}
    known[ARM]["gripper"] |= {"joint": copy.deepcopy(known[ARM]["joints"][0])}
    known[IRB]["kinematics"]["tool"] = {"position": [0, 0, 0.1], "rpy": [0, 0, 0]}
    shipped = known[file]
    monkeypatch.setattr(loader, "read", lambda path: Document(path, known[str(path)]))
    for where in some(places(shipped), 5):
        values: list[Any] = [None, -1, 1e300, "x", "pi", True, [], [1, 2, 3], {"a": 1}, [{"min": []}]]
        for value in values:
            node: Any = copy.deepcopy(shipped)
            known[file] = node
            for key in where[:-1]:
                node = node[key]
            node[where[-1]] = value
            problems = problems_of(load_kinematics if file == IRB else load, IRB if file == IRB else ARM)
            assert all(re.match(r"[\w/.-]+:\d+: ", sentence) for sentence in problems)


def without(file: Path, channels: tuple[str, ...]) -> None:
    """Remove the channels of these names from a device file."""
    lines = file.read_text().splitlines()
    file.write_text(
        "".join(f"{line}\n" for line in lines if not any(f"name: {channel}," in line for channel in channels))
    )


@pytest.mark.parametrize(
    ("mode", "lacking"),
    [("csp", ("target_velocity", "target_torque", "velocity", "torque")), ("csv", ("target_torque", "torque"))],
)
def test_a_drive_needs_no_channels_of_other_modes(directory: Path, mode: str, lacking: tuple[str, ...]) -> None:
    without(directory / DRIVE, lacking)
    arm = directory / ARM
    arm.write_text(arm.read_text().replace("drive_mode: csp", f"drive_mode: {mode}"))
    assert len(load(arm).slaves) == 7


@pytest.mark.parametrize(
    ("mode", "lacking"), [("csv", ("target_velocity", "velocity")), ("cst", ("target_torque", "velocity", "torque"))]
)
def test_a_drive_needs_the_channels_of_the_mode_in_use(
    directory: Path, findings_after: Callable[..., list[Finding]], mode: str, lacking: tuple[str, ...]
) -> None:
    without(directory / DRIVE, lacking)
    findings = findings_after(ARM, ("drive_mode: csp", f"drive_mode: {mode}"))
    assert [finding.code for finding in findings] == ["not_mapped"] * 6
    assert all(finding.fields["lacking"] == [*lacking] for finding in findings)


def test_a_box_needs_no_counter(directory: Path) -> None:
    box = directory / BOX
    box.write_text("".join(f"{line}\n" for line in box.read_text().splitlines() if "name: counter" not in line))
    assert load(directory / ARM).slaves[0].device.tpdo[0].channels[0].name == "inputs"
