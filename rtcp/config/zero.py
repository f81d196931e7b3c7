"""The zero offsets of the axes in a file: read and checked whole at the start, replaced as a whole or not at all.

An offset is what an axis' drive shows, rad, where the axis is at 0. Absolute encoders keep it: it is measured once.
"""

from __future__ import annotations

import fcntl
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtcp.config.document import Document, Finding, read, shown
from rtcp.config.model import ArmConfig, ConfigError

LARGEST = 100.0
"""rad; a larger offset was written in degrees."""

_KEYS = ("arm", "check", "offsets")


def state_directory() -> Path:
    """Return the directory of what outlives a restart, without making it.

    `RTCP_STATE_DIR` chooses it; else `/var/lib/rtcp` for root, `$XDG_STATE_HOME/rtcp` or `~/.local/state/rtcp` for
    anyone else; in it one for each platform with a name (`RTCP_NAME`).
    """
    return _unnamed() / os.environ.get("RTCP_NAME", "")


def _unnamed() -> Path:
    if chosen := os.environ.get("RTCP_STATE_DIR"):
        return Path(chosen)
    if os.geteuid() == 0:
        return Path("/var/lib/rtcp")
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    # The XDG specification: a relative path there is invalid and counts as none.
    return (home if home.is_absolute() else Path.home() / ".local" / "state") / "rtcp"


def zero_file(arm: str) -> Path:
    """Return the file of an arm's offsets; what a file name cannot hold of the arm's name is written as %XX."""
    return state_directory() / (re.sub(r"[^\w.-]", lambda found: f"%{ord(found[0]):02X}", arm) + ".zero.yaml")


def read_zeros(config: ArmConfig) -> tuple[float, ...]:
    """Return the offset of each of `config.axes`, rad; nothing where there is no file, which means 0 for all.

    Raises:
        ConfigError: the file is damaged, is another arm's, or does not suit this arm's axes; nothing of it is used.
    """
    path = zero_file(config.name)
    if not os.path.lexists(path):
        return ()
    document = read(path)
    if findings := _findings(document, config):
        raise ConfigError(document.sentences(findings))
    data: Any = document.data
    return tuple(float(data["offsets"][axis.name]) for axis in config.axes)


def store_zero(config: ArmConfig, axis: int, offset: float) -> Path:
    """Store the offset (rad) of the axis of this place in `config.axes`, keep the others', and return the file.

    Whatever interrupts it, the file is the old or the new one: it is written beside, forced to the disk, renamed, and
    the directory forced to the disk. A lock on the directory keeps two writers apart.

    Raises:
        ConfigError: the offset is none or beyond what the drive's process data reach, the file in place is damaged, or
            the disk refuses.
    """
    name = config.axes[axis].name
    if lacking := _wrong(config, axis, offset):
        raise ConfigError([f"{zero_file(config.name)}: offsets.{name}: {lacking}"])
    path = zero_file(config.name)
    try:
        path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise ConfigError([f"{path.parent}: the directory cannot be used: {error.strerror}"]) from error
    try:
        fcntl.flock(directory, fcntl.LOCK_EX)
        offsets = list(read_zeros(config) or (0.0,) * len(config.axes))
        offsets[axis] = offset
        _replace(path, directory, _text(config, offsets))
    except OSError as error:
        raise ConfigError([f"{path}: the file cannot be written: {error.strerror}"]) from error
    finally:
        os.close(directory)
    return path


def _replace(path: Path, directory: int, text: str) -> None:
    new = path.with_name(f".{path.name}.new")
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    try:
        content = text.encode()
        while content:
            content = content[os.write(descriptor, content) :]
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    os.replace(new, path)
    # Else a loss of power could bring the old name back.
    os.fsync(directory)


def _text(config: ArmConfig, offsets: list[float]) -> str:
    by_name = {axis.name: offset for axis, offset in zip(config.axes, offsets, strict=True)}
    lines = [f"  {_quoted(name)}: {offset!r}" for name, offset in by_name.items()]
    return "\n".join([
        "# Zero offsets, rad: what each drive shows where its axis is at 0. Written by rtcp, checked at its start.",
        f"arm: {_quoted(config.name)}",
        f"check: {_check(config.name, by_name)}",
        "offsets:",
        *lines,
        "",
    ])  # fmt: skip


def _quoted(text: str) -> str:
    """Return a text as YAML's double quotes hold it."""
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'


def _check(arm: str, offsets: Mapping[str, float]) -> int:
    """Return the CRC-32 of what the file says: it tells a changed digit, which no rule could."""
    said = "\n".join([arm, *(f"{name}={float(offset)!r}" for name, offset in sorted(offsets.items()))])
    return zlib.crc32(said.encode("utf-8", "surrogatepass"))


def _findings(document: Document, config: ArmConfig) -> list[Finding]:
    data, known = document.data, ", ".join(_KEYS)
    findings: list[Finding] = [
        ((), f"the key {key} is missing; there must be {known}") for key in _KEYS if key not in data
    ]
    findings += [((key,), f"this key does not exist; allowed are {known}") for key in data if key not in _KEYS]
    if data.get("arm", config.name) != config.name:
        findings.append((("arm",), f'found {data["arm"]!r}, allowed is "{config.name}", the name of this arm'))
    offsets = data.get("offsets", {})
    if not isinstance(offsets, dict):
        return [*findings, (("offsets",), "found no mapping, allowed is a number for each axis")]
    names = [axis.name for axis in config.axes]
    for name in offsets.keys() - set(names):
        finding = f"this is no axis of {config.name}; its axes are {', '.join(names)}"
        findings.append((("offsets", name), finding))
    for i, name in enumerate(names):
        if "offsets" in data and name not in offsets:
            findings.append((("offsets",), f"the key {name} is missing: each axis of {config.name} has its offset"))
        elif name in offsets and (finding := _wrong(config, i, offsets[name])):
            findings.append((("offsets", name), finding))
    if not findings and data["check"] != (right := _check(config.name, offsets)):
        finding = f"found {data['check']}, allowed is {right}: the file is damaged, or was edited"
        findings.append((("check",), f"{finding}; if its offsets are right write {right}"))
    return findings


def _wrong(config: ArmConfig, axis: int, offset: object) -> str:
    """Return what is wrong with the offset of an axis; empty where nothing is."""
    if isinstance(offset, bool) or not isinstance(offset, int | float) or not abs(offset) <= LARGEST:
        return f"found {shown(offset)}, allowed is a number from {-LARGEST:g} to {LARGEST:g} (rad)"
    joint = config.axes[axis]
    device = next(slave.device for slave in config.slaves if slave.name == joint.slave).of_axis(joint.axis)
    low, high = device.wire_range("target_position")
    ends = (joint.position.min + offset, joint.position.max + offset)
    if all(low <= end <= high for end in ends):
        return ""
    reach = f"position {joint.position.min:g} to {joint.position.max:g} would be {ends[0]:g} to {ends[1]:g} there"
    finding = f"found {offset:g}, with which the drive of {joint.name} cannot be sent its range: {reach}"
    return f"{finding}, allowed is {low:g} to {high:g}, the range of target_position of {device.name}"
