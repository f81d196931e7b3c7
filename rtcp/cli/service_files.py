"""The files that make a service of the platform: where each belongs, and which of them are still as they were written.

Each begins with a line that names it as ours and holds a digest of the rest. A file that another wrote, or that was
edited, is nobody's to replace or to remove but its owner's.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

UNIT = "rtcp@.service"
PLACES = {
    UNIT: "etc/systemd/system/rtcp@.service",
    "rtcp.sysusers.conf": "etc/sysusers.d/rtcp.conf",
    "rtcp.tmpfiles.conf": "etc/tmpfiles.d/rtcp.conf",
    "rtcp.sysctl.conf": "etc/sysctl.d/80-rtcp.conf",
}
"""Our file -> where the host's owner keeps such files, below the root."""
_PROGRAM = "ExecStart=/usr/bin/rtcp "
_MARK = "# Written by `rtcp service install`, sha256 "
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""What `ProtectHome` and `PrivateTmp` in the unit take out of the service's sight."""


class Found(Enum):
    """What lies where a file of ours belongs."""

    NOTHING = "nothing"
    AS_WRITTEN = "as it is to be"
    EARLIER = "of another version"
    FOREIGN = "edited, or not of `rtcp service install`"


@dataclass(frozen=True)
class ServiceFile:
    """A file of the service: where it belongs and its whole text."""

    path: Path
    text: str

    def found(self) -> Found:
        """Return what lies there now.

        Raises:
            OSError: it cannot be read.
        """
        if not os.path.lexists(self.path):
            return Found.NOTHING
        there = self.path.read_text(errors="replace")
        if there == self.text:
            return Found.AS_WRITTEN
        first, _, rest = there.partition("\n")
        return Found.EARLIER if first == _mark(rest) else Found.FOREIGN

    def write(self) -> None:
        """Write it, whole or not at all."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.write_text(self.text)
        fresh.chmod(0o644)
        fresh.replace(self.path)

    def may_be_changed(self) -> bool:
        """Whether its folder, or the nearest one above it that there is, may be written to."""
        folder = next(folder for folder in self.path.parents if folder.exists())
        return os.access(folder, os.W_OK | os.X_OK)


def service_files(root: Path, program: Path) -> list[ServiceFile]:
    """Return the files of the service below `root`; the unit starts `program`."""
    return list(_made(root, program))


def hidden_by_the_unit(program: Path) -> str:
    """Return the folder that the service will not see and that `program`, or its interpreter, lies in; else nothing."""
    seen = [str(program), os.path.realpath(program), *_interpreter(program)]
    return next((folder for folder in _HIDDEN if any(path.startswith(f"{folder}/") for path in seen)), "")


def left_behind(root: Path) -> list[Path]:
    """Return what belongs to the service and was not written by `install`: instances, changes, configuration, state."""
    units = root / "etc/systemd/system"
    enabled = sorted(units.glob("*.wants/rtcp@*.service"))
    changes = sorted(units.glob("rtcp@*.service.d"))
    kept = [root / "etc/rtcp", root / "var/lib/rtcp", root / "run/rtcp"]
    return [*enabled, *changes, *(path for path in kept if path.exists())]


def _made(root: Path, program: Path) -> Iterator[ServiceFile]:
    folder = _folder()
    for name, place in PLACES.items():
        text = (folder / name).read_text()
        if name == UNIT:
            text = text.replace(_PROGRAM, f"ExecStart={_quoted(program)} ")
        yield ServiceFile(root / place, f"{_mark(text)}\n{text}")


def _folder() -> Path:
    """Return the folder of the files as they are shipped: in a wheel inside the package, in a checkout beside it."""
    package = Path(__file__).resolve().parent.parent
    shipped = package / "cli" / "systemd"
    return shipped if shipped.is_dir() else package.parent / "systemd"


def _mark(text: str) -> str:
    return f"{_MARK}{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _quoted(program: Path) -> str:
    """Return a path as a command line of a unit has it (systemd.service(5))."""
    text = str(program).replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{text}"' if any(letter.isspace() or letter in "\"'\\" for letter in text) else text


def _interpreter(program: Path) -> list[str]:
    """Return the interpreter that a script names in its first line, and what that one is a link to."""
    try:
        with open(program, "rb") as script:
            first = script.readline(512)
    except OSError:
        return []
    if not first.startswith(b"#!"):
        return []
    named = os.fsdecode(first[2:].strip()).split(" ")[0]
    return [named, os.path.realpath(named)]
