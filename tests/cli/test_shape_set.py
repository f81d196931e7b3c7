"""`rtcp shape-set`: its messages at any end; the run itself is fake."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.api import RtcpError
from rtcp.cli.__main__ import main
from rtcp.config.find import default_config
from rtcp.processes.shape_setting import report, run
from rtcp.processes.shape_setting.run import Outcome

JOB = str(default_config().parent / "shape_setting" / "arc.yaml")
OFF = "relay and gate of the heater are off, as measured, and no current flows"


class FakeCell:
    def __init__(self, *_: object) -> None:
        pass

    def __enter__(self) -> FakeCell:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class FakeRun:
    ends: Callable[[FakeRun], None] = staticmethod(lambda run: None)
    heat_is_off = True
    middle_c: float | None = None

    def __init__(
        self, cell: object, job: object, profile: object, say: Callable[[str], None], confirm: Callable[[str], None]
    ) -> None:
        self.say, self.confirm, self.outcome = say, confirm, Outcome()

    def run(self) -> None:
        type(self).ends(self)


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rtcp.api.cell.Cell", FakeCell)
    monkeypatch.setattr(run, "ShapeSettingRun", FakeRun)


def let(monkeypatch: pytest.MonkeyPatch, **attributes: Any) -> None:
    for name, value in attributes.items():
        monkeypatch.setattr(FakeRun, name, staticmethod(value) if callable(value) else value)


def fault(run: FakeRun) -> None:
    raise RtcpError("fault", "the fuse is blown")


def fail_to_write(*_: object) -> Path:
    raise OSError(28, "No space left on device")


def test_an_early_end_says_how_hot_the_rod_may_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    let(monkeypatch, ends=fault, middle_c=396.4)
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 5
    errors = capfd.readouterr().err
    assert f"{OFF}; the rod may have 396 C in the middle: do not touch it" in errors
    let(monkeypatch, middle_c=None, heat_is_off=False)
    assert main(["shape-set", JOB, "--out", str(tmp_path / "b")]) == 5
    assert "ARE OFF: turn the key to Off\n" in capfd.readouterr().err


def test_a_report_that_cannot_be_written_keeps_the_reason_and_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report, "write_report", fail_to_write)
    let(monkeypatch, ends=fault)
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 5
    errors = capfd.readouterr().err
    assert "the fuse is blown" in errors
    assert f"no report: {tmp_path / 'a'}: No space left on device" in errors


def test_a_complete_run_without_a_report_prints_its_figures_and_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report, "write_report", fail_to_write)
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 1
    output = capfd.readouterr()
    assert "mm rms" in output.out
    assert "no report" in output.err


def test_a_signal_while_the_report_is_written_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = []

    def write(folder: Path, *_: object) -> Path:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        written.append(folder)
        return folder

    monkeypatch.setattr(report, "write_report", write)
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 0
    assert written


def test_a_suspended_run_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    let(monkeypatch, ends=lambda run: os.kill(os.getpid(), signal.SIGTSTP))
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 128 + signal.SIGTSTP


@pytest.mark.parametrize("typed", [b"", b"\xff\xfe\n"], ids=["ended", "no text"])
def test_an_end_of_the_input_at_a_question_is_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], typed: bytes
) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(typed), "utf-8"))
    let(monkeypatch, ends=lambda run: run.confirm("grip the rod"))
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 2
    output = capfd.readouterr()
    assert "grip the rod; then press Enter\n" in output.out
    assert "standard input has ended at a question: answer it, or pass --yes" in output.err


def test_an_answer_at_a_question_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n"))
    let(monkeypatch, ends=lambda run: run.confirm("grip the rod"))
    assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 0


def test_a_full_standard_output_ends_the_run_and_the_report_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    let(monkeypatch, ends=lambda run: run.say("heating"))
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["shape-set", JOB, "--out", str(tmp_path / "a")]) == 1
    assert OFF in capfd.readouterr().err
    assert (tmp_path / "a" / "report.json").exists()


@pytest.mark.parametrize("out", ["", "/"])
def test_a_folder_without_a_name_is_refused(out: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["shape-set", JOB, "--out", out]) == 2
    assert "--out: found " in capfd.readouterr().err
