"""Motion files in YAML and CSV, and the message with its line for each mistake."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from rtcp.config.model import ConfigError, MotionFile, Point, Stop
from rtcp.config.motion_file import read_motion
from tests.findings import assert_finds

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str, name: str = "motion.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


def test_a_trajectory_in_yaml(write: Write) -> None:
    text = "trajectory:\n  - {t: 0.0, q: [0, 0]}\n  - {t: 2.0, q: [0.3, pi/4]}\n"
    assert read_motion(write(text)) == MotionFile(
        trajectory=(Point(0.0, (0.0, 0.0)), Point(2.0, (0.3, math.pi / 4))),
    )


def test_a_path_in_yaml(write: Write) -> None:
    text = "speed: 0.1\npath:\n  - {pose: [-0.5, 0.1, 0.6, 0, 0, pi]}\n  - {q: [0, 0, 0, 0, 0.3, 0], speed: 0.05}\n"
    assert read_motion(write(text, "a.yml")) == MotionFile(
        path=(Stop((-0.5, 0.1, 0.6, 0.0, 0.0, math.pi)), Stop(None, (0.0, 0.0, 0.0, 0.0, 0.3, 0.0), 0.05)), speed=0.1
    )


def test_a_trajectory_in_csv(write: Write) -> None:
    text = "# by hand\nt, q1, q2, v1, v2\n\n0, 0, 0, 0, 0\n1.5, 0.1, -0.2, 0, 0\n"
    assert read_motion(write(text, "a.csv")) == MotionFile(
        trajectory=(Point(0.0, (0.0, 0.0), (0.0, 0.0)), Point(1.5, (0.1, -0.2), (0.0, 0.0))),
    )
    text = "t,q1,v1,a1\n0,0,0,0\n1,0.1,0.2,0.3\n"
    assert read_motion(write(text, "A.CSV")).trajectory[1] == Point(1.0, (0.1,), (0.2,), (0.3,))


def test_a_path_in_csv(write: Write) -> None:
    assert read_motion(write("x,y,z,rx,ry,rz\n1,2,3,4,5,6\n", "a.csv")).path == (Stop((1.0, 2.0, 3.0, 4.0, 5.0, 6.0)),)
    text = "X,Y,Z,RX,RY,RZ,Speed\n1,2,3,4,5,6,0.1\n"
    assert read_motion(write(text, "a.csv")).path == (Stop((1.0, 2.0, 3.0, 4.0, 5.0, 6.0), None, 0.1),)


POINT = "  - {t: 0, q: [0, 0]}\n"
YAML = [
    ("{}", ": no_motion"),
    ("trajectory:\n" + POINT + "path:\n  - {q: [0, 0, 0, 0, 0, 0]}\n", "3 path: several_motions"),
    ("speed: 0.1\ntrajectory:\n" + POINT, "1 speed: speed_of_trajectory"),
    ("speed: 0\npath:\n  - {q: [0, 0, 0, 0, 0, 0]}\n", "1 speed: range"),
    ("trajectry:\n" + POINT, "1 trajectry: unknown"),
    ("trajectory:\n  - {t: 0, w: [0, 0], q: [0]}\n", "2 trajectory[0].w: unknown"),
    ("trajectory:\n  - {t: 0}\n", "2 trajectory[0]: missing key=q"),
    ("trajectory:\n  - {t: -1, q: [0]}\n", "2 trajectory[0].t: range"),
    ("trajectory:\n  - {t: .nan, q: [0]}\n", "2 trajectory[0].t: range"),
    ("trajectory:\n  - {t: 0, q: [.inf]}\n", "2 trajectory[0].q[0]: range"),
    ("trajectory:\n  - {t: 0, q: [fast]}\n", "2 trajectory[0].q[0]: type"),
    ("trajectory:\n  - {t: 0, q: []}\n", "2 trajectory[0].q: length"),
    ("trajectory:\n  - {t: 0, q: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]}\n", "2 trajectory[0].q: size found=11"),
    ("trajectory:\n  - {t: 2, q: [0]}\n  - {t: 1, q: [0]}\n", "3 trajectory[1].t: times_fall before=2.0"),
    ("trajectory:\n" + POINT + "  - {t: 2, q: [0]}\n", "3 trajectory[1].q: count found=1 allowed=2"),
    ("trajectory:\n" + POINT + "  - {t: 2, q: [0, 0], v: [0, 0]}\n", "3 trajectory[1].v: all_or_none"),
    ("trajectory:\n  - {t: 2, q: [0], a: [0]}\n", "2 trajectory[0].a: needs_beside need=v"),
    ("path:\n  - {speed: 0.1}\n", "2 path[0]: pose_or_q found=neither"),
    ("path:\n  - {pose: [0, 0, 0, 0, 0, 0], q: [0, 0, 0, 0, 0, 0]}\n", "2 path[0]: pose_or_q found=both"),
    ("path:\n  - {pose: [0, 0, 0]}\n", "2 path[0].pose: size"),
    ("path: [\n", ": not_yaml"),
]


@pytest.mark.parametrize(("text", "expected"), YAML, ids=range(len(YAML)))
def test_a_mistake_in_yaml_is_named_alone(write: Write, text: str, expected: str) -> None:
    assert_finds(lambda: read_motion(write(text)), expected)


CSV = [
    ("\n# nothing\n", ": empty_file"),
    ("t,q1,q3\n0,0,0\n", '1 : header found="t,q1,q3"'),
    ("0,0,0\n", '1 : header found="0,0,0"'),
    ("t,q1\n", "1 : no_rows"),
    ("t,q1\n" + "".join(f"{k},0\n" for k in range(4097)), ": too_many_rows found=4097 limit=4096"),
    ("t,q1\n0,0\n\n1,0,0\n", "4 : columns found=3 allowed=2"),
    ("t,q1\n0,high\n", '2 q1: no_number found="high"'),
    ("t,q1\n0,nan\n", "2 q1: range found=nan"),
    ("t,q1\n-1,0\n", "2 trajectory[0].t: range found=-1.0"),
    ("t,q1\n1,0\n1,0\n", "3 trajectory[1].t: times_fall before=1.0"),
    ("x,y,z,rx,ry,rz,speed\n0,0,0,0,0,0,0\n", "2 path[0].speed: range"),
]


@pytest.mark.parametrize(("text", "expected"), CSV, ids=range(len(CSV)))
def test_a_mistake_in_csv_is_named_alone(write: Write, text: str, expected: str) -> None:
    assert_finds(lambda: read_motion(write(text, "a.csv")), expected)


def test_all_mistakes_of_a_file_are_named(write: Write) -> None:
    path = write("t,q1\n2,0\n1,0\n3,x\n4,0\n3,0\n", "a.csv")
    with pytest.raises(ConfigError) as wrong:
        read_motion(path)
    assert [sentence.removeprefix(f"{path.parent}/") for sentence in wrong.value.problems] == [
        'a.csv:4: q1: found the text "x", allowed is a number',
        "a.csv:3: trajectory[1].t: found 1 after 2; times must rise",
        "a.csv:6: trajectory[3].t: found 3 after 4; times must rise",
    ]


def test_an_ending_that_says_no_form_is_refused(write: Write) -> None:
    assert_finds(lambda: read_motion(write("", "a.txt")), ": ending found=.txt")


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    for name in ("none.csv", "none.yaml"):
        assert_finds(partial(read_motion, tmp_path / name), ": no_file")
