"""The package on another processor: an arm64 Debian, emulated by qemu, installs it and passes its unit tests.

Needs root, debootstrap, qemu-user-static and the network. `make test-all` runs it; it takes an hour and more, because
the compiler that builds ruckig is emulated too. RTCP_AARCH64_ROOT: folder in which the Debian is kept for the next run.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
QEMU = Path("/usr/bin/qemu-aarch64-static")
BINFMT = Path("/proc/sys/fs/binfmt_misc")
MAGIC = (
    r":qemu-aarch64:M::\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00:"
    r"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff:"
)
PACKAGES = "python3,python3-venv,python3-dev,g++,make,git,ca-certificates,iproute2"
TESTS = ("tests/config", "tests/devices", "tests/ipc", "tests/kinematics", "tests/realtime", "tests/virtual")
"""Tests that decode bytes, compute, or depend on the machine."""
NOT_EMULATED = (
    "tests/realtime/test_doctor.py::test_the_kernel_of_this_machine_answers_for_its_interfaces",
    "tests/virtual/faults/test_ground_truth.py::test_a_real_segment_reports_a_falling_load_without_any_master",
)
"""qemu passes neither the request of ethtool on nor those that create interfaces."""

pytestmark = [
    pytest.mark.platform,
    pytest.mark.long("test_the_default_configuration_loads_from_an_installed_wheel"),
    pytest.mark.timeout(4 * 3600),
    pytest.mark.skipif(os.geteuid() != 0, reason="debootstrap needs root"),
    pytest.mark.skipif(shutil.which("debootstrap") is None, reason="`apt-get install debootstrap`"),
    pytest.mark.skipif(not QEMU.exists(), reason="`apt-get install qemu-user-static`"),
]


def register_qemu() -> None:
    """Let the kernel start programs for aarch64 by qemu."""
    if not (BINFMT / "register").exists():
        subprocess.run(["mount", "-t", "binfmt_misc", "binfmt_misc", str(BINFMT)], check=True)
    if not (BINFMT / "qemu-aarch64").exists():
        (BINFMT / "register").write_text(f"{MAGIC}{QEMU}:F")


@pytest.fixture
def debian(tmp_path: Path) -> Iterator[Path]:
    """A Debian for arm64."""
    register_qemu()
    kept = os.environ.get("RTCP_AARCH64_ROOT")
    root = Path(kept) if kept else tmp_path / "debian"
    if not (root / "usr/bin/g++").exists():
        subprocess.run(
            ["debootstrap", "--arch=arm64", "--variant=minbase", f"--include={PACKAGES}", "bookworm", str(root)],
            check=True,
        )
    # The guest reaches the package index as this machine does.
    for file in (Path("/etc/resolv.conf"), Path("/etc/hosts"), Path("/etc/ssl/certs/ca-certificates.crt")):
        if file.exists():
            shutil.copy(file, root / file.relative_to("/"))
    yield root
    if not kept:
        shutil.rmtree(root, ignore_errors=True)


def run_in(debian: Path, command: str) -> subprocess.CompletedProcess[str]:
    """Run a command in the guest, with its own /proc; return what it printed."""
    inside = f"mount -t proc proc /proc; mount -t tmpfs tmpfs /dev/shm; cd /rtcp && {command}"
    (debian / "dev/shm").mkdir(exist_ok=True)
    return subprocess.run(
        ["unshare", "--mount", "--pid", "--fork", "chroot", str(debian), "sh", "-c", inside],
        env={**os.environ, "HOME": "/root", "TMPDIR": "/tmp", "PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin"},
        text=True, capture_output=True, check=False,
    )  # fmt: skip


def test_an_arm64_debian_installs_it_and_passes_the_unit_tests(debian: Path) -> None:
    source = debian / "rtcp"
    shutil.rmtree(source, ignore_errors=True)
    source.mkdir()
    archive = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    subprocess.run(["tar", "-x", "-C", str(source)], input=archive, check=True)
    assert run_in(debian, "uname -m").stdout == "aarch64\n"
    installed = run_in(debian, "make setup")
    assert installed.returncode == 0, installed.stdout + installed.stderr
    left_out = " ".join(f"--deselect {name}" for name in NOT_EMULATED)
    tests = run_in(debian, f".venv/bin/python -m pytest -q -m 'not platform and not long' {left_out} {' '.join(TESTS)}")
    assert tests.returncode == 0, tests.stdout[-8000:] + tests.stderr[-2000:]
