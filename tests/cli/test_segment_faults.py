"""`rtcp segment fault`, `clear`, `faults` and `kinds` on a real segment that `rtcp segment` runs."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli.segment import kinds
from rtcp.virtual.faults.registry import installed, load_script

PAGE = Path(__file__).parents[2] / "docs" / "faults.md"
Rtcp = Callable[..., Any]
Segment = tuple["subprocess.Popen[str]", list[str]]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "segment.yaml"
    path.write_text("slaves:\n  - model: diewu-io\n  - model: cubemars-orh70\n")
    return path


@pytest.fixture
def begin(rtcp_process: Callable[..., Any], config: Path) -> Callable[..., Segment]:
    """Start `rtcp segment`; return its process and its first lines."""

    def start(*options: str, **more: Any) -> Segment:
        process = rtcp_process("segment", "--config", str(config), *options, **more)
        lines: list[str] = []
        while not lines or lines[-1] != "Ctrl-C ends it\n":
            lines.append(process.stdout.readline())
            assert lines[-1], process.stderr.read()
        return process, lines

    return start


def test_a_segment_leaves_the_last_cpu_to_the_masters_cycle_unless_one_is_chosen(begin: Callable[..., Segment]) -> None:
    cpus = os.sched_getaffinity(0)
    process, _ = begin()
    assert os.sched_getaffinity(process.pid) == (cpus - {max(cpus)} or cpus)
    process, _ = begin("--cpu", str(max(cpus)))
    assert os.sched_getaffinity(process.pid) == {max(cpus)}


def test_faults_are_made_listed_and_cleared_on_the_segment_that_runs(
    rtcp: Rtcp, begin: Callable[..., Segment], directory: Path
) -> None:
    process, printed = begin()
    assert f"inject faults with `rtcp segment fault NAME`; control socket {directory / 'segment.sock'}\n" in printed

    injected = rtcp("segment", "fault", "cable", "after=1")
    assert (injected.code, injected.err) == (0, "")
    assert injected.out == "fault 1: cable after=1 port=1, until it is cleared; to clear it: rtcp segment clear 1\n"
    assert rtcp("segment", "fault", "sdo_abort", "slave=2", "code=0x06090030", "--lasts", "60").out == (
        "fault 2: sdo_abort slave=2 code=0x6090030 index=0x0000, for 60 s; to clear it: rtcp segment clear 2\n"
    )
    assert "until its burst is over" in rtcp("segment", "fault", "loss", "burst=5").out
    assert rtcp("segment", "fault", "clock_jump", "slave=2", "us=-50.5").out == (
        "fault 4: clock_jump slave=2 us=-50.5: done\n"
    )

    listed = json.loads(rtcp("segment", "faults", "--json").out)
    assert [(fault["id"], fault["fault"]["fault"]) for fault in listed] == [(1, "cable"), (2, "sdo_abort"), (3, "loss")]
    lines = rtcp("segment", "faults").out.splitlines()
    assert re.fullmatch(r"fault 1: cable after=1 port=1, for \d+\.\d s, until it is cleared", lines[0])
    assert re.fullmatch(r"fault 2: .*, for \d+\.\d s, \d\d\.\d s left", lines[1])
    assert lines[2].endswith("0 lost before, 0 lost behind")

    assert rtcp("segment", "clear", "1").out == "cleared: fault 1\n"
    assert rtcp("segment", "clear").out == "cleared: fault 2, fault 3\n"
    assert rtcp("segment", "clear").out == rtcp("segment", "faults").out == "no fault is active\n"

    refused = rtcp("segment", "fault", "drive", "slave=1", "error=encoder")
    assert refused.code == 3
    assert "is no drive" in refused.trouble
    again = rtcp("segment", "clear", "1")
    assert (again.code, again.trouble) == (3, "rtcp: fault 1 is not active any more")

    process.terminate()
    assert (process.communicate(), process.returncode) == (("ended\n", ""), 0)
    assert not (directory / "segment.sock").exists()


def test_a_second_segment_has_a_socket_of_its_own_and_has_to_be_chosen(
    rtcp: Rtcp, begin: Callable[..., Segment], directory: Path
) -> None:
    begin()
    second, lines = begin()
    own = directory / f"segment-{second.pid}.sock"
    assert f"inject faults with `rtcp segment fault NAME --segment {own}`; control socket {own}\n" in lines

    unclear = rtcp("segment", "faults")
    assert unclear.code == 2
    assert f"--segment {directory / 'segment.sock'} or {own}" in unclear.trouble
    injected = rtcp("segment", "fault", "cable", "after=1", "--segment", str(own))
    assert injected.out.endswith(f"to clear it: rtcp segment clear 1 --segment {own}\n")
    assert len(json.loads(rtcp("segment", "faults", "--json", "--segment", str(own)).out)) == 1
    assert json.loads(rtcp("segment", "faults", "--json", "--segment", str(directory / "segment.sock")).out) == []


def test_where_the_runtime_directory_cannot_be_made_the_socket_is_elsewhere(
    rtcp: Rtcp, begin: Callable[..., Segment], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("RTCP_RUNTIME_DIR", str(tmp_path / "file" / "run"))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    process, _ = begin()
    own = tmp_path / f"rtcp-segment-{process.pid}.sock"
    assert rtcp("segment", "faults", "--segment", str(own)).out == "no fault is active\n"


def test_objects_of_a_described_slave_are_shown_and_set(
    rtcp: Rtcp, begin: Callable[..., Segment], config: Path
) -> None:
    vendor = Path(__file__).parents[1] / "virtual" / "vendor.xml"
    config.write_text(f"slaves:\n- {{esi: {vendor}, product: 0x30, name: box}}\n- {{esi: {vendor}, product: 0x11}}\n")
    begin()
    assert rtcp("segment", "set", "2", "0x6000:1", "1").out == "0x6000:1 Input: 1\n"
    objects = rtcp("segment", "get", "2")
    assert objects.out == "0x6000:1 Input: 1\n0x6010:1 Input: 0\n"
    rtcp("segment", "set", "box", "0x6000:2", "-2.5")
    rtcp("segment", "set", "box", "0x7010", "0x0102ff")
    assert json.loads(rtcp("segment", "get", "box", "0x6000:2", "--json").out)[0]["value"] == -2.5
    assert rtcp("segment", "get", "box", "0x7010").out.endswith(" Text: 0x0102ff\n")
    for arguments, text in (
        (("set", "2", "0x6000:1", "2"), "value: 0x6000:1 Input takes 0 to 1, not 2"),
        (("set", "2", "0x6000:1", "1e400"), "value: 0x6000:1 Input takes a whole number, not inf"),
        (("set", "box", "0x6000:2", "1e400"), "e+38, not inf"),
        (("get", "nosuch"), 'slave: there is no slave called "nosuch"; give a position from 1 to 2, or a name'),
        (("get", "2", "0x9999"), "2 digital inputs has no object 0x9999:0"),
        (("get", "3"), "slave: there is no slave 3; give a position from 1 to 2, or a name"),
        (("get", "2", "six"), "'six' is no object: write index and subindex, as 0x6000:1"),
    ):
        refused = rtcp("segment", *arguments)
        assert refused.code != 0
        assert text in refused.err


@pytest.mark.parametrize("command", [("fault", "cable", "after=1"), ("clear",), ("clear", "3"), ("faults",)])
def test_without_a_segment_that_runs_the_exit_code_is_4(rtcp: Rtcp, directory: Path, command: tuple[str, ...]) -> None:
    ended = rtcp("segment", *command)
    assert ended.code == 4
    assert ended.trouble == f"rtcp: no virtual segment is running: nothing listens at {directory / 'segment.sock'}"
    ended = rtcp("segment", *command, "--segment", str(directory / "x.sock"))
    assert ended.code == 4
    assert f"no segment answers at {directory / 'x.sock'}" in ended.trouble


@pytest.mark.parametrize(
    ("command", "sentence"),
    [
        (("fault", "cabel", "after=1"), "fault: this fault does not exist; did you mean cable?"),
        (("fault", "cable"), "the key after is missing; it must be an integer from 0 to 254"),
        (("fault", "cable", "after"), "'after' is not KEY=VALUE, as after=3 or code=0x1A"),
        (("fault", "cable", "=3"), "'=3' is not KEY=VALUE"),
        (("fault", "cable", "after=1.5"), "after: found 1.5, allowed is an integer from 0 to 254"),
        (("fault", "cable", "after=1_0"), 'after: found the text "1_0", allowed is an integer'),
        (("fault", "cable", "after=0xFFFF"), "after: found 65535, allowed is an integer"),
        (("fault", "cable", "after=1", "after=2"), "after is given twice"),
        (("fault", "cable", "after=1", "lasts=2", "--lasts", "2"), "lasts is given twice"),
        (("fault", "cable", "after=1", "--lasts", "-1"), "lasts: found -1, allowed is a number from 0.001"),
        (("fault", "cable", "after=1", "--lasts", "nan"), "lasts: found nan"),
        (("fault", "cable", "after=1", "at=3"), "at: a fault of the command line begins at once"),
        (("fault", "cable", "after=1", "fault=power"), "fault is given twice"),
        (("fault", "loss"), "give either rate"),
        (("fault", "loss", "rate=nan"), "rate: "),
        (("fault", "loss", "rate=inf"), "rate: "),
        (("fault", "clock_jump", "slave=1", "us=3", "--lasts", "1"), "clock_jump happens once and is over"),
        (("push", "1", "2"), "2 numbers are no push: 3 (X Y Z, N) or 6 (and RX RY RZ, Nm)"),
        (("push", "1", "2", "nan"), "Z"),
        (("push", "1", "600", "0"), "y: found 600, allowed is a number from -500 to 500"),
        (("push", "1", "2", "3", "--seconds", "0"), "--seconds 0 is not allowed"),
        (("--config", "x.yaml", "faults"), "--config is an option of a segment that starts, not of faults"),
        ((), "--config FILE is missing"),
        (("clear", "x"), "unable to parse string as an integer"),
    ],
)  # fmt: skip
def test_a_mistake_is_a_sentence_and_exit_code_2(rtcp: Rtcp, command: tuple[str, ...], sentence: str) -> None:
    ended = rtcp("segment", *command)
    assert (ended.code, ended.out) == (2, "")
    assert sentence in ended.trouble
    assert "Traceback" not in ended.err


def test_a_script_is_read_before_the_segment_starts(rtcp: Rtcp, config: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.yaml"
    script.write_text("faults:\n  - fault: power\n    slave: 3\n    at: 2\n")
    ended = rtcp("segment", "--config", str(config), "--faults", str(script))
    assert (ended.code, ended.out) == (2, "")
    assert f"{script}:3: faults[0].slave: found 3, the segment has 2 slaves" in ended.trouble


# -- the kinds ------------------------------------------------------------------------------------------------------


def test_the_kinds_are_listed_with_their_keys_and_what_is_allowed(rtcp: Rtcp) -> None:
    lines = rtcp("segment", "kinds").out.splitlines()
    assert [line.partition(":")[0] for line in lines if line[:1].islower()] == list(installed())
    assert "    ms        a number greater than 0 and at most 1000 (2 if left out)" in lines
    assert "    code      an integer from 1 to 65535 (0x0001 if left out)" in lines


def test_the_page_lists_the_kinds_as_the_code_has_them() -> None:
    rows = [
        f"| `{kind.name}` | {'; '.join(f'`{key}`: {allowed}' for key, allowed in kind.keys.items())} | {kind.says} |"
        for kind in kinds()
    ]
    listed = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert [row for row in rows if row not in listed] == []


def test_the_script_of_the_page_is_one(tmp_path: Path) -> None:
    written = re.search(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert written is not None
    script = tmp_path / "script.yaml"
    script.write_text(written[1])
    assert len(load_script(script)) >= 3
