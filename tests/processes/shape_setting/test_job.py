"""Jobs of `rtcp shape-set` in YAML, and the message with file and line for each mistake."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rtcp.api import RtcpError
from rtcp.config.findings import Finding
from rtcp.processes.shape_setting.job import read_job
from tests.findings import findings_of, summary

FOLDER = Path(__file__).parents[3] / "config" / "shape_setting"


def mistakes(tmp_path: Path, old: str, new: str, name: str = "arc.yaml") -> list[Finding]:
    """Mistakes in the example with `old` replaced."""
    folder = tmp_path / "jobs"
    shutil.copytree(FOLDER, folder)
    text = (folder / name).read_text()
    assert text.count(old) == 1
    (folder / name).write_text(text.replace(old, new))
    return findings_of(lambda: read_job(folder / "arc.yaml"))


def test_the_example_is_a_job_with_its_profile() -> None:
    job, profile = read_job(FOLDER / "arc.yaml")
    assert profile.ends.length == job.rod.length
    assert set(job.holders) == set(job.near) == {"left", "right"}
    assert job.arc is not None


ARC = "arc: {angle: 0.9, side: [0, 1]}"
LEFT = (
    "{arm: left, pose: {position: [0, 0, 0.12], rpy: [0, -pi/2, 0]}, radius: 0.02, near: [0, -0.8, 0.96, 0, -0.16, 0]}"
)
ROD = "rod: {length: 0.3, diameter: 0.001}"


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (ARC, "", ": one_of_both found=neither of arc and end"),
        (ARC, ARC + "\nend: {position: [0.25, 0.05, 0.06], rpy: [0.3, -0.3, 0.4]}",
         ": one_of_both found=both of arc and end"),
        (ARC, "arc: {angle: 0.9, side: [0, 0]}", "8 arc.side: no_direction"),
        (ARC, "arc: {angle: 4, side: [0, 1]}", "8 arc.angle: range"),
        (ARC, "arc: {angle: 0.9, side: [0, 1, 0]}", "8 arc.side: size"),
        (ARC, "arc: {side: [0, 1]}", "8 arc: missing key=angle"),
        (ROD, "rod: {length: 0.8, diameter: 0.001}", "4 rod.length: range"),
        (ROD, "rod: {length: 0.3, diameter: 1}", "4 rod.diameter: range"),
        (ROD, "rod: {length: .nan, diameter: 0.001}", "4 rod.length: range"),
        (ROD, "rod: {length: 0.2, diameter: 0.001}", "4 rod.length: other_length"),
        (ROD, "rod: {length: 0.3, diameter: 0.001, colour: red}", "4 rod.colour: unknown"),
        ("arm: right", "arm: left", "16 chucks[1].arm: twice found=left"),
        (LEFT, LEFT.replace("0.02", "1e300"), "15 chucks[0].radius: range"),
        (LEFT, LEFT.replace("near: [0,", "near: [1e300,"), "15 chucks[0].near[0]: range"),
        ("approach_speed: 0.3", "approach_speed: 3", "18 approach_speed: range"),
        ("approach_speed: 0.3", "approach_sped: 0.3", "18 approach_sped: unknown"),
        ("heat: nitinol.yaml", "heat: other.yaml", ": no_file"),
        ("heat: nitinol.yaml", "heat: 3", "3 heat: type"),
        ("chucks:", "chucks: [", ": not_yaml"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_file_and_line(tmp_path: Path, old: str, new: str, expected: str) -> None:
    problems = mistakes(tmp_path, old, new)
    assert expected in [summary(finding, expected) for finding in problems]
    assert all(finding.file and finding.file.suffix == ".yaml" for finding in problems)


def test_a_mistake_of_the_profile_has_its_line_there(tmp_path: Path) -> None:
    (finding,) = mistakes(tmp_path, "target_c: 510", "target_c: hot", "nitinol.yaml")
    assert finding.file == tmp_path / "jobs" / "nitinol.yaml"
    assert summary(finding, "16 ") == "16 target_c: type"


def test_all_mistakes_come_at_once(tmp_path: Path) -> None:
    assert len(mistakes(tmp_path, ARC, "arc: {angle: 4, side: [0, 1]}\ncolour: red")) == 2


def test_an_end_that_the_rod_cannot_reach_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "jobs"
    shutil.copytree(FOLDER, folder)
    file = folder / "arc.yaml"
    file.write_text(file.read_text().replace(ARC, "end: {position: [0.5, 0, 0], rpy: [0, 0, 0]}"))
    job, _ = read_job(file)
    with pytest.raises(RtcpError):
        job.steps()
