"""Recordings on disk: numbers, removal of the oldest, full disks, files that are no recordings."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from rtcp.ipc import recording as module
from rtcp.ipc.observer import record_type
from rtcp.ipc.recording import About, FaultRecording, Moment, RecordingError, files, listed, read, write
from rtcp.ipc.schema import arm_schema

CYCLES = 50


def recording(cycles: int = CYCLES, joints: int = 2) -> FaultRecording:
    """A recording with other numbers in each cycle."""
    schema = arm_schema(joints)
    whole = np.zeros(cycles, dtype=record_type(schema))
    whole["number"] = whole["time_ns"] = np.arange(cycles) + 1
    whole["actual_position"] = np.arange(cycles * joints).reshape(cycles, joints) * 0.1
    about = About(
        number=0, time_ns=1_790_000_000_123_456_789, what="process data lost: ü", before="moving", arm="arm",
        bus="virtual", period_ns=500_000, joints=tuple(f"joint{i}" for i in range(joints)), versions={"rtcp": "1"},
        began_ns=5, event=7, at=cycles // 2 if cycles else -1, notes=("a note",), timeline=(Moment(9, "a sentence"),),
    )  # fmt: skip
    return FaultRecording(about, whole, schema)


def test_a_recording_is_read_as_it_was_written(tmp_path: Path) -> None:
    number, path = write(tmp_path / "deep" / "faults", recording())
    assert path.name.startswith("fault-000001-20")
    restored = read(path)
    assert restored.about == replace(recording().about, number=number)
    for name in restored.schema.names:
        assert np.array_equal(restored.records[name], recording().records[name])
    assert [file.about for file in listed(path.parent)] == [restored.about]


def test_any_reader_of_mcap_opens_a_recording(tmp_path: Path) -> None:
    made = recording()
    _, path = write(tmp_path, made)
    with open(path, "rb") as file:
        messages = [(schema, channel, message) for schema, channel, message in make_reader(file).iter_messages()]
    cycles = [(schema, message) for schema, channel, message in messages if channel.topic == "/cycle"]
    schema, _ = cycles[0]
    assert (schema.name, schema.encoding, len(cycles)) == ("rtcp_msgs/msg/Cycle", "ros2msg", CYCLES)
    assert b"uint64 number  # cycle, : Number" in schema.data
    assert b"float64[2] actual_position  # arm, rad: Measured position.\n" in schema.data
    # By the clock of the fault's instant, its cycle is at that instant.
    assert cycles[made.about.at][1].log_time == made.about.time_ns
    logs = [json.loads(message.data)["message"] for _, channel, message in messages if channel.topic == "/log"]
    assert logs == ["a sentence"]


def test_a_recording_may_have_no_cycle(tmp_path: Path) -> None:
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
        "import sys; from pathlib import Path; from rtcp.ipc.recording import write\n"
        "from tests.gateway.test_recording import recording\n"
        "for _ in range(15): print(write(Path(sys.argv[1]), recording())[0])"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    writers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    numbers = [int(line) for writer in writers for line in writer.communicate()[0].split()]
    assert sorted(numbers) == list(range(1, 31))
    assert [number for number, _ in files(tmp_path)] == list(range(1, 31))


def test_the_oldest_files_and_what_an_interrupted_writer_left_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KEPT", 3)
    (tmp_path / ".fault-000009-2026-01-01T00-00-00.mcap.new").write_text("half")
    _, first = write(tmp_path, recording())
    first.with_suffix(".png").write_text("its picture")
    (tmp_path / "notes.txt").write_text("somebody's own")
    for _ in range(4):
        write(tmp_path, recording())
    assert [number for number, _ in files(tmp_path)] == [3, 4, 5]
    assert sorted(path.suffix for path in tmp_path.iterdir()) == ["", ".mcap", ".mcap", ".mcap", ".txt"]


def test_a_full_disk_is_reported_and_leaves_nothing_of_the_file(tmp_path: Path) -> None:
    program = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from rtcp.ipc.recording import RecordingError, write\n"
        "from tests.gateway.test_recording import recording\n"
        "made = recording()\n"
        "made.records['actual_position'][:] = __import__('numpy').random.default_rng(1).random((50, 2))\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: write(Path(sys.argv[1]), made)\n"
        "except RecordingError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert f"{tmp_path}: no recording can be written there: File too large" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["last"]


def test_a_directory_that_cannot_be_made_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="no recording can be written there"):
        write(tmp_path / "file" / "faults", recording())
    with pytest.raises(RecordingError, match="cannot be read"):
        listed(tmp_path / "file")
    assert listed(tmp_path / "none") == []


def test_a_file_cut_off_anywhere_is_listed_as_damaged(tmp_path: Path) -> None:
    _, path = write(tmp_path, recording())
    whole = path.read_bytes()
    for length in [0, 1, 100, *range(200, len(whole), 997), len(whole) - 1]:
        path.write_bytes(whole[:length])
        (file,) = listed(tmp_path)
        assert file.about is None
        assert str(path) in file.trouble
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


def _written(path: Path, about: Any = None, **options: Any) -> None:
    """Write a file of the same form with other contents, as former versions did."""
    made = recording()
    timeline = [{"time_ns": 9, "message": "a sentence"}]
    about_json = {"format": module.FORMAT, "seconds": 0.0, **asdict(made.about), "timeline": timeline, **(about or {})}
    with open(path, "wb") as file:
        writer = Writer(file, compression=options.get("compression", CompressionType.ZSTD))
        writer.start()
        if about is not False:
            writer.add_metadata(
                options.get("metadata", "rtcp/about"), {"json": options.get("json", json.dumps(about_json))}
            )
        definition = options.get("definition", arm_schema(2).definition())
        channel = writer.register_channel("/cycle", "cdr", writer.register_schema("a", "ros2msg", definition))
        size = options.get("size", 4 + module.cycle_type(arm_schema(2)).itemsize)
        for number in range(options.get("cycles", CYCLES)):
            writer.add_message(channel, number, bytes(size), number)
        writer.finish()  # type: ignore[no-untyped-call]


FOREIGN: dict[str, dict[str, Any]] = {
    "no metadata": {"about": False},
    "metadata of another name": {"metadata": "other"},
    "metadata that is no JSON": {"json": "{"},
    "metadata that is no object": {"json": "[]"},
    "other joints": {"definition": arm_schema(3).definition()},
    "a cycle too short": {"size": 20},
    "another compression": {"compression": CompressionType.LZ4},
    "another format": {"about": {"format": 1}},
    "a truth for a number": {"about": {"at": True}},
    "a fault's cycle beyond the end": {"about": {"at": CYCLES}},
    "fewer cycles": {"cycles": 3},
    "an instant that no calendar has": {"about": {"time_ns": 10**40}},
    "a cycle of nothing": {"about": {"period_ns": 0}},
    "moments that are none": {"about": {"timeline": [3]}},
}


@pytest.mark.parametrize("options", FOREIGN.values(), ids=FOREIGN.keys())
def test_a_foreign_file_is_refused_with_its_name(tmp_path: Path, options: dict[str, Any]) -> None:
    _, path = write(tmp_path, recording())
    _written(path, **options)
    listed(tmp_path)
    with pytest.raises(RecordingError, match=path.name):
        read(path)


def test_a_recording_of_a_former_version_is_read(tmp_path: Path) -> None:
    path = tmp_path / "fault.mcap"
    _written(path)
    restored = read(path)
    assert restored.about == recording().about
    assert len(restored.records["cycle"]) == CYCLES


def test_a_chunk_that_unpacks_to_more_than_allowed_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, path = write(tmp_path, recording())
    monkeypatch.setattr(module, "_LARGEST", 1000)
    monkeypatch.setattr("zstandard.ZstdDecompressor", None)
    with pytest.raises(RecordingError, match="a chunk of"):
        read(path)
