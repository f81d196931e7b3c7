"""Programs that are taught: what a change writes, what it keeps, and what it refuses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.config.model import ConfigError
from rtcp.config.motion_file import read_motion
from rtcp.config.program_file import ProgramFile
from tests.findings import findings_of, summary

TEXT = """# what it is for
speed: 0.1   # slow
poses:
  # where it rests
  - {name: home, q: [0, -0.2, 2, 0, pi/2, 0]}   # upright
  - {name: right, pose: [-0.66, 0.1, 0.33, 0, -0.77, 0]}
program:
  - {move: home}                        # by the joints
  - {run: round, times: 3}              # thrice
  - gripper: close
  - {wait_s: 0.2}
# the parts
parts:
  - name: round
    steps:
      - {line: right, blend: 0.02}
      - {line: home}
"""


@pytest.fixture
def taught(tmp_path: Path) -> ProgramFile:
    file = tmp_path / "program.yaml"
    file.write_text(TEXT)
    return ProgramFile(file)


def test_a_program_is_made_of_nothing(tmp_path: Path) -> None:
    taught = ProgramFile(tmp_path / "new" / "program.yaml")
    assert not taught.path.exists()
    taught.keep("home", q=[0.0, 0.1234567, 1.0, -0.0, 0.5, 0.0])
    taught.keep("right", pose=(0.1, 0.2, 0.3, 0.0, 0.0, 0.0))
    taught.insert(0, {"line": "right", "blend": 0.02})
    taught.insert(0, {"move": "home"})
    taught.set_speed(0.1)
    assert taught.path.read_text() == (
        "speed: 0.1\n"
        "poses:\n"
        "  - {name: home, q: [0.0, 0.123457, 1.0, 0.0, 0.5, 0.0]}\n"
        "  - {name: right, pose: [0.1, 0.2, 0.3, 0.0, 0.0, 0.0]}\n"
        "program:\n"
        "  - {move: home}\n"
        "  - {line: right, blend: 0.02}\n"
    )
    assert read_motion(taught.path) == taught.motion


def test_what_a_person_wrote_stays_and_a_comment_goes_with_its_step(taught: ProgramFile) -> None:
    taught.move(0, 2)
    taught.replace(1, {"gripper": "open"})
    taught.insert(1, {"line": "home"}, "round")
    taught.keep("right", q=[0.1] * 6)
    assert taught.path.read_text().split("program:\n")[1] == (
        "  - {run: round, times: 3}              # thrice\n"
        "  - {gripper: open}\n"
        "  - {move: home}                        # by the joints\n"
        "  - {wait_s: 0.2}\n"
        "# the parts\n"
        "parts:\n"
        "  - name: round\n"
        "    steps:\n"
        "      - {line: right, blend: 0.02}\n"
        "      - {line: home}\n"
        "      - {line: home}\n"
    )
    assert taught.path.read_text().startswith(TEXT[: TEXT.index("  - {name: right")])


def test_every_change_is_taken_back_in_turn(taught: ProgramFile) -> None:
    texts = [TEXT]
    changes: tuple[Callable[[], object], ...] = (
        lambda: taught.remove(1),
        lambda: taught.set_speed(None),
        lambda: taught.keep("left", q=[0.0] * 6),
        lambda: taught.remove_pose("left"),
    )
    for change in changes:
        change()
        texts.append(taught.path.read_text())
    for text in reversed(texts[:-1]):
        assert taught.can_undo
        taught.undo()
        assert taught.path.read_text() == text
    assert not taught.can_undo


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda taught: taught.remove_pose("right"), "parts[0].steps[0].line: no_name found=right"),
        (lambda taught: taught.remove_pose("left"), "poses: choice found=left"),
        (lambda taught: taught.insert(0, {"line": "left"}), "program[0].line: no_name found=left"),
        (lambda taught: taught.insert(0, {"line": "right", "speed": -1.0}), "program[0].speed: range"),
        (lambda taught: taught.insert(9, {"line": "right"}), ": no_step found=10 allowed=1 to 4"),
        (lambda taught: taught.remove(-1), ": no_step found=0 allowed=1 to 4"),
        (lambda taught: taught.move(0, 4), ": no_step found=5"),
        (lambda taught: taught.insert(0, {"run": "round"}, "round"), "parts[0].steps: circle"),
        (lambda taught: taught.insert(0, {"line": "right"}, "square"), "parts: choice found=square"),
        (lambda taught: taught.keep("", q=[0.0] * 6), "poses[2].name: length"),
        (lambda taught: taught.keep("home", q=[float("nan")] * 6), "poses[0].q[0]: range"),
        (lambda taught: taught.set_speed(0.0), "speed: range"),
    ],
)
def test_a_change_that_would_be_a_mistake_changes_nothing(
    taught: ProgramFile, change: Callable[[ProgramFile], Any], expected: str
) -> None:
    before = taught.motion
    assert summary(findings_of(lambda: change(taught))[0], expected) == expected
    assert taught.path.read_text() == TEXT
    assert taught.motion is before
    assert not taught.can_undo
    assert [file.name for file in taught.path.parent.iterdir()] == ["program.yaml"]


def test_a_change_that_comes_while_another_one_is_checked_is_not_overwritten(
    taught: ProgramFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, checked = ProgramFile(taught.path), taught._checked

    def slow(text: str) -> Any:
        other.keep("theirs", q=[0.0] * 6)
        return checked(text)

    monkeypatch.setattr(taught, "_checked", slow)
    with pytest.raises(ConfigError, match="read it again"):
        taught.keep("mine", q=[0.0] * 6)
    assert [pose.name for pose in ProgramFile(taught.path).motion.poses][-1] == "theirs"


def test_a_change_of_something_else_is_not_overwritten(taught: ProgramFile) -> None:
    taught.remove(3)
    taught.path.write_text(TEXT)
    changes: tuple[Callable[[], object], ...] = (lambda: taught.remove(0), taught.undo)
    for change in changes:
        with pytest.raises(ConfigError, match="read it again"):
            change()
    assert taught.path.read_text() == TEXT
    taught.reload()
    assert not taught.can_undo
    taught.remove(0)
    assert len(taught.motion.program) == 3


def test_a_link_stays_one_and_its_file_is_changed(taught: ProgramFile) -> None:
    link = taught.path.parent / "link.yaml"
    link.symlink_to(taught.path)
    ProgramFile(link).remove(0)
    assert link.is_symlink()
    assert len(read_motion(taught.path).program) == 3


def test_a_trajectory_is_not_taught(tmp_path: Path) -> None:
    file = tmp_path / "path.yaml"
    file.write_text("path:\n  - {q: [0, 0, 0, 0, 0, 0]}\n")
    with pytest.raises(ConfigError, match="it holds a path, allowed is a program"):
        ProgramFile(file)
