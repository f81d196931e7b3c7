"""Recordings of the recorder's writers read back: whole, in spans, cut off; and files that are none."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove import Context

from rtcp.api.feed import Records
from rtcp.config import default_config, load
from rtcp.ipc.cycle_channels import CycleChannels, McapFile
from rtcp.ipc.observer import WARNING
from rtcp.ipc.recording import RecordingError, cycle_type, write
from rtcp.ipc.schema import PER_JOINT, Field, RecordSchema, arm_schema
from rtcp.ipc.states import DriveState
from rtcp.telemetry.channels import Channels, fields_of
from rtcp.telemetry.reading import Reader, read
from rtcp.telemetry.recorder import CsvWriter, McapWriter
from tests.gateway.test_recording import recording

CONFIG = load(default_config())
PERIOD_NS, OFFSET_NS = 500_000, 1_790_000_000_000_000_000
SCHEMA = arm_schema(6)


def cycles(count: int = 4000, first: int = 1000) -> Records:
    """Cycle records; every number of a joint tells cycle, field and joint apart."""
    made = np.zeros(count, cycle_type(SCHEMA))
    numbers = np.arange(first, first + count)
    made["number"] = made["cycle"] = numbers
    made["time_ns"] = 7_000_000_000 + numbers * PERIOD_NS
    made["wakeup_ns"] = numbers % 50_000
    for field, name in enumerate(PER_JOINT):
        made[name] = 1e-4 * numbers[:, None] + field + 0.1 * np.arange(6)
    made["drive_state"], made["statusword"] = DriveState.OPERATION_ENABLED, 0x1237
    return made


def mcap(path: Path, records: Records | None = None, signals: tuple[str, ...] = ()) -> Path:
    """Write records as the recorder does, in chunks of 500, with a message in the log after the first of them."""
    channels = Channels(CONFIG, SCHEMA, OFFSET_NS, signals)
    writer = McapWriter(channels, CONFIG)
    writer.open(path)
    given = cycles() if records is None else records
    for at in range(0, len(given), 500):
        writer.write(given[at : at + 500], given[at : at + 500])
        if at == 0:
            channels.log(int(given["time_ns"][250]) + OFFSET_NS, "a warning", WARNING)
        writer.flush()
    writer.close()
    return path


def csv(path: Path, records: Records | None = None, signals: tuple[str, ...] = ()) -> Path:
    writer = CsvWriter(SCHEMA, fields_of(SCHEMA, signals) if signals else ())
    writer.open(path)
    given = cycles() if records is None else records
    writer.write(given, given)
    writer.close()
    return path


OTHER = RecordSchema((
    *(SCHEMA[name] for name in ("number", "time_ns", "state")),
    Field("kiln_kelvin", "float32", "K", "Inside.", part="kiln"),
    replace(SCHEMA["actual_position"], shape=(2,)), Field("kiln_zones", "float64", "W", "Heat.", (3,), "kiln"),
))  # fmt: skip
"""Schema of another version or platform: unknown fields, and few of the known ones."""


def of_another_schema(path: Path) -> Path:
    """A recording of 1000 such cycles without a configuration."""
    rows = np.zeros(1000, cycle_type(OTHER))
    rows["number"] = np.arange(1000) + 1
    rows["time_ns"] = 7_000_000_000 + rows["number"] * PERIOD_NS
    rows["kiln_kelvin"] = 300 + rows["number"]
    rows["kiln_zones"] = rows["number"][:, None] * [1.0, 2.0, 3.0]
    channels = CycleChannels(OTHER, OFFSET_NS)
    file = McapFile(path, channels.context, {})
    channels.publish(rows)
    file.complete()
    return path


def test_a_recording_of_another_schema_is_read_with_all_that_it_has(tmp_path: Path) -> None:
    path = of_another_schema(tmp_path / "a.mcap")
    recording, reader = read(path), Reader(path)
    assert recording.records.dtype.names == OTHER.names
    assert recording.records["kiln_zones"][-1].tolist() == [1000.0, 2000.0, 3000.0]
    assert recording.period_s == pytest.approx(500e-6)
    assert len(list(reader)) >= 1
    assert reader.schema == OTHER
    with pytest.raises(
        RecordingError, match="there is no signal wkc in it; it has number, time_ns, state, kiln_kelvin"
    ):
        read(path, ["wkc"])


def test_a_recording_is_read_as_it_was_written(tmp_path: Path) -> None:
    written = cycles()
    recording = read(mcap(tmp_path / "a.mcap"))
    assert recording.config == CONFIG
    assert recording.about["arm"] == CONFIG.name
    for name in written.dtype.names or ():
        assert np.array_equal(recording.records[name], written[name]), name
    assert (recording.period_s, recording.missing, recording.truncated) == (pytest.approx(500e-6), 0, False)
    assert recording.seconds[[0, -1]] == pytest.approx([0.0, 3999 * 500e-6])
    assert [(line.message, line.level) for line in recording.log] == [("a warning", WARNING)]
    assert recording.log_s == (pytest.approx(250 * 500e-6),)


def test_chosen_signals_of_a_span_are_read_with_numbers_and_times(tmp_path: Path) -> None:
    recording = read(mcap(tmp_path / "a.mcap"), ["sent_*", "wakeup_ns"], 1.0, 1.5)
    assert recording.records.dtype.names == (
        "number", "time_ns", "wakeup_ns", "sent_position", "sent_velocity", "sent_torque"
    )  # fmt: skip
    assert recording.seconds[[0, -1]] == pytest.approx([1.0, 1.5])
    assert np.array_equal(recording.records["sent_velocity"], cycles()["sent_velocity"][2000:3001])
    assert recording.log == ()


def test_gaps_are_counted_also_in_a_recording_of_every_tenth_cycle(tmp_path: Path) -> None:
    tenth = cycles()[::10]
    recording = read(mcap(tmp_path / "a.mcap", np.delete(tenth, [5, 6, 7, 300])))
    assert (recording.missing, recording.period_s) == (4, pytest.approx(5e-3))


@pytest.mark.parametrize("signals", [(), ("*_position", "wakeup_ns")])
def test_csv_is_read_as_mcap_is_but_for_what_it_does_not_have(tmp_path: Path, signals: tuple[str, ...]) -> None:
    recording = read(csv(tmp_path / "a.csv", signals=signals), ["actual_position", "sent_position"], 0.5)
    wanted = cycles()[1000:]
    for name in ("actual_position", "sent_position"):
        assert recording.records[name] == pytest.approx(wanted[name], abs=1e-8)
    assert recording.seconds == pytest.approx(np.arange(1000, 4000) * 500e-6)
    assert (recording.config, recording.period_s, recording.missing) == (None, pytest.approx(500e-6), 0)


def test_a_fault_of_the_black_box_is_read_by_the_same_reader(tmp_path: Path) -> None:
    fault = recording()
    faulty = read(write(tmp_path, fault)[1], ["actual_position"])
    assert np.array_equal(faulty.records["actual_position"], fault.records["actual_position"])
    assert (faulty.about["fault"], faulty.config) == (fault.about.what, None)
    assert Reader(faulty.path).period_s == pytest.approx(500e-6)


@pytest.mark.parametrize("write_file", [mcap, csv])
def test_of_a_file_cut_off_anywhere_all_that_is_whole_is_read(tmp_path: Path, write_file: Any) -> None:
    path: Path = write_file(tmp_path / f"a.{write_file.__name__}")
    whole, read_before, refused = path.read_bytes(), 0, []
    chance = np.random.default_rng(3)
    for length in [0, 4, 8, *sorted(chance.integers(9, len(whole), 25)), len(whole) - 1]:
        path.write_bytes(whole[:length])
        try:
            recording = read(path, ["number"])
        except RecordingError as error:
            refused.append(error.kind)
            continue
        numbers = recording.records["number"].astype(int)
        assert recording.truncated or (path.suffix == ".csv" and whole[length - 1 : length] == b"\n")
        assert len(numbers) >= read_before
        assert np.array_equal(numbers - numbers[0], np.arange(len(numbers)))
        read_before = len(numbers)
    assert read_before >= 3999
    assert set(refused) <= {"damaged", "empty"}


def test_changed_bytes_are_read_up_to_there_or_refused(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap")
    whole = path.read_bytes()
    chance = np.random.default_rng(5)
    read_in_part = 0
    for at in chance.integers(0, len(whole), 40):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x5A]) + whole[at + 1 :])
        try:
            recording = read(path, ["actual_position"])
        except RecordingError:
            continue
        count = len(recording.records)
        assert np.array_equal(recording.records["actual_position"], cycles()["actual_position"][:count])
        read_in_part += recording.truncated
    assert read_in_part > 10


def test_one_field_of_many_cycles_needs_a_fraction_of_the_files_memory(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap", cycles(20_000))
    tracemalloc.start()
    recording = read(path, ["wakeup_ns"])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(recording.records) == 20_000
    assert peak < 4e6 < 20_000 * cycle_type(SCHEMA).itemsize / 2


def foreign(path: Path) -> Path:
    """A recording of another program: MCAP without cycles."""
    McapFile(path, Context(), {}).complete()
    return path


@pytest.mark.parametrize(
    ("make", "given", "kind", "said"),
    [
        (lambda p: p / "none.mcap", (), "refused", "the file cannot be read: No such file or directory"),
        (lambda p: p, (), "refused", "the file cannot be read: Is a directory"),
        (lambda p: _text(p / "a.mcap", "a text that is long enough"), (), "damaged", "no recording"),
        (lambda p: _text(p / "a.csv", "Time,temperature\n0,1\n"), (), "damaged", "those of a recording with Time"),
        (lambda p: _text(p / "a.csv", "Time,J1_pos\n0,1\n0.1,x\n"), (), "damaged", "no recording"),
        (lambda p: _text(p / "a.csv", "Time,J1_pos\n"), (), "empty", "the recording has no cycle"),
        (lambda p: foreign(p / "a.mcap"), (), "empty", "the recording has no cycle"),
        (lambda p: mcap(p / "a.mcap", cycles(0)), (), "empty", "the recording has no cycle"),
        (lambda p: mcap(p / "a.mcap"), (["speed"],), "signals", "there is no signal speed in it; it has number, cycle"),
        (lambda p: mcap(p / "a.mcap", signals=("wkc",)), (["lost"],), "signals", "it has number, time_ns, wkc"),
        (lambda p: mcap(p / "a.mcap"), ([], 5.0, 6.0), "empty", "no record from 5 to 6 s; it ends at 2.000 s"),
    ],
    ids=["no file", "a directory", "a text", "another table", "a row that is none", "CSV without rows", "foreign MCAP",
         "no cycle", "no such signal", "not in this file", "outside the span"],
)  # fmt: skip
def test_what_cannot_be_read_is_one_sentence_with_the_file(
    tmp_path: Path, make: Any, given: tuple[Any, ...], kind: str, said: str
) -> None:
    path = make(tmp_path)
    with pytest.raises(RecordingError) as raised:
        list(Reader(path, *given))
    assert raised.value.kind == kind
    assert str(raised.value).startswith(f"{path}: ")
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_a_configuration_of_another_version_is_none_and_the_records_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtcp.telemetry.recorder.to_json", lambda config: {"name": config.name, "new_key": 1})
    assert read(mcap(tmp_path / "a.mcap")).config is None
