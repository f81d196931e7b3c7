"""The files of the black box: numbers, the oldest that go, disks that refuse, files that are none."""

from __future__ import annotations

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rtcp.gateway.blackbox_file import About, Moment, Recording, RecordingError, files, listed, read, write

from rtcp.gateway import blackbox_file
from rtcp.ipc.layout import RecordLayout
from rtcp.ipc.observer import record_type

CYCLES = 50


def recording(cycles: int = CYCLES, joints: int = 2) -> Recording:
    """A recording with other numbers in each cycle."""
    kinds = record_type(RecordLayout(joints))
    whole = np.zeros(cycles, dtype=kinds)
    whole["number"] = whole["time_ns"] = np.arange(cycles) + 1
    whole["position"] = np.arange(cycles * joints).reshape(cycles, joints) * 0.1
    records = {name: whole[name] for name in kinds.names or () if name not in ("number_again", "padding")}
    about = About(
        number=0, time_ns=1_790_000_000_123_456_789, what="process data lost: ü", before="moving", arm="arm",
        bus="virtual", period_ns=500_000, joints=tuple(f"joint{i}" for i in range(joints)), versions={"rtcp": "1"},
        began_ns=5, event=7, at=cycles // 2 if cycles else -1, notes=("a note",), timeline=(Moment(9, "a sentence"),),
    )  # fmt: skip
    return Recording(about, records)


def test_a_recording_is_read_as_it_was_written(tmp_path: Path) -> None:
    number, path = write(tmp_path / "deep" / "faults", recording())
    assert path.name.startswith("fault-000001-20")
    found = read(path)
    assert found.about == replace(recording().about, number=number)
    for name, array in recording().records.items():
        assert np.array_equal(found.records[name], array)
    assert [one.about for one in listed(path.parent)] == [found.about]
    # And by numpy alone.
    assert np.array_equal(np.load(path, allow_pickle=False)["position"], recording().records["position"])


def test_a_recording_without_a_cycle_is_one_too(tmp_path: Path) -> None:
    assert read(write(tmp_path, recording(0))[1]).about.at == -1
    assert listed(tmp_path)[0].seconds == 0.0


def test_numbers_rise_and_none_is_given_twice_even_when_files_are_removed(tmp_path: Path) -> None:
    for wanted in (1, 2, 3):
        number, path = write(tmp_path, recording())
        assert number == wanted
    path.unlink()
    assert write(tmp_path, recording())[0] == 4
    (tmp_path / "last").write_text("rubbish")
    assert write(tmp_path, recording())[0] == 5
    (tmp_path / "last").unlink()
    assert write(tmp_path, recording())[0] == 6


def test_two_writers_at_once_share_the_numbers(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from rtcp.gateway.blackbox_file import write\n"
        "from tests.runtime.test_blackbox_file import recording\n"
        "for _ in range(15): print(write(Path(sys.argv[1]), recording())[0])"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    writers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    numbers = [int(line) for writer in writers for line in writer.communicate()[0].split()]
    assert sorted(numbers) == list(range(1, 31))
    assert [number for number, _ in files(tmp_path)] == list(range(1, 31))


def test_the_oldest_go_and_what_an_interrupted_writer_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blackbox_file, "KEPT", 3)
    (tmp_path / ".fault-000009-2026-01-01T00-00-00.npz.new").write_text("half")
    _, first = write(tmp_path, recording())
    first.with_suffix(".png").write_text("its picture")
    (tmp_path / "notes.txt").write_text("somebody's own")
    for _ in range(4):
        write(tmp_path, recording())
    assert [number for number, _ in files(tmp_path)] == [3, 4, 5]
    assert sorted(path.suffix for path in tmp_path.iterdir()) == ["", ".npz", ".npz", ".npz", ".txt"]


def test_a_disk_that_is_full_is_a_sentence_and_leaves_nothing_of_the_file(tmp_path: Path) -> None:
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from rtcp.gateway.blackbox_file import RecordingError, write\n"
        "from tests.runtime.test_blackbox_file import recording\n"
        "made = recording()\n"
        "made.records['position'][:] = __import__('numpy').random.default_rng(1).random((50, 2))\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: write(Path(sys.argv[1]), made)\n"
        "except RecordingError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert f"{tmp_path}: no recording can be written there: File too large" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["last"]


def test_a_directory_that_cannot_be_made_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="no recording can be written there"):
        write(tmp_path / "file" / "faults", recording())
    with pytest.raises(RecordingError, match="cannot be read"):
        listed(tmp_path / "file")
    assert listed(tmp_path / "none") == []


