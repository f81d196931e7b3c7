"""A wheel built from this repository and installed elsewhere brings its configuration along."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the source alone."""
    return built(tmp_path_factory.mktemp("wheel"), pure=True)


def built(directory: Path, *, pure: bool) -> Path:
    """Build the wheel from a copy, so that the checkout may be read-only."""
    source = directory / "source"
    source.mkdir()
    for name in ("rtcp", "kinematics", "config", "moveit", "systemd", "tests"):
        shutil.copytree(REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "_fast"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "hatch_build.py"):
        shutil.copy(REPOSITORY / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(directory), str(source)]
    if importlib.util.find_spec("hatchling"):
        command.append("--no-build-isolation")
    subprocess.run(command, check=True, env={**os.environ, "RTCP_PURE": "1" if pure else "0"})
    return next(directory.glob("rtcp-*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment that holds the wheel, with the dependencies of this one."""
    return install(wheel, tmp_path_factory.mktemp("elsewhere"))


def install(wheel: Path, directory: Path) -> Path:
    """Install a wheel into a new environment; return its interpreter."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(directory)], check=True)
    purelib = subprocess.run(
        [directory / "bin" / "python", "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        check=True, capture_output=True, text=True,
    ).stdout.strip()  # fmt: skip
    # A path file is processed for its directories only: the editable install of this repository is not taken over.
    Path(purelib, "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    target = [sys.executable, "-m", "pip", "--python", str(directory / "bin" / "python")]
    subprocess.run([*target, "install", "--quiet", "--no-deps", "--no-index", str(wheel)], check=True)
    return directory / "bin" / "python"


def run(python: Path, code: str) -> list[str]:
    environment = {name: value for name, value in os.environ.items() if name not in ("RTCP_CONFIG", "PYTHONPATH")}
    done = subprocess.run(
        [python, "-P" if sys.version_info >= (3, 11) else "-E", "-c", code],
        check=True, capture_output=True, text=True, cwd=python.parent, env=environment,
    )  # fmt: skip
    return done.stdout.splitlines()


def test_a_wheel_holds_packages_configuration_and_licence(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    shipped = {path.relative_to(REPOSITORY / "config") for path in (REPOSITORY / "config").rglob("*.yaml")}
    assert {f"rtcp/config/default/{path}" for path in shipped} <= names
    assert {f"rtcp/cli/systemd/{path.name}" for path in (REPOSITORY / "systemd").iterdir()} <= names
    assert {"rtcp/py.typed", "kinematics/py.typed"} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any(name.startswith(("tests/", "benchmarks/")) for name in names)


def test_the_default_configuration_loads_from_an_installed_wheel(installed: Path) -> None:
    code = """
import rtcp
from rtcp.config import default_config, load, load_segment, segment_path
arm = load(default_config())
print(rtcp.__file__)
print(arm.source)
print(len(arm.slaves), len(load_segment(segment_path(arm)).slaves))
"""
    package, source, counts = run(installed, code)
    environment = installed.parents[1]
    assert Path(package).is_relative_to(environment)
    assert Path(source).is_relative_to(environment)
    assert counts == "7 7"


def test_the_command_of_an_installed_wheel_starts(installed: Path) -> None:
    subprocess.run([installed.parent / "rtcp", "--help"], check=True, stdout=subprocess.DEVNULL, cwd=installed.parent)


def test_an_installed_wheel_brings_the_service_along(installed: Path, tmp_path: Path) -> None:
    command = [
        str(installed.parent / "rtcp"),
        "service",
        "install",
        "--root",
        str(tmp_path),
        "--program",
        "/usr/bin/env",
    ]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=installed.parent)
    assert "ExecStart=/usr/bin/env start" in (tmp_path / "etc/systemd/system/rtcp@.service").read_text()


def test_an_installed_wheel_exports_the_package_for_moveit(installed: Path, tmp_path: Path) -> None:
    command = [str(installed.parent / "rtcp"), "arm", "export-moveit", "--arm", "abb_irb120", "--out", str(tmp_path)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=installed.parent)
    assert (tmp_path / "abb_irb120_moveit_config" / "src" / "abb_irb120_kinematics.c").is_file()
    assert (tmp_path / "abb_irb120_moveit_config" / "src" / "kinematics_plugin.cpp").is_file()


@pytest.mark.platform
def test_the_demo_of_an_installed_wheel_runs(installed: Path, tmp_path: Path) -> None:
    directory = tempfile.mkdtemp(prefix="rtcp-wheel-", dir="/tmp")
    environment = {name: value for name, value in os.environ.items() if name not in ("RTCP_CONFIG", "PYTHONPATH")}
    environment["RTCP_RUNTIME_DIR"] = directory
    command = [str(installed.parent / "rtcp"), "demo", "--seconds", "1"]
    try:
        # A shared host may take the CPU away for longer than the shipped 20 ms: that is a fault, and said so.
        for _ in range(3):
            done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False)
            if "process data lost" not in done.stderr:
                break
    finally:
        shutil.rmtree(directory)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "start to OP" in done.stdout


@pytest.mark.long("test_the_default_configuration_loads_from_an_installed_wheel")
@pytest.mark.timeout(0)
def test_a_wheel_that_was_compiled_runs_compiled_wherever_it_is_installed(tmp_path: Path) -> None:
    wheel = built(tmp_path, pure=False)
    assert "-none-any" not in wheel.name
    python = install(wheel, tmp_path / "elsewhere")
    code = "import rtcp.control.arm as arm; from kinematics.compiled import BUILD; print(BUILD.is_used, arm.__file__)"
    (said,) = run(python, code)
    assert said.startswith("True ")
    assert said.endswith(sysconfig.get_config_var("EXT_SUFFIX"))
