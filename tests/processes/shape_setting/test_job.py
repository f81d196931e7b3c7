"""Jobs in YAML: what `rtcp shape-set` reads, and a sentence with file and line for each mistake."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rtcp.api import RtcpError
from rtcp.config.model import ConfigError
from rtcp.processes.shape_setting.job import read_job

FOLDER = Path(__file__).parents[3] / "config" / "shape_setting"


def mistakes(tmp_path: Path, old: str, new: str, name: str = "arc.yaml") -> list[str]:
    """Return the sentences for the example with `old` replaced, without the folder."""
    folder = tmp_path / "jobs"
    shutil.copytree(FOLDER, folder)
    text = (folder / name).read_text()
    assert text.count(old) == 1
    (folder / name).write_text(text.replace(old, new))
    with pytest.raises(ConfigError) as raised:
        read_job(folder / "arc.yaml")
    return [problem.removeprefix(f"{folder}/") for problem in raised.value.problems]


def test_the_example_is_a_job_with_its_profile() -> None:
    job, profile = read_job(FOLDER / "arc.yaml")
    assert profile.ends.length == job.rod.length
    assert set(job.holders) == set(job.near) == {"left", "right"}
    assert job.arc is not None


ARC = "arc: {angle: 0.9, side: [0, 1]}"
LEFT = "{arm: left, pose: {position: [0, 0, 0.12], rpy: [0, -pi/2, 0]}, radius: 0.02, near: [0, 0, 0.8, 0, -0.77, 0]}"
ROD = "rod: {length: 0.3, diameter: 0.001}"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (ARC, "", "found neither of arc and end"),
        (ARC, ARC + "\nend: {position: [0.25, 0.05, 0.06], rpy: [0.3, -0.3, 0.4]}", "found both of arc and end"),
        (ARC, "arc: {angle: 0.9, side: [0, 0]}", "arc.yaml:8: arc.side: found 0, 0"),
        (ARC, "arc: {angle: 4, side: [0, 1]}", "arc.yaml:8: arc.angle: found 4"),
        (ARC, "arc: {angle: 0.9, side: [0, 1, 0]}", "arc.yaml:8: arc.side: found"),
        (ARC, "arc: {side: [0, 1]}", "arc.yaml:8: arc: the key angle is missing"),
        (ROD, "rod: {length: 0.8, diameter: 0.001}", "arc.yaml:4: rod.length: found 0.8"),
        (ROD, "rod: {length: 0.3, diameter: 1}", "arc.yaml:4: rod.diameter: found 1"),
        (ROD, "rod: {length: .nan, diameter: 0.001}", "arc.yaml:4: rod.length: found "),
        (ROD, "rod: {length: 0.2, diameter: 0.001}", "arc.yaml:4: rod.length: found 0.2 m, the profile nitinol.yaml"),
        (ROD, "rod: {length: 0.3, diameter: 0.001, colour: red}", "arc.yaml:4: rod.colour: "),
        ("arm: right", "arm: left", 'arc.yaml:16: chucks[1].arm: found "left" twice'),
        (LEFT, LEFT.replace("0.02", "1e300"), "arc.yaml:15: chucks[0].radius: found 1e+300"),
        (LEFT, LEFT.replace("near: [0,", "near: [1e300,"), "arc.yaml:15: chucks[0].near[0]: found 1e+300"),
        ("approach_speed: 0.3", "approach_speed: 3", "arc.yaml:18: approach_speed: found 3"),
        ("approach_speed: 0.3", "approach_sped: 0.3", "arc.yaml:18: approach_sped: "),
        ("heat: nitinol.yaml", "heat: other.yaml", "other.yaml"),
        ("heat: nitinol.yaml", "heat: 3", "arc.yaml:3: heat: found 3"),
        ("chucks:", "chucks: [", "arc.yaml:"),
    ],
)  # fmt: skip
def test_a_mistake_is_a_sentence_with_its_line(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    found = mistakes(tmp_path, old, new)
    assert any(one.startswith(sentence) or sentence in one for one in found), found
    assert all(one.split(":")[0].endswith(".yaml") or ".yaml" in one for one in found)


def test_a_mistake_of_the_profile_has_its_line_there(tmp_path: Path) -> None:
    (sentence,) = mistakes(tmp_path, "target_c: 510", "target_c: hot", "nitinol.yaml")
    assert sentence.startswith("nitinol.yaml:10: target_c: found ")


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
