"""Compiled modules are used only if they are of the sources beside them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import hatch_build
from kinematics.compiled import ABI, BUILD, MANIFEST, PURE, sources_digest, use
from tests.samples import THOROUGH

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder of compiled modules beside one source, with a module that has the name of none that is imported."""
    made = tmp_path / "kinematics" / "_fast"
    made.mkdir(parents=True)
    (tmp_path / "kinematics" / "one.py").write_text("x = 1\n")
    (tmp_path / "rtcp" / "ipc").mkdir(parents=True)
    (tmp_path / "rtcp" / "ipc" / "two.py").write_text("y = 1\n")
    (made / "x.so").write_bytes(b"1234")
    manifest = {
        "abi": ABI, "files": {"no_such.module": "x.so"}, "sizes": {"x.so": 4}, "sources": sources_digest(tmp_path),
    }  # fmt: skip
    (made / MANIFEST).write_text(json.dumps(manifest))
    return made


@pytest.fixture(autouse=True)
def finders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "meta_path", list(sys.meta_path))


@pytest.fixture
def impure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RTCP_PURE", raising=False)


def manifest_with(key: str, value: object) -> Callable[[Path], object]:
    def change(folder: Path) -> object:
        file = folder / MANIFEST
        return file.write_text(json.dumps({**json.loads(file.read_text()), key: value}))

    return change


@pytest.mark.usefixtures("impure")
def test_modules_of_these_very_sources_are_used(folder: Path) -> None:
    before = len(sys.meta_path)
    assert use(folder).is_used
    assert len(sys.meta_path) == before + 1


@pytest.mark.usefixtures("impure")
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda folder: (folder.parent / "one.py").write_text("x = 2\n"), "the source has changed since"),
        (lambda folder: (folder.parents[1] / "rtcp/ipc/two.py").write_text("y = 2\n"), "the source has changed since"),
        (lambda folder: (folder.parent / "one.py").unlink(), "the source has changed since it was compiled"),
        (lambda folder: (folder.parent / "new.py").touch(), "the source has changed since it was compiled"),
        (lambda folder: (folder / MANIFEST).unlink(), "not compiled: `make fast` compiles it"),
        (lambda folder: (folder / "x.so").unlink(), "x.so is missing"),
        (lambda folder: (folder / "x.so").write_bytes(b"12"), "the source has changed since it was compiled"),
        (lambda folder: (folder / MANIFEST).write_text("{"), "cannot be read"),
        (lambda folder: (folder / MANIFEST).write_text("{}"), "cannot be read"),
        (lambda folder: (folder / MANIFEST).write_text("[]"), "cannot be read"),
        (manifest_with("abi", ".cpython-27.so"), "compiled for .cpython-27.so, this interpreter needs"),
        (manifest_with("files", {"no_such__mypyc": "x.so"}), "the compiled code cannot be loaded"),
    ],
)
def test_others_are_not_and_the_reason_says_what_to_do(folder: Path, change: Any, reason: str) -> None:
    before = len(sys.meta_path)
    change(folder)
    result = use(folder)
    assert not result.is_used
    assert reason in result.reason
    assert len(sys.meta_path) == before


@pytest.mark.parametrize(("value", "is_used"), [("1", False), ("yes", False), ("0", True), ("", True)])
def test_rtcp_pure_runs_the_source(folder: Path, monkeypatch: pytest.MonkeyPatch, value: str, is_used: bool) -> None:
    monkeypatch.setenv("RTCP_PURE", value)
    assert use(folder).is_used is is_used


@pytest.mark.parametrize("module", ["kinematics.forward", "rtcp.control.cycle"])
def test_whatever_is_imported_first_decides_for_all(module: str) -> None:
    code = f"import sys, {module}; print(sys.modules[{module!r}].__file__)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip().endswith(ABI if BUILD.is_used else ".py")


def test_every_file_that_is_left_out_exists_and_every_folder_has_files() -> None:
    named = hatch_build.sources()
    assert all((ROOT / name).is_file() for name in hatch_build.INTERPRETED)
    assert not set(named) & set(hatch_build.INTERPRETED)
    assert all(any(Path(name).match(pattern) for name in named) for pattern in hatch_build.COMPILED)
    assert "rtcp/control/cycle.py" in named


def test_without_a_compiler_one_sentence_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    assert hatch_build.main() == hatch_build.NOT_POSSIBLE
    (said,) = capsys.readouterr().err.splitlines()
    assert "a C compiler" in said
    assert "everything runs as source" in said


def test_solving_a_quadratic_leaves_no_ring_of_references_where_the_collector_is_off() -> None:
    # The loop runs without the collector: a ring a cycle would fill the memory. In a process of its own: this one has
    # garbage of others.
    code = (
        "import gc; from kinematics.position_ik_general import solve_quadratic; gc.collect(); gc.disable()\n"
        "for _ in range(100): solve_quadratic((0.1, 0.5, -0.3, 0.7, 0.2)); solve_quadratic((1.0, 0.0, 0.0, 0.0, 0.0))\n"
        "print(gc.collect())"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert int(done.stdout) == 0


@pytest.mark.skipif(not BUILD.is_used, reason="nothing is compiled, or it is not used")
def test_compiled_functions_return_what_the_source_does_to_the_bit() -> None:
    samples = str(20_000 if THOROUGH else 1000)
    runs = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.compiled_results", samples],
            stdout=subprocess.PIPE,
            cwd=ROOT,
            env={**os.environ, PURE: pure},
        )
        for pure in ("", "1")
    ]
    compiled, source = (json.loads(run.communicate()[0]) for run in runs)
    assert (compiled.pop("is_compiled"), source.pop("is_compiled")) == (True, False)
    assert compiled == source
    assert source["errors"]
