"""`rtcp service`: install the platform as a systemd service, one instance for each bus.

Only files are written and removed. Each begins with a line that holds a digest of the rest: a file that was edited, or
that somebody else wrote, is neither replaced nor removed.
"""

from __future__ import annotations

import hashlib
import os
import sys
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, ExitCode, emit

UNIT = "rtcp@.service"
PLACES = {
    UNIT: "etc/systemd/system/rtcp@.service",
    "rtcp-panel@.service": "etc/systemd/system/rtcp-panel@.service",
    "rtcp.sysusers.conf": "etc/sysusers.d/rtcp.conf",
    "rtcp.tmpfiles.conf": "etc/tmpfiles.d/rtcp.conf",
    "rtcp.sysctl.conf": "etc/sysctl.d/80-rtcp.conf",
}
"""File in the package -> where the administrator's files belong, below the root."""
_PROGRAM = "ExecStart=/usr/bin/rtcp "
_MARK = "# Written by `rtcp service install`, sha256 "
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders that `ProtectHome` and `PrivateTmp` of the unit hide from the service."""
_NEXT = """\
nothing has been started. Next, as root:
  systemd-sysusers && systemd-tmpfiles --create rtcp.conf && sysctl --system
  systemctl daemon-reload
  systemctl start rtcp@eth0    (or rtcp@virtual; `enable` instead of `start`: at every boot, drives disabled)"""

Root = Annotated[Path, option("--root", "DIR", "Root of the file system: for packages and images.")]
DryRun = Annotated[bool, option("--dry-run", "Show what would be done; change nothing.")]

HELP = "Run the platform under systemd: rtcp@eth0, rtcp@virtual."
commands = typer.Typer(name="service", help=HELP, no_args_is_help=True)


class FileState(Enum):
    """State of the path of a service file."""

    NOTHING = "nothing"
    CURRENT = "up to date"
    EARLIER = "of another version"
    FOREIGN = "edited, or not written by `rtcp service install`"


@dataclass(frozen=True)
class ServiceFile:
    """A file of the service: its path and its whole text."""

    path: Path
    text: str

    def state(self) -> FileState:
        """Compare with the file that exists; raises CommandError where it cannot be read."""
        if not os.path.lexists(self.path):
            return FileState.NOTHING
        try:
            existing = self.path.read_text(errors="replace")
        except OSError as error:
            raise CommandError(f"{self.path} cannot be read: {error.strerror}", ExitCode.REFUSED) from error
        if existing == self.text:
            return FileState.CURRENT
        first, _, rest = existing.partition("\n")
        return FileState.EARLIER if first == _mark(rest) else FileState.FOREIGN

    def write(self) -> None:
        """Write the file atomically."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(f".{self.path.name}.new")
        fresh.write_text(self.text)
        fresh.chmod(0o644)
        fresh.replace(self.path)

    def is_writable(self) -> bool:
        """Whether its folder, or the nearest one above that exists, can be written to."""
        folder = next(folder for folder in self.path.parents if folder.exists())
        return os.access(folder, os.W_OK | os.X_OK)


def service_files(root: Path, program: Path) -> list[ServiceFile]:
    """Return the files of the service below `root`; the unit starts `program`."""
    package = Path(__file__).resolve().parent
    shipped = package / "systemd"  # in a wheel; a checkout has the folder at its top
    folder = shipped if shipped.is_dir() else package.parents[1] / "systemd"
    files = []
    for name, place in PLACES.items():
        text = (folder / name).read_text()
        if name.endswith(".service"):
            text = text.replace(_PROGRAM, f"ExecStart={_quoted(program)} ")
        files.append(ServiceFile(root / place, f"{_mark(text)}\n{text}"))
    return files


@commands.command("install")
def _install(
    root: Root = Path("/"),
    program: Annotated[Path | None, option("--program", "FILE", "The rtcp to start. Default: the running one.")] = None,
    dry_run: DryRun = False,
) -> None:
    """Write the units of platform and panel, sysusers, tmpfiles and sysctl files; start and enable nothing."""
    files = service_files(root.absolute(), _checked(program))
    states = {file: file.state() for file in files}
    foreign = [str(file.path) for file in files if states[file] is FileState.FOREIGN]
    if foreign:
        raise CommandError(
            f"{', '.join(foreign)}: {FileState.FOREIGN.value}; nothing was written. Move it away, and keep changes in "
            "a drop-in (`systemctl edit rtcp@.service`)",
            ExitCode.REFUSED,
        )
    outdated = [file for file in files if states[file] is not FileState.CURRENT]
    if not dry_run:
        _require_rights(outdated)
    for file in files:
        if file not in outdated:
            emit(f"{file.path}: {FileState.CURRENT.value}")
        elif dry_run:
            emit(f"would write {file.path}:\n{file.text}")
        else:
            _change(file, remove=False)
            emit(f"wrote {file.path}")
    if not dry_run:
        emit(_NEXT)


