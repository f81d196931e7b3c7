"""Each mistake in the arm's file, the device files and a file of kinematics, and the sentence that names it."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import ConfigError, default_config, load, load_kinematics, loader
from rtcp.config.document import Document, read
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
SIXTH = "  - {name: drive6, device: cubemars-orh}\n"

ON_IO = [("joystick: {", "joystick: {box: io, "), ("arm_toggle: {", "arm_toggle: {box: io, "),
         ("emergency_stop: {number", "emergency_stop: {box: io, number"), ("outputs:\n", "outputs:\n  box: io\n"),
         ("gripper: {", "gripper: {box: io, ")]  # fmt: skip
DESK = (SIXTH, SIXTH + "  - {name: desk, device: diewu-io}\n")
TWO_BOXES = [DESK, *ON_IO]

Changes = list[tuple[str, str]]


def driven(old: str, new: str) -> Changes:
    """The changes that give the arm a gripper with a drive, with one thing in it replaced."""
    assert old in DRIVEN
    return [(SIXTH, SIXTH + SIXTH.replace("drive6", "drive7")), (ON_AN_OUTPUT, DRIVEN.replace(old, new, 1))]


MISTAKES: list[tuple[str, Changes, str]] = [
    (ARM, [("period_us: 500 ", 'period_us: "500"')],
     'cycle.period_us: found the text "500", allowed is a number from 100 to 100000; write it without quotes'),
    (ARM, [("period_us: 500 ", "period_us: 500 us")],
     'cycle.period_us: found the text "500 us", allowed is a number from 100 to 100000; write the number alone, '
     "the key names its unit"),
    (ARM, [("priority: 80", "priority: 080")],
     'cycle.priority: found the text "080", allowed is an integer from 1 to 98; write it without leading zeros'),
    (ARM, [("priority: 80", "priority: true")],
     "cycle.priority: found true, allowed is an integer from 1 to 98"),
    (ARM, [("lost_cycles: 40", "lost_cycles: 2.5")],
     "bus.lost_cycles: found 2.5, allowed is an integer from 1 to 1000"),
    (ARM, [("receive_fraction: 0.3", "receive_fraction: .nan")],
     "bus.receive_fraction: found nan, allowed is a number greater than 0 and at most 0.6"),
    (ARM, [("velocity: 0.5", "velocity: .inf")],
     "joints[0].velocity: found inf, allowed is a number of at least 0.001"),
    (ARM, [("name: joint1", "name: 1")],
     "joints[0].name: found 1, allowed is a text of 1 to 64 characters; write it in quotes"),
    (ARM, [("lease_s: 0.5", "lease_s:")],
     "lease_s: found nothing, allowed is a number greater than 0"),
    (ARM, [("# cpu: 3", "cpu: -1")],
     "cycle.cpu: found -1, allowed is an integer of at least 0"),
    (ARM, [("drive_mode: csp", "drive_mode: cps")],
     'drive_mode: found the text "cps", allowed is one of csp, csv, cst'),
    (ARM, [("lease_s:", "leese_s:")],
     "leese_s: this key does not exist; did you mean lease_s? allowed are name, joints, cycle, bus, drive_mode, "
     "control_mode, enable_timeout_s, lease_s, home, cartesian, jog, guiding, supervision, stops, inputs, outputs, "
     "gripper, payload, "
     "recording, ros, processes, slaves, kinematics"),
    (ARM, [("home: [0, 0.3, pi/2, 0, 0.5, 0]", "home: [0, 0.3, pi/2, 0, 0.5]")],
     "home: found 5 numbers, allowed are 6, one a joint"),
    (ARM, [("home: [0, 0.3, pi/2,", "home: [0, 0.3, pi,")],
     "home[2]: found 3.14159, allowed is -2.4 to 2.4, the position of joint3"),
    (ARM, [("priority: 80", "zzz: 1")],
     "cycle.zzz: this key does not exist; allowed are period_us, priority, cpu, spin_us"),
    (ARM, [("lease_s: 0.5", "source: here")],
     "source: this key does not exist; allowed are name, joints, cycle, bus, drive_mode, control_mode, "
     "enable_timeout_s, lease_s, home, cartesian, jog, guiding, supervision, stops, inputs, outputs, gripper, payload, "
     "recording, ros, processes, slaves, kinematics"),
    (ARM, [("    jerk: 20.0\n", "")],
     "joints[0]: the key jerk is missing; it must be a number of at least 0.001"),
    (ARM, [("{min: -3.1, max: 3.1}", "[-3.1, 3.1]")],
     "joints[0].position: found a list, allowed is a mapping with the keys min, max"),
    (ARM, [("{min: -3.1, max: 3.1}", "{min: 3.1, max: -3.1}")],
     "joints[0].position: found min 3.1 and max -3.1; min must be less than max"),
    (ARM, [("max: 3.1", "max: 300000")],
     "joints[0].position.max: found 300000, allowed is -214748 to 214748: target_position of Cubemars ORH is int32 "
     "with factor 0.0001"),
    (ARM, [("slave: drive1", "slave: drive9")],
     'joints[0].slave: found the text "drive9", which is no slave; allowed are the names under slaves: io, drive1, '
     "drive2, drive3, drive4, drive5, drive6"),
    (ARM, [("slave: drive1", "slave: io")],
     'joints[0].slave: found the text "io", which moves no joint: its device diewu-io is of kind io; allowed is '
     "kind cia402"),
    (ARM, [("slave: drive2", "slave: drive1")],
     'joints[1].slave: found the text "drive1", the slave of joints[0].slave; each needs its own'),
    (ARM, [("{name: drive6,", "{name: io,")],
     'slaves[6].name: found the text "io", the name of slaves[0].name; each needs its own'),
    (ARM, [("device: diewu-io", "device: diewu")],
     'slaves[0].device: found the text "diewu", but there is no file devices/diewu.yaml; in devices are '
     "cubemars-orh, diewu-io, myactuator-x6-60, shape-setter-box, shape-setter-meter, synapticon-somanet, "
     "two-axis-drive"),
    (ARM, [("interface: virtual", "interface: a-very-long-name")],
     'bus.interface: found the text "a-very-long-name", allowed is virtual, or a network interface of at most 15 '
     "characters without spaces and /"),
    (ARM, [("control_mode: joint", "control_mode: joints")],
     'control_mode: found the text "joints", allowed is one of joint, cartesian, joystick, velocity, torque'),
    (ARM, [("control_mode: joint", "control_mode: joystick"), ("  joystick:", "  # joystick:")],
     'control_mode: found the text "joystick", which needs a joystick: the key inputs.joystick is missing'),
    (ARM, [("control_mode: joint", "control_mode: cartesian"), (GEOMETRY, "")],
     'control_mode: found the text "cartesian", which needs the arm\'s geometry: the key kinematics is missing'),
    (ARM, [(GEOMETRY, "")],
     "cartesian.keep_out[0]: found a box, which needs the arm's geometry: the key kinematics is missing"),
    (ARM, [("  speed: 0.25", "  speed: 0.5")],
     "cartesian.speed: found 0.5, allowed is a number greater than 0 and at most 0.25"),
    (ARM, [(USER, "{name: user, min: [0.42, -0.35], max: [1.1, 0.35, 0.85]}")],
     "cartesian.keep_out[0].min: found a list of 2, allowed is a list of 3 numbers"),
    (ARM, [(USER, "{name: user, min: [420, -0.35, -0.1], max: [1100, 0.35, 0.85]}")],
     "cartesian.keep_out[0].min[0]: found 420, allowed is a number from -100 to 100"),
    (ARM, [(USER, "{name: user, min: [0.42, 0.35, -0.1], max: [1.1, -0.35, 0.85]}")],
     "cartesian.keep_out[0]: found min 0.35 and max -0.35 in y; min must be less than max"),
    (ARM, [(USER, "{name: user, min: [-0.1, -0.1, -0.1], max: [0.1, 0.1, 0.05]}")],
     "cartesian.keep_out[0]: found a box around the arm's base, allowed is one beside it: the base is at (0, 0, "
     "0), the shoulder at (0, 0, 0.17)"),
    (ARM, [(USER, "{name: user, min: [2, -0.35, 0], max: [3, 0.35, 0.85]}")],
     "cartesian.keep_out[0]: found a box that begins 2.000 m from the shoulder, allowed is at most 1.130 m, the "
     "arm's reach: the arm never meets it"),
    (ARM, [(TOOL_BOX, "{min: [-4, -1, 0], max: [-3, 1, 1]}")],
     "cartesian.box: found a box that begins 3.000 m from the shoulder, allowed is at most 1.130 m, the arm's "
     "reach: the tool is never inside"),
    (ARM, [(TOOL_BOX, "{min: [0.5, -0.3, 0.1], max: [0.8, 0.3, 0.3]}")],
     "cartesian.keep_out[0]: found a box around all of cartesian.box: the tool has no place left"),
    (ARM, [("name: chair", "name: user")],
     'cartesian.keep_out[1].name: found the text "user", the name of cartesian.keep_out[0].name; each needs its own'),
    (ARM, [("shoulder: 0.03", "shoulder: -0.03")],
     "cartesian.singularity.shoulder: found -0.03, allowed is a number of at least 0"),
    (ARM, [("  angular_speed: 0.3", "  angular_speed: 0.6")],
     "jog.angular_speed: this is 0.6, allowed is at most 0.5, cartesian.angular_speed"),
    (ARM, [("  speed: 0.25 ", "  speed: 0.05 "), ("  speed: 0.1 ", "  # ")],
     "jog.speed: this is 0.1, allowed is at most 0.05, cartesian.speed"),
    (ARM, [("  torque: 1.5 ", "  torque: 0.5 ")],
     "supervision.torque: found 0.5, allowed is a number from 1 to 10"),
    (ARM, [("name: user", "name: box")],
     'cartesian.keep_out[0].name: found the text "box", which in the key of a limit means cartesian.box'),
    (ARM, [("name: user", "name: joints")],
     'cartesian.keep_out[0].name: found the text "joints", which in the key of a limit means all joints'),
    (ARM, [("name: chair", "name: joint2")],
     'cartesian.keep_out[1].name: found the text "joint2", which in the key of a limit means joints[1]'),
    (ARM, [("name: user", "name: user.min")],
     'cartesian.keep_out[0].name: found the text "user.min", allowed is one without a dot: dots separate the parts '
     "of a key"),
    (ARM, [("name: joint3", "name: joints")],
     'joints[2].name: found the text "joints", which in the key of a limit means all joints'),
    (ARM, [("left: 3", "left: 2")],
     "inputs.joystick.left: found 2, the input of inputs.joystick.backward; each needs its own"),
    (ARM, [("emergency_stop: {number: 10", "emergency_stop: {number: 1")],
     "inputs.emergency_stop.number: found 1, the input of inputs.joystick.forward; each needs its own"),
    (ARM, [("number: 10", "number: 17")],
     "inputs.emergency_stop.number: found 17, allowed is an integer from 1 to 16"),
    (ARM, [(TOGGLE, "arm_toggle: {active: high}")],
     "inputs.arm_toggle: the key number is missing; it must be an integer from 1 to 16"),
    (ARM, [("{number: 10, active: low", "{number: 10")],
     "inputs.emergency_stop: the key active is missing; it must be one of high, low"),
    (ARM, [(TOGGLE, "toggle: {number: 9, active: high, debounce_ms: 5}")],
     "inputs.toggle: this key does not exist; did you mean arm_toggle? allowed are joystick, arm_toggle, "
     "enabling_switch, emergency_stop, named"),
    (ARM, [("outputs:\n", "outputs:\n  named: [{name: blower, number: 4}]\n")],
     "outputs.named[0].number: found 4, the output of gripper.output; each needs its own"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: part, number: 9}]\n")],
     "inputs.named[0].number: found 9, the input of inputs.arm_toggle.number; each needs its own"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: state_lamp, number: 12}]\n")],
     'inputs.named[0].name: found the text "state_lamp", allowed is a name without a dot that is not that of a '
     "function"),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: io.1, number: 12}]\n")],
     'inputs.named[0].name: found the text "io.1", allowed is a name without a dot that is not that of a function'),
    (ARM, [("inputs:\n", "inputs:\n  named: [{name: part, number: 12, box: shelf}]\n")],
     'inputs.named[0].box: found the text "shelf", which is no IO box; allowed is io'),
    (ARM, [("{output: 4", "{output: 2")],
     "gripper.output: found 2, the output of outputs.motion_lamp; each needs its own"),
    (ARM, [("  - {name: io, device: diewu-io}\n", "")],
     "inputs.emergency_stop.number: found input 10, but no slave is of kind io; leave it out for such an arm"),
    (ARM, [DESK, *ON_IO[1:]],
     "inputs.joystick.box: the key is missing; with several IO boxes it must be one of io, desk"),
    (ARM, [DESK, *ON_IO[:3], ON_IO[4]],
     "outputs.box: the key is missing; with several IO boxes it must be one of io, desk"),
    (ARM, [*TWO_BOXES, ("gripper: {box: io", "gripper: {box: drive1")],
     'gripper.box: found the text "drive1", which is no IO box; allowed is io, desk'),
    (ARM, [*TWO_BOXES, ("emergency_stop: {box: io, number: 10", "emergency_stop: {box: io, number: 1")],
     "inputs.emergency_stop.number: found 1, the input of inputs.joystick.forward; each needs its own"),
    (ARM, [ON_IO[2], ("number: 10", "number: 1")],
     "inputs.emergency_stop.number: found 1, the input of inputs.joystick.forward; each needs its own"),
    (ARM, [("lost_frames: quick_stop", "lost_frames: controlled_stop")],
     'stops.lost_frames: found the text "controlled_stop", allowed is one of quick_stop, torque_off'),
    (ARM, [("lease_ended: controlled_stop", "lease_ended: hold")],
     'stops.lease_ended: found the text "hold", allowed is one of controlled_stop, quick_stop, torque_off'),
    (ARM, [("emergency_stop: quick_stop", "emergency_stop: controlled_stop")],
     'stops.emergency_stop: found the text "controlled_stop", allowed is one of quick_stop, torque_off'),
    (ARM, [("clock_lost: quick_stop", "clock_lost: fast")],
     'stops.clock_lost: found the text "fast", allowed is one of controlled_stop, quick_stop, torque_off'),
    (ARM, [("supervision: quick_stop", "supervision: off")],
     'stops.supervision: found the text "off", allowed is one of quick_stop, torque_off'),
    (ARM, [("slave_lost: quick_stop", "slaves_lost: quick_stop")],
     "stops.slaves_lost: this key does not exist; did you mean slave_lost? allowed are lost_frames, slave_lost, "
     "drive_fault, clock_lost, emergency_stop, supervision, lease_ended, enabling_switch"),
    (ARM, [(ON_AN_OUTPUT, 'gripper: {closed: "on"}')],
     "gripper: found neither output nor joint, allowed is one of them: a digital output, or a drive of its own"),
    (ARM, driven("{joint:", "{output: 4, joint:"),
     "gripper: found both output and joint, allowed is one of them: a digital output, or a drive of its own"),
    (ARM, [(ON_AN_OUTPUT, "gripper: {output: 4, open_position: 1.0}")],
     "gripper.open_position: this key belongs to a gripper with a joint, not to one on an output"),
    (ARM, driven("open_position", 'closed: "on", open_position'),
     "gripper.closed: this key belongs to a gripper on an output, not to one with a joint"),
    (ARM, driven("open_position: 1.4, ", ""),
     "gripper: the key open_position is missing; it must be a number inside gripper.joint.position"),
    (ARM, driven("1.4", "1.6"),
     "gripper.open_position: found 1.6, allowed is -0.1 to 1.5, gripper.joint.position"),
    (ARM, driven("closed_position: 0.0", "closed_position: 1.4"),
     "gripper.closed_position: found 1.4, the open_position; the two must differ"),
    (ARM, driven("drive7", "drive6"),
     'gripper.joint.slave: found the text "drive6", the slave of joints[5].slave; each needs its own'),
    (DRIVE, [("kind: cia402", "kind: servo")],
     'kind: found the text "servo", allowed is one of analog, cia402, coupler, encoder, generic, io, joint'),
    (DRIVE, [("index: 0x6071", "index: 0x16071")],
     "rpdo[0].channels[3].index: found 90225, allowed is an integer from 0 to 65535"),
    (DRIVE, [("configurable_pdos: true", "configurable_pdos: yes")],
     'configurable_pdos: found the text "yes", allowed is true or false; yes, no, on and off are texts here'),
    (DRIVE, [("type: int8, name: modes_of_operation}", "type: int12, name: modes_of_operation}")],
     'rpdo[0].channels[4].type: found the text "int12", allowed is one of bool, int8, uint8, int16, uint16, int24, '
     "uint24, int32, uint32, int40, uint40, int48, uint48, int56, uint56, int64, uint64, float32, float64, bits, "
     "bytes"),
    (BOX, [("kind: io", "kind: cia402")],
     "rpdo: kind cia402 needs channels named controlword, target_position; "
     "its channels are outputs"),
    (DRIVE, [("type: uint16, name: controlword", "type: uint32, name: controlword")],
     "rpdo[0].channels[0].type: found uint32 for controlword, allowed is uint16"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0x2000, sub_index: 1, type: bool, name: light, factor: 2}")],
     "rpdo[0].channels[4].factor: found 2 with the type bool, allowed is none: it is 0 or 1; leave it out"),
    (DRIVE, [(TORQUE, "{index: 0x6071, sub_index: 0, type: bool, name: target_torque}")],
     "rpdo[0].channels[3].type: found bool for target_torque, allowed is int8 or uint8 or int16 or uint16 or int24 "
     "or uint24 or int32 or uint32 or int40 or uint40 or int48 or uint48 or int56 or uint56 or int64 or uint64"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0, sub_index: 0, type: bits}")],
     "rpdo[0].channels[4]: the key bits is missing; the type bits needs a length of 1 to 64"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0x6072, sub_index: 0, type: bits, bits: 65, name: wide}")],
     "rpdo[0].channels[4].bits: found 65, allowed is 1 to 64 for a channel of the type bits"),
    (DRIVE, [(TORQUE, TORQUE + "\n      - {index: 0x6072, sub_index: 0, type: bytes, bits: 12, name: field}")],
     "rpdo[0].channels[4].bits: found 12, allowed is a multiple of 8 from 8 to 248 for the type bytes"),
    (DRIVE, [(TORQUE, TORQUE.replace("type: int32", "type: int32, bits: 8"))],
     "rpdo[0].channels[3].bits: found 8, but the type int32 has 32 bits; leave it out, or write the type bits or "
     "bytes"),
    (DRIVE, [(f"index: {n}", f"sync_manager: 2\n    index: {n}") for n in ("0x1600", "0x1A00")],
     "tpdo[0].sync_manager: found 2, a sync manager of the rpdo; each carries one direction"),
    (DRIVE, [("configurable_pdos: true", "coe: false")],
     "sdo: found 6 entries, but the device has no CoE (coe: false); leave them out"),
    (DRIVE, [("assign_activate: 0x0300", "assign_activate: 0x0300\nsync0_factor: 0")],
     "sync0_cycle_us: found 0, allowed is a cycle above 0 us where sync0_factor is 0"),
    (DRIVE, [("name: target_velocity", "name: target_position")],
     'rpdo[0].channels[2].name: found the text "target_position" again; each channel of the rpdo needs its own'),
    (DRIVE, [(TORQUE, "{index: 0x6071, sub_index: 0, type: int32, name: target_torque, factor: 0}")],
     "rpdo[0].channels[3].factor: found 0, allowed is any number but 0"),
    (DRIVE, [("index: 0x1A00", "index: 0x1600")],
     "tpdo[0].index: found 0x1600, one of the objects of a rpdo (0x1600 to 0x17ff); allowed is one of a tpdo"),
    (BOX, [("    channels:\n      - {index: 0x7000, sub_index: 1, type: uint16, name: outputs}", "    channels: []\n")],
     "rpdo[0].channels: found an empty list, allowed is a list with at least one entry"),
    (DRIVE, [("type: int16, value: 6", "type: int16, value: 40000")],
     "sdo[2].value: found 40000, allowed is an integer from -32768 to 32767, the range of int16"),
    (DRIVE, [("type: int16, value: 6", "type: bytes, data: 54 4")],
     'sdo[2].data: found the text "54 4", allowed are bytes in hexadecimal, as "54 41 4E 4B", for the type bytes'),
    (DRIVE, [("sub_index: 0, type: int16, value: 6", 'sub_index: 2, type: bytes, data: "06 00", complete: true')],
     "sdo[2].sub_index: found 2, allowed is 0 or 1 with complete access"),
    (DRIVE, [("type: int16, value: 6", "type: int16, value: 6, complete: true")],
     "sdo[2].complete: found with the type int16, allowed is the type bytes"),
    (DRIVE, [("type: int16, value: 6", "type: int16")],
     "sdo[2]: the key value is missing; the type int16 needs it"),
    (DRIVE, [("assign_activate: 0x0300", "assign_activate: 0x0100")],
     "assign_activate: found 0x0100, allowed is 0 for no distributed clocks, or a word that activates SYNC0, as "
     "0x0300 or 0x0700"),
    (DRIVE, [("watchdog_ms: 20", "watchdog_ms: 1")],
     "watchdog_ms: found 1 ms, allowed is more than 2 cycles, 1 ms (the cycle period is 500 us): one late frame "
     "must not trip it"),
    (DRIVE, [("watchdog_ms: 20", "watchdog_ms: 500")],
     "watchdog_ms: found 500 ms, allowed is at most 100 ms (the cycle period is 500 us): until it expires the "
     "drive keeps its last target"),
    (DRIVE, [("sync0_shift_us: 0", "sync0_shift_us: -500")],
     "sync0_shift_us: found -500 us, allowed is less than one cycle in either direction (the cycle period is 500 "
     "us)"),
    (IRB, [("alpha: -pi/2", "alpha: pi*2")],
     'kinematics.dh[1].alpha: found the text "pi*2", allowed is a number from -6.28319 to 6.28319, or a fraction '
     "of pi, as -pi/2 or 11*pi/12"),
    (IRB, [("alpha: -pi/2", "alpha: -90 deg")],
     'kinematics.dh[1].alpha: found the text "-90 deg", allowed is a number from -6.28319 to 6.28319, or a '
     "fraction of pi, as -pi/2 or 11*pi/12; write the number alone, the key names its unit"),
    (IRB, [("alpha: -pi/2", "alpha: -90")],
     "kinematics.dh[1].alpha: found -90, allowed is a number from -6.28319 to 6.28319, or a fraction of pi, as "
     "-pi/2 or 11*pi/12; angles are in rad: write 90 degrees as pi/2"),
    (IRB, [("kinematics:\n", "kinematics:\n  tool: {rpy: [0, 180, 0]}\n")],
     "kinematics.tool.rpy[1]: found 180, allowed is a number from -6.28319 to 6.28319, or a fraction of pi, as "
     "-pi/2 or 11*pi/12; angles are in rad: write 90 degrees as pi/2"),
    (IRB, [("alpha: -pi/2", "alpha: .nan")],
     "kinematics.dh[1].alpha: found nan, allowed is a number from -6.28319 to 6.28319, or a fraction of pi, as "
     "-pi/2 or 11*pi/12; angles are in rad: write 90 degrees as pi/2"),
    (IRB, [("d: 0.290", "d: .inf")],
     "kinematics.dh[0].d: found inf, allowed is a number from -100 to 100"),
    (IRB, [("d: 0.290", "d: 290")],
     "kinematics.dh[0].d: found 290, allowed is a number from -100 to 100"),
    (IRB, [("{alpha: 0, a: 0, d: 0.290}", "{alpha: 0, d: 0.290}")],
     "kinematics.dh[0]: the key a is missing; it must be a number from -100 to 100"),
    (IRB, [("{alpha: 0, a: 0, d: 0.290}", "{alpha: 0, a: 0, d: 0.290, theta: 0}")],
     "kinematics.dh[0].theta: this key does not exist; allowed are alpha, a, d, offset"),
    (IRB, [("    - {alpha: 0, a: 0, d: 0.290}\n", "")],
     "kinematics.dh: found a list of 5, allowed is a list of 6 entries"),
    (IRB, [(LIMIT1, "{min: pi/2, max: -pi/2}")],
     "kinematics.limits[0]: found min 1.5708 and max -1.5708; min must be less than max"),
    (IRB, [(LIMIT1, "{min: -1, max: 1, velocity: 0}")],
     "kinematics.limits[0].velocity: found 0, allowed is a number greater than 0, or a fraction of pi, as -pi/2 or "
     "11*pi/12"),
    (IRB, [("mass: 3.067", "mass: -3.067")],
     "kinematics.links[0].mass: found -3.067, allowed is a number of at least 0"),
    (IRB, [("[0.0000977, -0.00012, -0.05159]", "[0.0000977, -0.00012]")],
     "kinematics.links[0].centre: found a list of 2, allowed is a list of 3 numbers"),
    (IRB, [("kinematics:\n", "kinematics:\n  tool: {rpy: [0, 0, 0, 1]}\n")],
     "kinematics.tool.rpy: found a list of 4, allowed is a list of 3 numbers"),
    (IRB, [("kinematics:\n", BODIES.replace("link: 2", "link: 7"))],
     "kinematics.bodies[0].link: found 7, allowed is an integer from 0 to 6"),
    (IRB, [("kinematics:\n", BODIES.replace("0.05", "0"))],
     "kinematics.bodies[0].radius: found 0, allowed is a number greater than 0"),
    (IRB, [("kinematics:\n", "kinematics:\n  bodies: []\n")],
     "kinematics.bodies: found an empty list, allowed is a list with at least one entry"),
    (IRB, [("kinematics:\n", "kinematics:\n  tool: {position: [0, 0, 1]}\n  tools: [{name: a}]\n")],
     "kinematics.tool: found beside tools: move it into the list, as its first"),
    (IRB, [("kinematics:\n", "kinematics:\n  tools: [{name: a}, {name: a}]\n")],
     'kinematics.tools[1].name: found the text "a", the name of tools[0].name; each needs its own'),
    (IRB, [("kinematics:\n", BODIES + "  tools: [{name: a, bodies: []}, {name: b}]\n")],
     "kinematics.tools[1]: the key bodies is missing; where the arm's are named, so are the tool's: a list, [] for "
     "none"),
    (IRB, [("kinematics:\n", "kinematics: []\nother:\n")],
     "kinematics: found an empty list, allowed is a mapping with the keys dh, limits, links, tool, tools, bodies"),
    (IRB, [("name: abb-irb120", "name: abb-irb120\ncolor: 3")],
     "color: this key does not exist; allowed are name, kinematics"),
    (ARM, [("kinematics:\n", MECHANICAL.replace("max: pi", "max: 3.0", 1))],
     "joints[0].position.max: found 3.1, allowed is at most 3, the joint's mechanical end in kinematics.limits[0]"),
    (ARM, [("kinematics:\n", MECHANICAL.replace("min: -pi", "min: -pi/2", 1))],
     "joints[0].position.min: found -3.1, allowed is at least -1.5708, the joint's mechanical end in "
     "kinematics.limits[0]"),
    (ARM, [("kinematics:\n", MECHANICAL.replace("velocity: 1.0", "velocity: 0.25", 1))],
     "joints[0].velocity: found 0.5, allowed is at most 0.25, the velocity in kinematics.limits[0]"),
    (ARM, [("drive_mode: csp", "mode: csp")], "mode: this key is now called drive_mode; rename it"),
    (ARM, [("control_mode: joint", "motion: joint")], "motion: this key is now called control_mode; rename it"),
    (ARM, [("\nsupervision:", "\nwatch:")], "watch: this key is now called supervision; rename it"),
    (ARM, [("  supervision: quick_stop", "  watch: quick_stop")],
     "stops.watch: this key is now called stops.supervision; rename it"),
    (ARM, [("timeout_scale: 100", "virtual_patience: 100")],
     "bus.virtual_patience: this key is now called bus.timeout_scale; rename it"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "changes", "sentence"), MISTAKES, ids=[sentence[:60] for *_, sentence in MISTAKES])
def test_a_mistake_is_named_with_file_and_line(
    problems_after: Callable[..., list[str]], file: str, changes: Changes, sentence: str
) -> None:
    problems = problems_after(file, *changes, reader=load_kinematics if file == IRB else load)
    assert sentence in [re.sub(r"^[^:]+:\d+: ", "", problem) for problem in problems]
    assert all(re.match(rf"({file}|{ARM}):\d+: ", problem) for problem in problems)


@pytest.mark.parametrize(
    ("file", "old", "new", "sentence"),
    [
        (ARM, "velocity: 0.5", "velocity: -0.5",
         "joints[0].velocity: found -0.5, allowed is a number of at least 0.001"),
        (ARM, USER, USER.replace("-0.1", "0.9"),
         "cartesian.keep_out[0]: found min 0.9 and max 0.85 in z; min must be less than max"),
        (DRIVE, "kind: cia402", "kind: servo",
         'kind: found the text "servo", allowed is one of analog, cia402, coupler, encoder, generic, io, joint'),
    ],
)  # fmt: skip
def test_one_mistake_gives_one_sentence_with_its_line(
    directory: Path, problems_after: Callable[..., list[str]], file: str, old: str, new: str, sentence: str
) -> None:
    line = (directory / file).read_text().split(old)[0].count("\n") + 1
    assert problems_after(file, (old, new)) == [f"{file}:{line}: {sentence}"]


def test_the_mistakes_of_all_files_come_at_once(directory: Path, problems_after: Callable[..., list[str]]) -> None:
    for file, old, new in ((BOX, "kind: io", "kind: oi"), (DRIVE, "watchdog_ms: 20", "watchdog_ms: 0")):
        path = directory / file
        path.write_text(path.read_text().replace(old, new))
    problems = problems_after(
        ARM, ("drive_mode: csp", "drive_mode: off"), ("velocity: 0.5", "velocity: fast"),
        (USER, USER.replace("0.42", "2").replace("1.1", "3")), ("{output: 4", "{output: 1"),
    )  # fmt: skip
    keys = ["drive_mode", "joints[0].velocity", "cartesian.keep_out[0]", "gripper.output", "kind", "watchdog_ms"]
    assert [problem.split(": ")[1] for problem in problems] == keys


def test_the_error_reads_as_its_sentences_line_by_line(directory: Path) -> None:
    Path(ARM).write_text("drive_mode: csp\n")
    with pytest.raises(ConfigError) as caught:
        load(Path(ARM))
    assert str(caught.value).splitlines() == caught.value.problems
    assert [re.findall("the key [a-z]+", problem)[0] for problem in caught.value.problems] == [
        "the key name", "the key slaves", "the key joints",
    ]  # fmt: skip


def test_there_is_room_for_ten_axes(directory: Path, problems_after: Callable[..., list[str]]) -> None:
    def joint(name: str) -> str:
        return "\n  - " + FINGER.replace("finger", name).replace("drive7", name)

    more = "".join(joint(f"more{i}") for i in range(4))
    slaves = "".join(
        f"  - {{name: {name}, device: cubemars-orh}}\n" for name in ("drive7", *(f"more{i}" for i in range(5)))
    )
    text = Path(ARM).read_text().replace(GEOMETRY, "\n").replace(SIXTH, SIXTH + slaves)
    text = text.replace("    cst_integral: 250\n", f"    cst_integral: 250{more}\n")
    Path(ARM).write_text(text.split("\nhome:")[0] + "\njog:" + text.split("\njog:")[1])
    assert len(load(Path(ARM)).axes) == 10
    (problem,) = problems_after(ARM, (ON_AN_OUTPUT, DRIVEN))
    assert problem.endswith("gripper.joint: found beside 10 joints, allowed are 10 in all")
    (problem,) = problems_after(ARM, (DRIVEN, ON_AN_OUTPUT), (more, more + joint("more4")))
    assert problem.endswith("joints: found a list of 11, allowed is a list of 0 to 10 entries")


HOME = "home: [0, 0.3, pi/2, 0, 0.5, 0]"


def test_an_arm_of_another_number_of_joints_has_no_kinematics(problems_after: Callable[..., list[str]]) -> None:
    sixth = "  - name: joint6\n" + Path(ARM).read_text().split("  - name: joint6\n")[1].split("\n\n")[0]
    (problem,) = problems_after(ARM, (sixth, ""), (HOME, ""), reader=load_kinematics)
    assert problem.endswith("kinematics: found beside 5 joints, allowed are 6; leave it out for such an arm")


# -- any value anywhere ------------------------------------------------------------------------------------------------


def places(node: object, where: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Every place in a file, of lists the first entry alone: the others are checked alike."""
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
        for value in (None, -1, 1e300, "x", "pi", True, [], [1, 2, 3], {"a": 1}, [{"min": []}]):
            node: Any = copy.deepcopy(shipped)
            known[file] = node
            for key in where[:-1]:
                node = node[key]
            node[where[-1]] = value
            problems = problems_of(load_kinematics if file == IRB else load, IRB if file == IRB else ARM)
            assert all(re.match(r"[\w/.-]+:\d+: ", sentence) for sentence in problems)


def without(file: Path, channels: tuple[str, ...]) -> None:
    """Take the channels of these names out of a device file."""
    lines = file.read_text().splitlines()
    file.write_text("".join(f"{line}\n" for line in lines if not any(f"name: {one}," in line for one in channels)))


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
    directory: Path, problems_after: Callable[..., list[str]], mode: str, lacking: tuple[str, ...]
) -> None:
    without(directory / DRIVE, lacking)
    problems = problems_after(ARM, ("drive_mode: csp", f"drive_mode: {mode}"))
    assert len(problems) == 6
    assert all(f"maps no {', '.join(lacking)}, which drive_mode {mode} needs" in problem for problem in problems)


def test_a_box_needs_no_counter(directory: Path) -> None:
    box = directory / BOX
    box.write_text("".join(f"{line}\n" for line in box.read_text().splitlines() if "name: counter" not in line))
    assert load(directory / ARM).slaves[0].device.tpdo[0].channels[0].name == "inputs"
