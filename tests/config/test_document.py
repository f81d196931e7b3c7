"""Files that cannot be read as YAML, and YAML that is read as people mean it."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from rtcp.config import ConfigError
from rtcp.config.document import read

FILE = Path("a.yaml")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def problems(content: bytes) -> list[str]:
    FILE.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        read(FILE)
    return caught.value.problems


UNREADABLE = {
    "empty": (b"", "a.yaml: the file is empty; a mapping of keys to values is expected"),
    "only comments": (b"# nothing\n", "a.yaml: the file is empty; a mapping of keys to values is expected"),
    "a list": (b"- 1\n", "a.yaml:1: the file holds a list; a mapping of keys to values (`key: value`) is expected"),
    "a word": (
        b"hello\n",
        "a.yaml:1: the file holds a single value; a mapping of keys to values (`key: value`) is expected",
    ),
    "binary": (b"\x7fELF\x02\xff\xfe", "a.yaml: this is not a text file: byte 5 is 0xff, which is not UTF-8"),
    "control characters": (
        b"a: 1\nb: \x01\n",
        "a.yaml:2: this is not a text file: it holds the control character 0x01",
    ),
    "a tab": (b"a:\n\tb: 1\n", "a.yaml:2:1: this is not valid YAML: a tab cannot indent; use spaces"),
    "an open bracket": (
        b"a: [1, 2\nb: 3\n",
        "a.yaml:2:2: this is not valid YAML: expected ',' or ']', but got ':' while parsing a flow sequence",
    ),
    "a key twice": (
        b"a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n",
        "a.yaml:3: b.c: this key occurs twice, in lines 3 and 5; keep one of them",
    ),
    "a number as key": (b"1: 2\n", "a.yaml:1: found the key 1 in line 1; a key must be a text"),
    "an object of Python": (
        b"a: !!python/name:os.system\n",
        "a.yaml:1: a: the tag tag:yaml.org,2002:python/name:os.system is not allowed; write a plain value",
    ),
    "an endless number": (b"a: " + b"1" * 5000, "a.yaml:1: a: this number has 5000 digits; the limit is 100"),
    "an alias of itself": (b"a: &x [*x]\n", "a.yaml:1: a[0]: this alias contains itself"),
    "an unknown alias": (b"a: *x\n", "a.yaml:1:4: this is not valid YAML: found undefined alias 'x'"),
    "half of a character": (b'a: "\\ud800"\n', "a.yaml:1: a: this text holds U+D800, half of a character"),
    "a second document": (b"a: 1\n---\nb: 1\n", "a.yaml:2:1: this is not valid YAML: found a second document"),
    "nesting without end": (b"a: " + b"[" * 5000, "a.yaml: the lists and mappings are nested too deeply"),
    "more than a megabyte": (
        b"a: 1\n" * 300_000,
        "a.yaml: the file holds more than 1048576 bytes, the limit of a configuration",
    ),
    "more values than any arm has": (
        b"a: [" + b"1," * 30_000 + b"1]",
        "a.yaml: the file holds more than 20000 values, the limit of a configuration; an alias counts as everything "
        "that it stands for",
    ),
    "a billion laughs": (
        b"a: &a [ha, ha, ha, ha, ha, ha, ha, ha, ha]\n"
        + b"".join(f"{new}: &{new} [{','.join(['*' + old] * 9)}]\n".encode() for old, new in pairwise("abcdefghi")),
        "a.yaml: the file holds more than 20000 values, the limit of a configuration; an alias counts as everything "
        "that it stands for",
    ),
    "one long text a thousand times": (
        b"a: &a " + b"x" * 500_000 + b"\nb: [" + b"*a," * 1000 + b"]",
        "a.yaml: the file holds more than 1048576 characters, the limit of a configuration; an alias counts as "
        "everything that it stands for",
    ),
    "aliases that nest more deeply than the file": (
        b"".join(
            f"{new}: &{new} {'[' * 50}{'*' + old if old else 1}{']' * 50}\n".encode()
            for old, new in pairwise(["", *"abcdefghijklmnopqrstuvwxyz"])
        ),
        "a.yaml: the lists and mappings are nested too deeply",
    ),
}


@pytest.mark.parametrize(("content", "sentence"), UNREADABLE.values(), ids=UNREADABLE.keys())
def test_a_file_that_is_no_mapping_of_values_is_refused(content: bytes, sentence: str) -> None:
    assert problems(content) == [sentence]


def test_every_repeated_key_is_named() -> None:
    assert len(problems(b"a: 1\na: 2\nb: {c: 1, c: 2}\n")) == 2


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^a\.yaml: there is no such file$"):
        read(FILE)


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
    with pytest.raises(ConfigError, match=rf"^a\.yaml: this is {kind}; a regular file is expected$"):
        read(FILE)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every file")
def test_a_file_without_the_right_to_read_is_named() -> None:
    FILE.write_text("a: 1\n")
    FILE.chmod(0)
    with pytest.raises(ConfigError, match=r"^a\.yaml: the file cannot be read: Permission denied$"):
        read(FILE)


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
