"""`rtcp export`, `rtcp plot` and `rtcp replay` on files: what they write, and one message for what they cannot do."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.telemetry.test_reading import cycles, mcap


def test_a_recording_is_exported_beside_itself_and_drawn(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", cycles(500))
    ended = rtcp("export", str(path), "--to", "csv")
    assert (ended.code, ended.out) == (0, f"500 records in {tmp_path}/a.csv\n")
    ended = rtcp("export", str(path), "--out", str(tmp_path / "b.npz"), "--signals", "wkc,*_position", "--start", "0.1")
    assert ended.out == f"300 records in {tmp_path}/b.npz\n"
    with np.load(tmp_path / "b.npz") as arrays:
        assert "commanded_position" in arrays
    assert rtcp("plot", str(path), "--end", "0.1").out == f"picture: {tmp_path}/a.png\n"
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert rtcp("plot", str(path), "--out", str(tmp_path / "b.svg"), "--signals", "wkc").code == 0
    assert "<svg" in (tmp_path / "b.svg").read_text()


def test_the_export_of_the_readme_works_as_written(
    rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    mcap(Path("recording.mcap"), cycles(500))
    readme = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (line,) = [line for line in readme.splitlines() if line.startswith("    rtcp export ")]
    assert rtcp(*line.partition("rtcp ")[2].partition("#")[0].split()).code == 0


def test_of_a_recording_that_is_cut_off_the_rest_is_exported_and_that_is_said(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    path = mcap(tmp_path / "a.mcap", cycles(1000))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    ended = rtcp("export", str(path), "--to", "csv")
    assert (ended.code, ended.out) == (0, f"500 records in {tmp_path}/a.csv\n")
    assert f"{path}: its end is missing or damaged" in ended.trouble


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (["export", "a.mcap"], "--to: found nothing, allowed are csv, mcap, npz"),
        (["export", "a.mcap", "--to", "wav"], "--to: found wav, allowed are csv, mcap, npz"),
        (["export", "a.mcap", "--to", "csv", "--out", "b.npz"], "--out b.npz: its ending must be that of the format"),
        (["export", "a.mcap", "--to", "csv", "--signals", "speed"], "a.mcap: there is no signal speed in it; it has"),
        (["export", "a.mcap", "--to", "csv", "--start", "nan"], "--start nan is not allowed"),
        (["export", "a.mcap", "--to", "csv", "--start", "9"], "a.mcap: it has no record from 9 to inf s; it ends at"),
        (["export", "a.mcap", "--out", "b.csv"], "b.csv: the file exists: --force replaces it, --out names another"),
        (["export", "a.mcap", "--out", "/proc/b.csv"], "/proc/b.csv: it cannot be written"),
        (["export", "none.mcap", "--to", "csv"], "none.mcap: the file cannot be read: No such file or directory"),
        (["plot", "b.csv"], "b.csv: the file is cut off, damaged or no recording"),
        (["plot", "a.mcap", "--out", "a.gif"], "--out a.gif: the ending must be one of"),
        (["plot", "a.mcap", "--out", "/proc/a.png"], "--out /proc/a.png cannot be written"),
        (["plot", "a.mcap", "--signals", "speed"], "there is no signal speed"),
        (["replay", "a.mcap", "--speed", "0"], "--speed 0 is not allowed"),
        (["replay", "few.mcap"], "few.mcap: there is no signal *_position in it; it has number, time_ns, wkc"),
        (["replay", "still.mcap"], "still.mcap: nothing moves in it"),
    ],
)
def test_what_cannot_be_done_is_one_message(
    rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: list[str], text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    mcap(Path("a.mcap"), cycles(500))
    mcap(Path("few.mcap"), cycles(500), signals=("wkc",))
    still = cycles(500)
    still["sent_position"] = 0.1
    mcap(Path("still.mcap"), still)
    Path("b.csv").write_text("mine")
    before = sorted(tmp_path.iterdir())
    ended = rtcp(*command)
    assert (ended.code, ended.out) == (2, "")
    assert text in ended.trouble
    assert len(ended.trouble.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before
