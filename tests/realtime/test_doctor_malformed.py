"""Whatever a host's files hold, the doctor answers every question."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.realtime.host import format_cpus, parse_cpus

GARBAGE: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda text: b"",
    "white-space": lambda text: b" \n\t\n ",
    "no-text": lambda text: bytes(range(256)),
    "a-list-without-end": lambda text: b"0-99999999999",
    "colons": lambda text: b":\n::\n1:\n: 2\n",
    "a-negative-number": lambda text: b"-7",
    "cut-in-the-middle": lambda text: text[: len(text) // 2],
    "numbers-without-end": lambda text: re.sub(rb"[0-9]+", b"9" * 5000, text),
    "letters-for-numbers": lambda text: re.sub(rb"[0-9]+", b"x", text),
    "foreign-digits": lambda text: re.sub(rb"[0-9]+", "\u00b2\u0663".encode(), text),
    "one-word-a-line": lambda text: b"\n".join(text.split()),
}


def files_of(root: Path) -> list[Path]:
    return [path for path in sorted(root.rglob("*")) if path.is_file() and not path.is_symlink()]


@pytest.mark.parametrize("garbage", GARBAGE.values(), ids=GARBAGE.keys())
@pytest.mark.parametrize("kind", ["jetson", "laptop"])
def test_a_malformed_file_ends_in_no_exception(
    patient: Callable[[str], Any], kind: str, garbage: Callable[[bytes], bytes]
) -> None:
    broken = patient(kind)
    asked = len(broken.findings())
    for path in files_of(broken.root):
        kept = path.read_bytes()
        path.write_bytes(garbage(kept))
        assert len(broken.findings()) >= asked - 3, path  # a Jetson that does not say so is asked two things less
        path.write_bytes(kept)


@pytest.mark.parametrize("kind", ["jetson", "laptop"])
def test_a_folder_in_a_files_place_ends_in_no_exception(patient: Callable[[str], Any], kind: str) -> None:
    broken = patient(kind)
    for path in files_of(broken.root):
        kept = path.read_bytes()
        path.unlink()
        path.mkdir()
        broken.findings()
        path.rmdir()
        path.write_bytes(kept)


def test_a_pipe_that_nobody_writes_to_does_not_hold_the_doctor_up(good: Any) -> None:
    good.put({"proc/swaps": None})
    os.mkfifo(good.root / "proc/swaps")
    assert good.finding("swap").found == "not known: /proc/swaps is empty"


@given(st.sets(st.integers(0, 300)))
def test_a_list_of_cpus_is_read_as_it_is_written(cpus: set[int]) -> None:
    assert parse_cpus(format_cpus(cpus)) == cpus


@pytest.mark.parametrize("text", ["x", "1-", "-1", "1,,2", "0-99999999999", "1 2", "²"])
def test_what_is_no_list_of_cpus_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is no list of CPUs"):
        parse_cpus(text)
