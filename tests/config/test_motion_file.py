"""Motion files: what they may say in YAML and CSV, and a sentence with its line for each mistake."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from rtcp.config.model import ConfigError, Point, Stop
from rtcp.config.motion_file import MotionFile, read_motion

Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str, name: str = "motion.yaml") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return written


def said(path: Path) -> list[str]:
    with pytest.raises(ConfigError) as wrong:
        read_motion(path)
    return [sentence.replace(f"{path.parent}/", "") for sentence in str(wrong.value).splitlines() if sentence]


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
    ("{}", "none of trajectory, path, program and poses has entries; one of them is needed"),
    (
        "trajectory:\n" + POINT + "path:\n  - {q: [0, 0, 0, 0, 0, 0]}\n",
        "a file holds one of trajectory, path and program, found trajectory and path",
    ),
    ("speed: 0.1\ntrajectory:\n" + POINT, "a speed is for a path"),
    ("speed: 0\npath:\n  - {q: [0, 0, 0, 0, 0, 0]}\n", "motion.yaml:1: speed: "),
    ("trajectry:\n" + POINT, "motion.yaml:1: trajectry: "),
    ("trajectory:\n  - {t: 0, w: [0, 0], q: [0]}\n", "motion.yaml:2: trajectory[0].w: "),
    ("trajectory:\n  - {t: 0}\n", "motion.yaml:2: trajectory[0]"),
    ("trajectory:\n  - {t: -1, q: [0]}\n", "motion.yaml:2: trajectory[0].t: "),
    ("trajectory:\n  - {t: .nan, q: [0]}\n", "motion.yaml:2: trajectory[0].t: "),
    ("trajectory:\n  - {t: 0, q: [.inf]}\n", "motion.yaml:2: trajectory[0].q[0]: "),
    ("trajectory:\n  - {t: 0, q: [fast]}\n", "motion.yaml:2: trajectory[0].q[0]: "),
    ("trajectory:\n  - {t: 0, q: []}\n", "motion.yaml:2: trajectory[0].q: "),
    ("trajectory:\n  - {t: 0, q: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]}\n", "motion.yaml:2: trajectory[0].q: "),
    (
        "trajectory:\n" + POINT + "  - {t: 2, q: [0, 0]}\n  - {t: 1, q: [0, 0]}\n",
        "motion.yaml:4: trajectory[2].t: found 1 after 2; times must rise",
    ),
    (
        "trajectory:\n" + POINT + "  - {t: 2, q: [0]}\n",
        "motion.yaml:3: trajectory[1].q: found 1 numbers, allowed are 2, as the first point has",
    ),
    (
        "trajectory:\n" + POINT + "  - {t: 2, q: [0, 0], v: [0, 0]}\n",
        "motion.yaml:3: trajectory[1].v: v must be given for all points or for none",
    ),
    ("trajectory:\n  - {t: 2, q: [0], a: [0]}\n", "motion.yaml:2: trajectory[0].a: a needs v beside it"),
    ("path:\n  - {speed: 0.1}\n", "motion.yaml:2: path[0]: found neither of pose and q; one of them is needed"),
    (
        "path:\n  - {pose: [0, 0, 0, 0, 0, 0], q: [0, 0, 0, 0, 0, 0]}\n",
        "motion.yaml:2: path[0]: found both of pose and q; one of them is needed",
    ),
    ("path:\n  - {pose: [0, 0, 0]}\n", "motion.yaml:2: path[0].pose: "),
    ("path: [\n", "motion.yaml:"),
]


@pytest.mark.parametrize(("text", "sentence"), YAML, ids=range(len(YAML)))
def test_a_mistake_in_yaml_is_named_in_one_sentence(write: Write, text: str, sentence: str) -> None:
    found = said(write(text))
    assert len(found) == 1
    assert sentence in found[0]


HEADER = "allowed is t,q1,..,q6 (and v1,..,v6 and a1,..,a6) or x,y,z,rx,ry,rz (and speed)"
CSV = [
    ("\n# nothing\n", "a.csv: the file is empty; a header and rows of numbers are expected"),
    ("t,q1,q3\n0,0,0\n", f'a.csv:1: found the header "t,q1,q3", {HEADER}'),
    ("0,0,0\n", f'a.csv:1: found the header "0,0,0", {HEADER}'),
    ("t,q1\n", "a.csv:1: the file has a header and no rows"),
    ("t,q1\n" + "".join(f"{k},0\n" for k in range(4097)), "a.csv: the file has 4097 rows, at most 4096 are allowed"),
    ("t,q1\n0,0\n\n1,0,0\n", "a.csv:4: found 3 columns, the header has 2"),
    ("t,q1\n0,high\n", 'a.csv:2: q1: found the text "high", allowed is a number'),
    ("t,q1\n0,nan\n", "a.csv:2: q1: found nan, allowed is a finite number"),
    ("t,q1\n-1,0\n", "a.csv:2: trajectory[0].t: found -1.0, allowed is a number of at least 0"),
    ("t,q1\n1,0\n1,0\n", "a.csv:3: trajectory[1].t: found 1 after 1; times must rise"),
    ("x,y,z,rx,ry,rz,speed\n0,0,0,0,0,0,0\n", "a.csv:2: path[0].speed: found 0.0, allowed is a number greater than 0"),
]


@pytest.mark.parametrize(("text", "sentence"), CSV, ids=range(len(CSV)))
def test_a_mistake_in_csv_is_named_in_one_sentence(write: Write, text: str, sentence: str) -> None:
    assert said(write(text, "a.csv")) == [sentence]


def test_all_mistakes_of_a_file_are_named(write: Write) -> None:
    assert said(write("t,q1\n2,0\n1,0\n3,x\n4,0\n3,0\n", "a.csv")) == [
        'a.csv:4: q1: found the text "x", allowed is a number',
        "a.csv:3: trajectory[1].t: found 1 after 2; times must rise",
        "a.csv:6: trajectory[3].t: found 3 after 4; times must rise",
    ]


def test_an_ending_that_says_no_form_is_refused(write: Write) -> None:
    assert said(write("", "a.txt")) == ['a.txt: the ending ".txt" selects no form; allowed are .yaml, .yml and .csv']


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    for name in ("none.csv", "none.yaml"):
        assert name in said(tmp_path / name)[0]
