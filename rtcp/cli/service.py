"""`rtcp service`: the platform as a systemd service, an instance a bus. It writes and removes files, no more."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import emit
from rtcp.cli.service_files import Found, ServiceFile, hidden_by_the_unit, left_behind, service_files

Root = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Where the host's files are: for packages and images.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Show what would be done; change nothing.")]

_NEXT = """\
nothing has been started. What comes next, as root:
  systemd-sysusers && systemd-tmpfiles --create rtcp.conf && sysctl --system
  systemctl daemon-reload
  systemctl start rtcp@eth0    (or rtcp@virtual; `enable` instead of `start`: at every boot, drives disabled)"""


def register(app: typer.Typer) -> None:
    """Add this group's commands."""
    group = typer.Typer(help="Run the platform under systemd: rtcp@eth0, rtcp@virtual.", no_args_is_help=True)
    group.command("install")(_install)
    group.command("uninstall")(_uninstall)
    app.add_typer(group, name="service")


def _install(
    root: Root = Path("/"),
    program: Annotated[
        Path | None, typer.Option("--program", metavar="FILE", help="The rtcp to start; else the one that runs now.")
    ] = None,
    dry_run: DryRun = False,
) -> None:
    """Write the unit rtcp@.service and its sysusers, tmpfiles and sysctl files; start and enable nothing."""
    files = service_files(root.absolute(), _program(program))
    found = {file: _look(file) for file in files}
    foreign = [str(file.path) for file in files if found[file] is Found.FOREIGN]
    if foreign:
        raise CommandError(
            f"{_listed(foreign)}: edited, or not of `rtcp service install`; nothing was written. Move it away, and "
            "keep changes in a drop-in (`systemctl edit rtcp@.service`)",
            ExitCode.REFUSED,
        )
    wanted = [file for file in files if found[file] is not Found.AS_WRITTEN]
    if not dry_run:
        _require_rights(wanted)
    for file in files:
        if file not in wanted:
            emit(f"{file.path}: as it is to be")
        elif dry_run:
            emit(f"would write {file.path}:\n{file.text}")
        else:
            _change(file, file.write)
            emit(f"wrote {file.path}")
    if not dry_run:
        emit(_NEXT)


def _uninstall(root: Root = Path("/"), dry_run: DryRun = False) -> None:
    """Remove what `install` wrote and nobody edited; name what stays."""
    root = root.absolute()
    files = service_files(root, _program(None, check=False))
    found = {file: _look(file) for file in files}
    ours = [file for file in files if found[file] in (Found.AS_WRITTEN, Found.EARLIER)]
    if not dry_run:
        _require_rights(ours)
    for file in ours:
        if not dry_run:
            _change(file, file.path.unlink)
        emit(f"{'would remove' if dry_run else 'removed'} {file.path}")
    if not ours:
        emit("nothing of `rtcp service install` is here")
    for file in files:
        if found[file] is Found.FOREIGN:
            emit(f"left {file.path}: {Found.FOREIGN.value}")
    for path in left_behind(root):
        emit(f"left {path}")
    if ours and not dry_run:
        emit(
            "left: the user rtcp, and instances that run (`systemctl stop 'rtcp@*'`, `systemctl disable rtcp@eth0`); "
            "`systemctl daemon-reload` makes systemd forget the unit"
        )


def _program(given: Path | None, check: bool = True) -> Path:
    program = given if given is not None else Path(sys.executable).parent / "rtcp"
    if not program.is_absolute():
        raise CommandError(f"--program {program}: an absolute path is needed, systemd knows no other")
    if not check:
        return program
    if given is None and not os.access(program, os.X_OK):
        raise CommandError(f"there is no program {program}: install the package, or name it with --program")
    if folder := hidden_by_the_unit(program):
        raise CommandError(
            f"{program} or its interpreter lies in {folder}, which the service does not see: install the package "
            "elsewhere (`/usr/bin/python3 -m venv /opt/rtcp`, then /opt/rtcp/bin/pip install) and use its rtcp, or "
            "name one with --program",
            ExitCode.REFUSED,
        )
    return program


def _look(file: ServiceFile) -> Found:
    try:
        return file.found()
    except OSError as error:
        raise CommandError(f"{file.path} cannot be read: {error.strerror}", ExitCode.REFUSED) from error


def _require_rights(files: list[ServiceFile]) -> None:
    """Refuse before anything is changed."""
    closed = sorted({str(file.path.parent) for file in files if not file.may_be_changed()})
    if closed:
        raise CommandError(
            f"{_listed(closed)} may not be written to by this user: nothing was changed; do it as root, or elsewhere "
            "with --root",
            ExitCode.REFUSED,
        )


def _change(file: ServiceFile, change: Callable[[], None]) -> None:
    try:
        change()
    except OSError as error:
        raise CommandError(f"{file.path} cannot be changed: {error.strerror}", ExitCode.REFUSED) from error


def _listed(names: list[str]) -> str:
    return ", ".join(names)
