"""The zero offsets of the axes in a file: read and checked whole at the start, replaced as a whole or not at all.

An offset is the drive's position, rad, when its axis is at 0. Absolute encoders keep it: it is measured once.
"""

from __future__ import annotations

import fcntl
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rtcp.config.document import Document, read
from rtcp.config.findings import Finding
from rtcp.config.model import ArmConfig, ConfigError, Range

LARGEST = 100.0
"""Largest offset, rad; a larger one is in degrees."""

_KEYS = ("arm", "check", "offsets")


def state_directory() -> Path:
    """Return the directory of persistent state, without creating it.

    `RTCP_STATE_DIR` chooses it; else `/var/lib/rtcp` for root, `$XDG_STATE_HOME/rtcp` or `~/.local/state/rtcp` for
    anyone else; each platform with a name (`RTCP_NAME`) has its own in it.
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
    """Return the file of an arm's offsets; characters of the arm's name that a file name cannot have become %XX."""
    return state_directory() / (re.sub(r"[^\w.-]", lambda match: f"%{ord(match[0]):02X}", arm) + ".zero.yaml")


def read_zeros(config: ArmConfig) -> tuple[float, ...]:
    """Return the offset of each of `config.axes`, rad; empty without a file: 0 for all.

    Raises:
        ConfigError: the file is damaged, is another arm's, or does not suit this arm's axes; nothing of it is used.
    """
    path = zero_file(config.name)
    if not os.path.lexists(path):
        return ()
    document = read(path)
    if findings := _findings(document, config):
        raise ConfigError(document.placed(findings))
    data: Any = document.data
    return tuple(float(data["offsets"][axis.name]) for axis in config.axes)


def store_zero(config: ArmConfig, axis: int, offset: float) -> Path:
    """Store the offset (rad) of the axis of this place in `config.axes`, keep the others', and return the file.

    An interrupted call leaves the old or the new file: a temporary file is written, synced and renamed, then the
    directory is synced. A lock on the directory excludes a second writer.

    Raises:
        ConfigError: the offset is invalid or beyond the range of the drive's process data, the present file is
            damaged, or the file cannot be written.
    """
    if lacking := _wrong(config, axis, offset):
        raise ConfigError([lacking.at(zero_file(config.name))])
    path = zero_file(config.name)
    try:
        path.parent.mkdir(mode=0o755, parents=True, exist_ok=True)
        directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        finding = Finding((), "unwritable", what="directory", done="used", reason=error.strerror)
        raise ConfigError([finding.at(path.parent)]) from error
    try:
        fcntl.flock(directory, fcntl.LOCK_EX)
        offsets = list(read_zeros(config) or (0.0,) * len(config.axes))
        offsets[axis] = offset
        _replace(path, directory, _text(config, offsets))
    except OSError as error:
        finding = Finding((), "unwritable", what="file", done="written", reason=error.strerror)
        raise ConfigError([finding.at(path)]) from error
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
    # Without it a loss of power could restore the old file.
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
    """Return a text in YAML's double quotes."""
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'


def _check(arm: str, offsets: Mapping[str, float]) -> int:
    """Return the CRC-32 of arm and offsets: it detects a changed digit, which no rule can."""
    said = "\n".join([arm, *(f"{name}={float(offset)!r}" for name, offset in sorted(offsets.items()))])
    return zlib.crc32(said.encode("utf-8", "surrogatepass"))


def _findings(document: Document, config: ArmConfig) -> list[Finding]:
    data, need = document.data, f"there must be {', '.join(_KEYS)}"
    findings = [Finding((), "missing", key=key, need=need) for key in _KEYS if key not in data]
    findings += [Finding((key,), "unknown", what="key", found=key, allowed=_KEYS) for key in data if key not in _KEYS]
    if data.get("arm", config.name) != config.name:
        findings.append(
            Finding(("arm",), "other_arm", found=data["arm"], allowed=f'"{config.name}", the name of this arm')
        )
    offsets = data.get("offsets", {})
    if not isinstance(offsets, dict):
        return [*findings, Finding(("offsets",), "type", found=offsets, allowed="a number for each axis")]
    names = [axis.name for axis in config.axes]
    findings += [
        Finding(("offsets", name), "no_axis", of=config.name, allowed=names) for name in offsets.keys() - set(names)
    ]
    for i, name in enumerate(names):
        if "offsets" in data and name not in offsets:
            need = f"each axis of {config.name} has its offset"
            findings.append(Finding(("offsets",), "missing", key=name, need=need))
        elif name in offsets and (finding := _wrong(config, i, offsets[name])):
            findings.append(finding)
    if not findings and data["check"] != (right := _check(config.name, offsets)):
        findings.append(Finding(("check",), "checksum", found=data["check"], allowed=right))
    return findings


def _wrong(config: ArmConfig, axis: int, offset: object) -> Finding | None:
    """Return the mistake of an axis' offset, None if it is valid."""
    joint = config.axes[axis]
    where = ("offsets", joint.name)
    if isinstance(offset, bool) or not isinstance(offset, int | float) or not abs(offset) <= LARGEST:
        wanted = f"a number from {-LARGEST:g} to {LARGEST:g} ({config.unit_of(axis)})"
        return Finding(where, "range", found=offset, allowed=wanted)
    device = next(slave.device for slave in config.slaves if slave.name == joint.slave).of_axis(joint.axis)
    ranges = [device.wire_range(name) for name in ("target_position", "position")]
    low, high = max(low for low, _ in ranges), min(high for _, high in ranges)
    # An axis without ends has no largest position: only where it is now must be one of the drive's.
    endless = any(external.name == joint.name and external.position is None for external in config.external_axes)
    position = Range(0.0, 0.0) if endless else joint.position
    ends = (position.min + offset, position.max + offset)
    if all(low <= end <= high for end in ends):
        return None
    reach = f"position {position.min:g} to {position.max:g} would be {ends[0]:g} to {ends[1]:g} there"
    of = {"joint": joint.name, "reach": reach, "device": device.name}
    return Finding(where, "offset_beyond_wire", found=offset, low=low, high=high, **of)
