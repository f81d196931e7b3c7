"""`rtcp service install` and `uninstall` in a root of their own, and what systemd's own tools say of the files."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

UNIT = "etc/systemd/system/rtcp@.service"
PANEL_UNIT = "etc/systemd/system/rtcp-panel@.service"
PLACES = {UNIT, PANEL_UNIT, "etc/sysusers.d/rtcp.conf", "etc/tmpfiles.d/rtcp.conf", "etc/sysctl.d/80-rtcp.conf"}
PROGRAM = "/usr/bin/env"
"""A program in place of rtcp: systemd-analyze requires one that exists."""
EXPOSURE = 2.7
"""Upper bound of the exposure level, of 10; systemd 252 computes 2.5."""


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def install(rtcp: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """`rtcp service install` below tmp_path."""

    def run(*more: str) -> Any:
        return rtcp("service", "install", "--root", str(tmp_path), "--program", PROGRAM, *more)

    return run


@pytest.fixture
def uninstall(rtcp: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """`rtcp service uninstall` below tmp_path."""
    return lambda *more: rtcp("service", "uninstall", "--root", str(tmp_path), *more)


# -- writing and removing -------------------------------------------------------------------------------------------


def test_install_writes_its_files_and_nothing_that_enables_or_starts(
    install: Callable[..., Any], tmp_path: Path
) -> None:
    done = install()
    assert done.code == 0
    assert files(tmp_path) == PLACES
    assert not [path for path in tmp_path.rglob("*") if path.is_symlink()]
    assert f"\nExecStart={PROGRAM} start --bus %i\n" in (tmp_path / UNIT).read_text()
    assert "nothing has been started" in done.out


def test_a_second_install_changes_nothing(install: Callable[..., Any], tmp_path: Path) -> None:
    install()
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in PLACES}
    done = install()
    assert done.code == 0
    assert done.out.count("up to date") == len(PLACES)
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in PLACES} == before


def test_a_dry_run_shows_the_files_and_writes_none(install: Callable[..., Any], tmp_path: Path) -> None:
    done = install("--dry-run")
    assert done.code == 0
    assert f"would write {tmp_path / UNIT}" in done.out
    assert "AmbientCapabilities=CAP_NET_RAW CAP_NET_ADMIN CAP_SYS_NICE CAP_IPC_LOCK" in done.out
    assert files(tmp_path) == set()


def test_install_replaces_its_own_files_of_another_version(
    rtcp: Callable[..., Any], install: Callable[..., Any], tmp_path: Path
) -> None:
    rtcp("service", "install", "--root", str(tmp_path), "--program", "/usr/bin/true")
    done = install()
    assert f"wrote {tmp_path / UNIT}" in done.out
    assert f"ExecStart={PROGRAM} " in (tmp_path / UNIT).read_text()


def test_install_leaves_an_edited_file_alone_and_writes_nothing(install: Callable[..., Any], tmp_path: Path) -> None:
    install()
    (tmp_path / "etc/tmpfiles.d/rtcp.conf").unlink()
    edited = tmp_path / UNIT
    edited.write_text(edited.read_text() + "Nice=5\n")
    done = install()
    assert done.code == 3
    assert str(edited) in done.trouble
    assert "systemctl edit" in done.trouble
    assert edited.read_text().endswith("Nice=5\n")
    assert not (tmp_path / "etc/tmpfiles.d/rtcp.conf").exists()


def test_uninstall_removes_what_install_wrote(
    install: Callable[..., Any], uninstall: Callable[..., Any], tmp_path: Path
) -> None:
    install()
    done = uninstall()
    assert done.code == 0
    assert files(tmp_path) == set()
    again = uninstall()
    assert again.code == 0
    assert "no file of `rtcp service install` exists" in again.out


def test_uninstall_names_what_it_leaves(
    install: Callable[..., Any], uninstall: Callable[..., Any], tmp_path: Path
) -> None:
    install()
    edited = tmp_path / "etc/sysctl.d/80-rtcp.conf"
    edited.write_text("vm.stat_interval = 1\n")
    wants = tmp_path / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir()
    (wants / "rtcp@eth0.service").symlink_to(tmp_path / UNIT)
    configuration = tmp_path / "etc/rtcp"
    configuration.mkdir()
    runtime = tmp_path / "run/rtcp"
    runtime.mkdir(parents=True)
    output = uninstall("--dry-run").out
    assert (tmp_path / UNIT).exists()
    done = uninstall()
    assert files(tmp_path) == {"etc/sysctl.d/80-rtcp.conf"}
    for path in (edited, wants / "rtcp@eth0.service", configuration, runtime):
        assert f"left {path}" in output
        assert f"left {path}" in done.out


# -- refusals -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("program", "sentence"),
    [
        ("rtcp", "systemd needs an absolute path"),
        ("/home/someone/.venv/bin/rtcp", "is in /home, which the service cannot see"),
    ],
)
def test_a_program_that_the_service_could_not_start_is_refused(
    rtcp: Callable[..., Any], tmp_path: Path, program: str, sentence: str
) -> None:
    done = rtcp("service", "install", "--root", str(tmp_path), "--program", program)
    assert done.code in (2, 3)
    assert sentence in done.trouble
    assert files(tmp_path) == set()


def test_a_program_whose_interpreter_the_service_does_not_see_is_refused(rtcp: Callable[..., Any]) -> None:
    # In memory, as no folder of the tests' own is seen by the service.
    with tempfile.NamedTemporaryFile("w", dir="/dev/shm", prefix="rtcp-test-") as script:
        script.write("#!/home/someone/bin/python\n")
        script.flush()
        done = rtcp("service", "install", "--root", "/nowhere", "--program", script.name)
    assert done.code == 3
    assert "or its interpreter is in /home" in done.trouble


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write to a folder whatever its mode")
def test_where_it_may_not_write_uninstall_says_so_and_removes_nothing(
    install: Callable[..., Any], uninstall: Callable[..., Any], tmp_path: Path
) -> None:
    install()
    closed = tmp_path / "etc/systemd/system"
    closed.chmod(0o555)
    done = uninstall()
    closed.chmod(0o755)
    assert done.code == 3
    assert f"{closed} cannot be written to" in done.trouble
    assert files(tmp_path) == PLACES


# -- what a service that died leaves --------------------------------------------------------------------------------


def settings(unit: Path) -> dict[str, list[str]]:
    """Return the settings of the unit, each key with its values in order; for most keys the last counts."""
    values: dict[str, list[str]] = {}
    for line in unit.read_text().splitlines():
        key, is_one, value = line.partition("=")
        if is_one and not key.startswith("#"):
            values.setdefault(key, []).append(value)
    return values


@pytest.mark.parametrize(
    ("key", "value"), [("RuntimeDirectoryPreserve", "yes"), ("RemoveIPC", "no"), ("OOMPolicy", "continue")]
)
def test_the_unit_leaves_the_next_start_what_it_records_a_death_from_and_outlives_its_gateway(
    install: Callable[..., Any], tmp_path: Path, key: str, value: str
) -> None:
    install()
    assert settings(tmp_path / UNIT).get(key) == [value]


# -- what systemd says ----------------------------------------------------------------------------------------------


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze, which needs no running systemd."""
    return subprocess.run(["systemd-analyze", *arguments], capture_output=True, text=True, check=False)


needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None,
    reason="systemd-analyze is not installed (Debian, Ubuntu: apt install systemd)",
)


@needs_systemd
def test_systemd_finds_no_fault_with_the_unit(install: Callable[..., Any], tmp_path: Path) -> None:
    install()
    done = analyze("verify", "--man=no", str(tmp_path / UNIT))
    assert (done.returncode, done.stderr) == (0, "")


@needs_systemd
def test_the_unit_is_exposed_no_more_than_it_has_to_be(install: Callable[..., Any], tmp_path: Path) -> None:
    if "--offline" not in analyze("--help").stdout:
        pytest.skip("this systemd-analyze judges running services only: 250 or newer is needed")
    install()
    done = analyze("security", "--offline=true", f"--threshold={EXPOSURE * 10:.0f}", str(tmp_path / UNIT))
    assert done.returncode == 0, done.stdout


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd-sysusers is not installed")
def test_sysusers_would_make_the_user(install: Callable[..., Any], tmp_path: Path) -> None:
    install()
    file = str(tmp_path / "etc/sysusers.d/rtcp.conf")
    done = subprocess.run(
        ["systemd-sysusers", f"--root={tmp_path}", "--dry-run", file], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Creating user 'rtcp'" in done.stderr + done.stdout
