"""Files that are no YAML, and YAML values that are read as people mean them."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from rtcp.config import ConfigError
from rtcp.config.document import read
from tests.findings import assert_finds

FILE = Path("a.yaml")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


UNREADABLE = {
    "empty": (b"", ": empty_file"),
    "only comments": (b"# nothing\n", ": empty_file"),
    "a list": (b"- 1\n", "1 : no_mapping"),
    "a word": (b"hello\n", "1 : no_mapping"),
    "binary": (b"\x7fELF\x02\xff\xfe", ": not_utf8 byte=5 found=255"),
    "control characters": (b"a: 1\nb: \x01\n", "2 : control_character found=1"),
    "a tab": (b"a:\n\tb: 1\n", "2 : not_yaml"),
    "an open bracket": (b"a: [1, 2\nb: 3\n", "2 : not_yaml"),
    "a key twice": (b"a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n", "3 b.c: key_twice first=3 at=5"),
    "a number as key": (b"1: 2\n", "1 : key_no_text found=1"),
    "an object of Python": (b"a: !!python/name:os.system\n", "1 a: tag found=tag:yaml.org,2002:python/name:os.system"),
    "an endless number": (b"a: " + b"1" * 5000, "1 a: long_number found=5000"),
    "an alias of itself": (b"a: &x [*x]\n", "1 a[0]: endless_alias"),
    "an unknown alias": (b"a: *x\n", "1 : not_yaml"),
    "half of a character": (b'a: "\\ud800"\n', "1 a: half_character"),
    "a second document": (b"a: 1\n---\nb: 1\n", "2 : not_yaml"),
    "nesting without end": (b"a: " + b"[" * 5000, ": too_deep"),
    "more than a megabyte": (b"a: 1\n" * 300_000, ": too_large what=bytes"),
    "more values than any arm has": (b"a: [" + b"1," * 30_000 + b"1]", ": too_large what=values"),
    "a billion laughs": (
        b"a: &a [ha, ha, ha, ha, ha, ha, ha, ha, ha]\n"
        + b"".join(f"{new}: &{new} [{','.join(['*' + old] * 9)}]\n".encode() for old, new in pairwise("abcdefghi")),
        ": too_large what=values",
    ),
    "one long text a thousand times": (
        b"a: &a " + b"x" * 500_000 + b"\nb: [" + b"*a," * 1000 + b"]", ": too_large what=characters"
    ),
    "aliases that nest more deeply than the file": (
        b"".join(
            f"{new}: &{new} {'[' * 50}{'*' + old if old else 1}{']' * 50}\n".encode()
            for old, new in pairwise(["", *"abcdefghijklmnopqrstuvwxyz"])
        ),
        ": too_deep",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "expected"), UNREADABLE.values(), ids=UNREADABLE.keys())
def test_a_file_that_is_no_mapping_of_values_is_refused(content: bytes, expected: str) -> None:
    FILE.write_bytes(content)
    assert_finds(lambda: read(FILE), expected)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("", "a.yaml: the file is empty; a mapping of keys to values is expected"),
        ("a: *x\n", "a.yaml:1:4: this is not valid YAML: found undefined alias 'x'"),
        ("a:\n  b: 1\n  b: 2", "a.yaml:2: a.b: this key occurs twice, in lines 2 and 3; keep one of them"),
    ],
)
def test_a_person_reads_place_key_and_remedy(content: str, sentence: str) -> None:
    FILE.write_text(content)
    with pytest.raises(ConfigError) as caught:
        read(FILE)
    assert caught.value.problems == [sentence]


def test_every_repeated_key_is_named() -> None:
    FILE.write_text("a: 1\na: 2\nb: {c: 1, c: 2}\n")
    assert_finds(lambda: read(FILE), "a: key_twice", "b.c: key_twice")


def test_a_missing_file_is_named() -> None:
    assert_finds(lambda: read(FILE), ": no_file")


NO_FILES = {
    "a directory": (FILE.mkdir, "a directory"),
    "a named pipe": (lambda: os.mkfifo(FILE), "a named pipe"),
    "a link to a device without end": (lambda: FILE.symlink_to("/dev/zero"), "a device"),
    "a socket": (lambda: socket.socket(socket.AF_UNIX).bind(str(FILE)), "a socket"),
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize(("make", "kind"), NO_FILES.values(), ids=NO_FILES.keys())
def test_what_is_no_regular_file_is_refused_unread(make: Callable[[], object], kind: str) -> None:
    make()
    assert_finds(lambda: read(FILE), f": no_regular_file found={kind}")


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every file")
def test_a_file_without_the_right_to_read_is_named() -> None:
    FILE.write_text("a: 1\n")
    FILE.chmod(0)
    assert_finds(lambda: read(FILE), ": unreadable reason=Permission denied")


SCALARS = {
    "1e-3": 0.001, "1e3": 1000.0, "1.": 1.0, ".5": 0.5, "-2": -2, "+3": 3, "0x1F": 31, "0o17": 15, "0": 0,
    "010": "010", "1:30": "1:30", "1_000": "1_000", "2024-01-01": "2024-01-01",
    "on": "on", "yes": "yes", "true": True, "False": False, "~": None, "": None, "null": None,
    "-.inf": -float("inf"), "'5'": "5", "Norway": "Norway", "no": "no",
}  # fmt: skip


@pytest.mark.parametrize(("text", "value"), SCALARS.items())
def test_a_plain_value_is_read_as_yaml_1_2_says(text: str, value: object) -> None:
    FILE.write_text(f"a: {text}\n")
    data = read(FILE).data
    assert data == {"a": value}
    assert isinstance(data, dict)
    assert type(data["a"]) is type(value)


def test_a_byte_order_mark_does_no_harm() -> None:
    FILE.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert read(FILE).data == {"a": 1}


def test_an_alias_repeats_its_anchor() -> None:
    FILE.write_text("a: &limits {min: 1}\nb: *limits\n")
    assert read(FILE).data == {"a": {"min": 1}, "b": {"min": 1}}