def test_a_file_cut_off_anywhere_is_a_sentence_in_the_list(tmp_path: Path) -> None:
    _, path = write(tmp_path, recording())
    whole = path.read_bytes()
    for length in [0, 1, 100, *range(200, len(whole), 997), len(whole) - 1]:
        path.write_bytes(whole[:length])
        (one,) = listed(tmp_path)
        assert one.about is None
        assert str(path) in one.trouble
        with pytest.raises(RecordingError):
            read(path)


def test_changed_bytes_are_never_a_traceback(tmp_path: Path) -> None:
    _, path = write(tmp_path, recording())
    whole = path.read_bytes()
    chance = np.random.default_rng(3)
    refused = 0
    for _ in range(400):
        changed = bytearray(whole)
        for at in chance.integers(0, len(whole), 3):
            changed[at] = int(chance.integers(0, 256))
        path.write_bytes(changed)
        listed(tmp_path)
        try:
            read(path)
        except RecordingError:
            refused += 1
    assert refused > 200


class Evil:
    """Makes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self._path),)


def _changed(path: Path, name: str, content: bytes | None) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {member: archive.read(member) for member in archive.namelist()}
    members.pop(name)
    if content is not None:
        members[name] = content
    with zipfile.ZipFile(path, "w") as archive:
        for member, bytes_ in members.items():
            archive.writestr(member, bytes_)


def _npy(array: object) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
    return stream.getvalue()


def _told(**changes: object) -> Callable[[Path], tuple[str, bytes]]:
    def made(path: Path) -> tuple[str, bytes]:
        with zipfile.ZipFile(path) as archive, archive.open("about.npy") as stream:
            told = json.loads(np.lib.format.read_array(stream).tobytes())
        return "about.npy", _npy(np.frombuffer(json.dumps({**told, **changes}).encode(), dtype=np.uint8))

    return made


FOREIGN: dict[str, Callable[[Path], tuple[str, bytes | None]]] = {
    "a field is missing": lambda path: ("wkc.npy", None),
    "nothing about itself": lambda path: ("about.npy", None),
    "another type": lambda path: ("wkc.npy", _npy(np.zeros(CYCLES))),
    "another length": lambda path: ("wkc.npy", _npy(np.zeros(CYCLES - 1, dtype="<i2"))),
    "other joints": lambda path: ("position.npy", _npy(np.zeros((CYCLES, 3)))),
    "a shape beyond memory": lambda path: (
        "wkc.npy", _npy(np.zeros(3)).replace(b"'shape': (3,), }" + b" " * 15, b"'shape': (99999999999999,), }  "),
    ),
    "no JSON": lambda path: ("about.npy", _npy(np.frombuffer(b"{", dtype=np.uint8))),
    "another format": _told(format=2),
    "a text for a number": _told(time_ns="now"),
    "a truth for a number": _told(at=True),
    "the fault's cycle beyond the end": _told(at=CYCLES),
    "an instant that no calendar has": _told(time_ns=10**40),
    "a cycle of nothing": _told(period_ns=0),
    "joints that are a number": _told(joints=3),
    "moments that are none": _told(timeline=[3]),
}  # fmt: skip


@pytest.mark.parametrize("made", FOREIGN.values(), ids=FOREIGN.keys())
def test_a_foreign_file_is_a_sentence(tmp_path: Path, made: Callable[[Path], tuple[str, bytes | None]]) -> None:
    _, path = write(tmp_path, recording())
    _changed(path, *made(path))
    listed(tmp_path)
    with pytest.raises(RecordingError, match=path.name):
        read(path)


INSTANTS: dict[str, object] = {
    "bytes": np.array([b"a", b"b"]),
    "truths": np.array([True, False]),
    "several fields": np.zeros(2, dtype=[("a", "<i8"), ("b", "<i8")]),
    "a table": np.zeros((2, 2), dtype="<i8"),
    "one number": np.int64(3),
    "fractions": np.zeros(2),
}


@pytest.mark.parametrize("instants", INSTANTS.values(), ids=INSTANTS.keys())
def test_one_odd_file_is_a_sentence_in_the_list_and_the_others_are_listed(tmp_path: Path, instants: object) -> None:
    _, path = write(tmp_path, recording())
    write(tmp_path, recording())
    _changed(path, "time_ns.npy", _npy(instants))
    odd, sound = listed(tmp_path)
    assert odd.about is None
    assert "time_ns is" in odd.trouble
    assert sound.about is not None


def test_what_is_pickled_in_a_file_is_not_run(tmp_path: Path) -> None:
    _, path = write(tmp_path, recording())
    trap = tmp_path / "trap"
    for name in ("about.npy", "time_ns.npy", "wkc.npy"):
        _changed(path, name, _npy(np.array([Evil(trap)], dtype=object)))
        listed(tmp_path)
        with pytest.raises(RecordingError):
            read(path)
    path.write_bytes(pickle.dumps(Evil(trap)))
    assert listed(tmp_path)[0].about is None
    assert not trap.exists()
