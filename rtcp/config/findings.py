"""Mistakes in files: place, code and fields for programs, and the sentence for people, which is made here alone."""

from __future__ import annotations

import copy
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Any

KeyPath = tuple[str | int, ...]
"""Keys and list positions from the top of a file to a value."""

_SENTENCES = {
    # files
    "no_file": "there is no such file",
    "no_regular_file": "this is {found}; a regular file is expected",
    "unreadable": "the file cannot be read: {reason}",
    "unwritable": "the {what} cannot be {done}: {reason}",
    "empty_file": "the file is empty; {need} expected",
    "not_utf8": "this is not a text file: byte {byte} is {found:#04x}, which is not UTF-8",
    "control_character": "this is not a text file: it holds the control character {found:#04x}",
    "not_yaml": "this is not valid YAML: {reason}",
    "no_mapping": "the file holds {found}; a mapping of keys to values (`key: value`) is expected",
    "too_large": "the file holds more than {limit} {what}, the limit of a configuration{hint}",
    "too_deep": "the lists and mappings are nested too deeply",
    "tag": "the tag {found} is not allowed; write a plain value",
    "endless_alias": "this alias contains itself",
    "key_no_text": "found the key {found} in line {at}; a key must be a text",
    "key_twice": "this key occurs twice, in lines {first} and {at}; keep one of them",
    "half_character": "this text holds U+{found:04X}, half of a character",
    "long_number": "this number has {found} digits; the limit is {limit}",
    # any value
    "missing": "the key {key} is missing; {need}",
    "unknown": "this {what} does not exist; {hint}allowed are {allowed}",
    "renamed": "this key is now called {new}; rename it",
    "size": "found a list of {found}, allowed is {allowed}",
    "repeated": "found {found!v}, the {what} of {of}; each needs its own",
    "out_of_order": "found min {min:g} and max {max:g}{of}; min must be less than max",
    "outside": "found {found:g}, allowed is {low:g} to {high:g}, {of}",
    "below": "found {found:g}, allowed is at least {low:g}, {of}",
    "not_more": "found {found:g}, allowed is more than {low:g}, {of}",
    "above": "found {found:g}, allowed is at most {high:g}, {of}",
    "zero": "found 0, allowed is any number but 0",
    "count": "found {found} numbers, allowed are {allowed}, {of}",
    "one_of_keys": "found {found}, allowed is one of {allowed}",
    "one_of_both": "found {found}, allowed is {allowed}",
    "names_no_file": "found {found!v}, but there is no file {file}",
    "implausible": "found {found:g} {unit}, plausible is at most {high:.4g} {unit}: if this is in {likely}, write "
    "{instead:.6g}; if it is right, write {{value: {found:g}, unusual: true}}",
    "never_unusual": "this value is marked as unusual, but the key has no limit of what is usual; "
    "write the value alone",
    "no_value": "this key has no value yet; {need}{where_from}",
    # devices
    "bool_scaled": "found {found:g} with the type bool, allowed is none: it is 0 or 1; leave it out",
    "modulo_of_type": "found {found} with the type {type}, allowed is an integer type",
    "position_wraps": "found with {channel}; a drive whose position wraps within the range of its joint is not "
    "supported: leave it out, and set 0x607B in the drive so that it does not wrap there",
    "bits_fixed": "found {found}, but the type {type} has {bits} bits; leave it out, or write the type bits or bytes",
    "only_for_bytes": "found with the type {type}, allowed is the type bytes",
    "output_and_input": "found {found!v}, an output's name too; each channel of the device needs its own",
    "no_sync0": "found {found:#06x}, allowed is 0 for no distributed clocks, or a word that activates SYNC0, as 0x0300 "
    "or 0x0700",
    "without_coe": "found {found} entries, but the device has no CoE (coe: false); leave them out",
    "some_sync_managers": "found it in some PDOs of the {image} only; give it for all of them, or for none",
    "shared_sync_manager": "found {found}, a sync manager of the rpdo; each carries one direction",
    "one_direction": "found no channels{of}; an axis needs some in both directions",
    "no_csp": "found no channel named modes_of_operation{of}; without it the start-up SDO {{index: {index:#x}, "
    "sub_index: 0, type: int8, value: {value}}} (CSP) must be in sdo",
    "mode_not_shown": "found no channel named modes_of_operation_display{of} beside modes_of_operation in rpdo: it is "
    "unknown in which mode the drive is; map it (0x6061), or let the drive stay in CSP by the start-up SDO "
    "{{index: {index:#x}, sub_index: 0, type: int8, value: {value}}} in sdo",
    "scaling_of_kind": "found with kind {kind}, allowed is kind cia402",
    "axes_with_gap": "found channels of axis {axes}; axes are counted from 1, without a gap",
    "several_axes": "found channels of {axes} axes, allowed is kind cia402 for a device with several",
    "safe_zero": "found 0 for {channel} ({bound}), which the drive is always sent: enabled it would have no torque, or "
    "no motion; allowed is any other value, and with coe: true none, for the value that the drive holds itself",
    "unlike": "found {found:.10g} for {channel}, and {first:.10g} for {of}; all {alike}",
    "unlike_scaling": "found {found:.10g}, but from scaling follows {scaled:.10g}: leave it out",
    "two_torques": "found beside rated_current, allowed is one of them: what torques are thousandths of",
    "index_of_other": "found {found:#06x}, one of the objects of a {other} ({low:#x} to {high:#x}); allowed is one of "
    "a {image}",
    "repeated_index": "found {found:#06x}, the index of {of}; each needs its own",
    "repeated_channel": "found {found!v} again; each channel of the {image} needs its own",
    "pdos_of_coupler": "found PDOs; a coupler has no process data: leave it out",
    "no_meaning": "found with {channel} in {image} of kind {kind}, where it has no meaning; leave it out",
    "channels_lacking": "kind {kind} needs {lacking}; {there}",
    "type_of_channel": "found {found} for {channel}, allowed is {allowed}",
    # arms
    "other_gripper": "this key belongs to a gripper {of}, not to one {found}",
    "ends_alike": "found {found:g}, the open_position; the two must differ",
    "name_of_part": "found {found!v}, the name of a part of the platform",
    "too_many_axes": "found beside {joints} joints, allowed are {allowed}",
    "never_trips": "found {found:g}, allowed is less than {high:.4g}: {of}, so no measured torque would exceed the "
    "threshold",
    "cut_wire": "found {found:g}: a cut wire reads 0, which would be an inclination; allowed is 0, or more than "
    "{low:.4g} on either side",
    "limit_key": "found {found!v}, which in the key of a limit means {means}",
    "needs": "found {found!v}, which needs {need}: the key {key} is missing",
    "no_slave": "found {found!v}, which is no slave; allowed are the names under slaves: {allowed}",
    "moves_no_joint": "found {found!v}, which moves no joint: its device {device} is of kind {kind}; allowed is kind "
    "cia402",
    "axis_not_mapped": "its device {device} maps no {lacking}, which an external axis with modes {modes} needs",
    "home_without_ends": "found position and homing without a range, allowed with both is a range: give position",
    "not_mapped": "its device {device} maps no {lacking}, which drive_mode {drive_mode} needs",
    "no_offset": "its device {device} maps no {lacking}, which feed_forward needs",
    "no_box_at_all": "found {kind} {found}, but no slave is of kind io; leave it out for such an arm",
    "no_box": "found {found!v}, which is no IO box; allowed is {allowed}",
    "above_drive": "found {found:g} rad/s, but the drive turns the joint with at most {high:.4g} rad/s: "
    "max_motor_speed of {device} is {rpm:g} rpm; lower it, or if it is right write {{value: {found:g}, unusual: true}}",
    "beyond_wire": "found {sign}{found:g}, allowed is {low:g} to {high:g}: {of}",
    "tool_and_tools": "found beside tools: move it into the list, as its first",
    "mass_without_links": "found {found:g} beside links of unknown mass: it needs the key links",
    "no_direction": "found (0, 0, 0), allowed is a direction along the axes of the base, as [0, 0, 1]",
    "box_needs": "found a box or a cone, which needs {need}: the key {key} is missing",
    "box_out_of_reach": "found a box that begins {found:.3f} m from the shoulder, allowed is at most {high:.3f} m, the "
    "arm's reach: {what}",
    "box_around_base": "found a box around the arm's base, allowed is one beside it: the base is at (0, 0, 0), the "
    "shoulder at ({shoulder})",
    "box_around_box": "found a box around all of cartesian.box: the tool has no place left",
    "no_device": "found {found!v}, but there is no file {file}; {there}",
    "one_controller": "found the bus {found}, allowed is {need}: the arms are of one controller",
    "board_of_first": "found bus.board {found}, allowed is none: {first}, whose platform holds the connection, has the "
    "board",
    "wrong_group": "{file} has {has}",
    # zero offsets
    "no_axis": "this is no axis of {of}; its axes are {allowed}",
    "checksum": "found {found}, allowed is {allowed}: the file is damaged, or was edited; if its offsets are right "
    "write {allowed}",
    "offset_beyond_wire": "found {found:g}, with which the drive of {joint} cannot be sent its range: {reach}, allowed "
    "is {low:g} to {high:g}, the range of target_position of {device}",
    # buses and processes
    "bus_without_slaves": "a bus of kind {bus} has no slaves: leave it out",
    "bus_without_torque": "{lack}: leave it out",
    "torque_on_bus": "found {found!v} on a bus of kind {bus}: {lack}",
    "torque_off_on_bus": "found {found!v} on a bus of kind {bus}, which cannot switch motors off; allowed are the "
    "others",
    "drive_on_bus": "found a drive on a bus of kind {bus}: it has those of the arm alone",
    "joints_of_egm": "found {found} joints, allowed by EGM are 6, or 7 with the external one third",
    "period_of_egm": "found {found:g} us, allowed by EGM is {period_us:g} or a multiple: what \\SampleRate sets",
    "kind_twice": "found {found!v}, the kind of {of}; allowed is one of a kind",
    "channel_of_both": "found {found!v}, a channel that {of} both sends and receives: rename one of them",
    "channel_of_box": "found {found!v}, of an IO box: its terminals are those of `inputs` and `outputs`",
    "channel_written": "found {found!v}, which {of} writes already: allowed is a channel each",
    "no_channel": "found {found!v}, allowed are the channels in `{image}` of {of}: {allowed}",
    # segments
    "key_of_esi": "only a slave of an ESI file has this key",
    "behaviour_of_model": "a model has its own behaviour; only a slave of esi or sii has this key",
    "no_slave_before": "found {found}, allowed is {allowed}",
    # motion files
    "needs_beside": "{found} needs {need} beside it",
    "pose_or_q": "found {found} of pose and q; one of them is needed",
    "via_beside": "found via beside it, allowed is one of them",
    "beside": "found beside {found}, allowed beside {allowed}",
    "name_twice": 'found "{found}" twice, allowed is once',
    "no_name": 'found "{found}", allowed is one of {allowed}',
    "via_has_q": 'found "{found}", which has q; with several tools allowed is one with pose',
    "circle": 'the part "{found}" runs itself; parts may only run others',
    "too_many_steps": "found {found} steps with those of all parts, a part that repeats counted twice; allowed are "
    "{allowed}",
    "motion_before_tool": "a step chooses a tool, found a motion before the first choice; allowed is a tool before all "
    "motions",
    "no_motion": "none of trajectory, path, program and poses has entries; one of them is needed",
    "several_motions": "a file holds one of trajectory, path and program, found {found}",
    "parts_alone": "found without program, allowed beside it",
    "poses_beside": "found beside a trajectory or a path, allowed is a program",
    "speed_of_trajectory": "a speed is for a path; a trajectory's follows from its times",
    "no_step": "found step {found}, allowed is {allowed}",
    "times_fall": "found {found:g} after {before:g}; times must rise",
    "all_or_none": "{key} must be given for all points or for none",
    "ending": 'the ending "{found}" selects no form; allowed are .yaml, .yml and .csv',
    "header": "found the header {found}, allowed is t,q1,..,q6 (and v1,..,v6 and a1,..,a6) or x,y,z,rx,ry,rz (and "
    "speed)",
    "too_many_rows": "the file has {found} rows, at most {limit} are allowed",
    "no_rows": "the file has a header and no rows",
    "columns": "found {found} columns, the header has {allowed}",
    "no_number": "found the text {found}, allowed is a number",
}
"""Code -> sentence, a format string of the fields; `!v`: a value as `shown`."""
_FOUND = "found {found!v}{unit}, allowed is {allowed}{hint}"
"""Sentence of the other codes, unless they have a `text`."""