@commands.command("uninstall")
def _uninstall(root: Root = Path("/"), dry_run: DryRun = False) -> None:
    """Remove what `install` wrote and nobody edited; list what stays."""
    root = root.absolute()
    files = service_files(root, _default_program())
    states = {file: file.state() for file in files}
    ours = [file for file in files if states[file] in (FileState.CURRENT, FileState.EARLIER)]
    if not dry_run:
        _require_rights(ours)
    for file in ours:
        if not dry_run:
            _change(file, remove=True)
        emit(f"{'would remove' if dry_run else 'removed'} {file.path}")
    if not ours:
        emit("no file of `rtcp service install` exists")
    for file in files:
        if states[file] is FileState.FOREIGN:
            emit(f"left {file.path}: {FileState.FOREIGN.value}")
    units = root / "etc/systemd/system"
    own = [*sorted(units.glob("*.wants/rtcp@*.service")), *sorted(units.glob("rtcp@*.service.d"))]
    for path in [*own, *(root / place for place in ("etc/rtcp", "var/lib/rtcp", "run/rtcp"))]:
        if path in own or path.exists():
            emit(f"left {path}")
    if ours and not dry_run:
        emit(
            "left: the user rtcp, and running instances (`systemctl stop 'rtcp@*'`, `systemctl disable rtcp@eth0`); "
            "`systemctl daemon-reload` makes systemd forget the unit"
        )


def _default_program() -> Path:
    return Path(sys.executable).parent / "rtcp"


def _checked(chosen: Path | None) -> Path:
    """Return the program for the unit; raises CommandError where the service could not start it."""
    program = _default_program() if chosen is None else chosen
    if not program.is_absolute():
        raise CommandError(f"--program {program}: systemd needs an absolute path")
    if chosen is None and not os.access(program, os.X_OK):
        raise CommandError(f"there is no program {program}: install the package, or name it with --program")
    paths = [str(program), os.path.realpath(program), *_interpreter(program)]
    if hidden := next((folder for folder in _HIDDEN if any(path.startswith(f"{folder}/") for path in paths)), ""):
        raise CommandError(
            f"{program} or its interpreter is in {hidden}, which the service cannot see: install the package "
            "elsewhere (`/usr/bin/python3 -m venv /opt/rtcp`, then /opt/rtcp/bin/pip install) and use its rtcp, or "
            "name one with --program",
            ExitCode.REFUSED,
        )
    return program


def _interpreter(program: Path) -> list[str]:
    """Return the interpreter in the first line of a script, and the file that it links to."""
    try:
        with open(program, "rb") as script:
            first = script.readline(512)
    except OSError:
        return []
    if not first.startswith(b"#!"):
        return []
    named = os.fsdecode(first[2:].strip()).split(" ")[0]
    return [named, os.path.realpath(named)]


def _require_rights(files: list[ServiceFile]) -> None:
    closed = sorted({str(file.path.parent) for file in files if not file.is_writable()})
    if closed:
        raise CommandError(
            f"{', '.join(closed)} cannot be written to by this user: nothing was changed; run it as root, or choose "
            "another --root",
            ExitCode.REFUSED,
        )


def _change(file: ServiceFile, *, remove: bool) -> None:
    try:
        file.path.unlink() if remove else file.write()
    except OSError as error:
        raise CommandError(f"{file.path} cannot be changed: {error.strerror}", ExitCode.REFUSED) from error


def _mark(text: str) -> str:
    return f"{_MARK}{hashlib.sha256(text.encode()).hexdigest()[:16]}"


def _quoted(program: Path) -> str:
    """Return a path as it is written in the command line of a unit (systemd.service(5))."""
    text = str(program).replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%")
    return f'"{text}"' if any(letter.isspace() or letter in "\"'\\" for letter in text) else text