class Finding:
    """A mistake: the keys that lead to it, its code, its fields; as a text its sentence, the place in front."""

    def __init__(self, where: KeyPath, code: str, **fields: object) -> None:
        """Make a finding; a code without a sentence needs the fields `text`, or `found` and `allowed`."""
        self.where = where
        self.code = code
        self.fields = fields
        self.file: Path | None = None
        self.line: int | None = None
        self.column: int | None = None
        self.context = ""
        """Text before the place: the arm of a cell that a file belongs to."""

    def below(self, *keys: str | int) -> Finding:
        """Return the finding with these keys before its own."""
        return self._with(where=(*keys, *self.where))

    def at(self, file: Path, line: int | None = None, column: int | None = None) -> Finding:
        """Return the finding with its place."""
        return self._with(file=file, line=line, column=column)

    def within(self, context: str) -> Finding:
        """Return the finding with a text before its place."""
        return self._with(context=context)

    def _with(self, **changes: object) -> Finding:
        changed = copy.copy(self)
        vars(changed).update(changes)
        return changed

    @property
    def key(self) -> str:
        """The path of its key, as people write it."""
        return dotted(self.where)

    @property
    def text(self) -> str:
        """The sentence, without the place."""
        template = "{text}" if "text" in self.fields else _SENTENCES.get(self.code, _FOUND)
        return _Sentence().vformat(template, (), {"hint": "", "of": "", "unit": "", **self.fields})

    def __str__(self) -> str:
        """Return `file:line: key: text`."""
        place = ":".join(str(part) for part in (self.file, self.line, self.column) if part is not None)
        return self.context + "".join(f"{part}: " for part in (place, self.key) if part) + self.text


class _Sentence(string.Formatter):
    def convert_field(self, value: Any, conversion: Any) -> Any:
        return shown(value) if conversion == "v" else super().convert_field(value, conversion)

    def format_field(self, value: Any, format_spec: str) -> Any:
        if isinstance(value, Sequence) and not isinstance(value, str):
            return ", ".join(map(str, value))
        return super().format_field(value, format_spec)


def dotted(where: KeyPath) -> str:
    """Return a key path as people write it: `joints[2].velocity`."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in where).removeprefix(".")


def shown(value: object) -> str:
    """Return a value in words for a sentence."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return "nothing"
    if isinstance(value, str):
        return f'the text "{value if len(value) <= 60 else value[:57] + "..."}"'
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "an empty list" if not value else "a list"
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)
