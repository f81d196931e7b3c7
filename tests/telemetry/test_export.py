"""Recordings in other formats and as pictures: all records, and no lost peaks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rtcp.ipc.recording import RecordingError
from rtcp.telemetry import recorder
from rtcp.telemetry.export import export
from rtcp.telemetry.reading import Reader, read
from rtcp.telemetry.recording_plot import Envelope, figure

from .test_reading import OTHER, csv, cycles, mcap, of_another_schema


def test_mcap_of_a_span_has_the_records_numbers_times_topics_and_messages_of_the_original(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    path, out = mcap(tmp_path / "a.mcap"), tmp_path / "b.mcap"
    assert export(Reader(path, (), 0.1, 1.0), out) == 1801
    before, after = read(path, (), 0.1, 1.0), read(out)
    assert np.array_equal(before.records, after.records)
    assert (after.log, after.config) == (before.log, before.config)

    def times(file: Path, topic: str) -> list[int]:
        with open(file, "rb") as opened:
            return [message.log_time for _, _, message in make_reader(opened).iter_messages(topics=[topic])]

    for topic in ("/cycle", "/joint_states", "/joint_commands", "/joint_targets"):
        assert times(out, topic) == times(path, topic)[200:2001]
    assert times(out, "/tf")
    # A viewer's time begins where the recording does, also years later.
    assert times(out, "/robot_description")[0] <= times(out, "/cycle")[0]


def test_csv_is_that_of_the_recorder_or_the_chosen_signals(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap")
    export(Reader(path), tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_bytes() == csv(tmp_path / "wanted.csv").read_bytes()
    export(Reader(path, ["wkc", "*_torque"]), tmp_path / "c.csv")
    assert (tmp_path / "c.csv").read_text().partition("\n")[0].startswith("Time,number,time_ns,wkc,J1_tor,J2_tor")
    few = mcap(tmp_path / "few.mcap", signals=("actual_position",))
    export(Reader(few), tmp_path / "d.csv")
    assert read(tmp_path / "d.csv").records["number"][-1] == 4999


def test_npz_has_a_name_a_signal_and_seconds(tmp_path: Path) -> None:
    export(Reader(mcap(tmp_path / "a.mcap"), ["sent_position"], 1.0), tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as arrays:
        assert set(arrays) == {"seconds", "number", "time_ns", "sent_position"}
        assert np.array_equal(arrays["sent_position"], cycles()["sent_position"][2000:])
        assert arrays["seconds"][0] == pytest.approx(1.0)


def test_a_file_that_exists_is_kept_unless_it_is_to_be_replaced_and_the_recording_always(tmp_path: Path) -> None:
    path = mcap(tmp_path / "a.mcap")
    out = tmp_path / "b.csv"
    out.write_text("mine")
    with pytest.raises(RecordingError, match="the file exists"):
        export(Reader(path), out)
    assert out.read_text() == "mine"
    assert export(Reader(path), out, replace=True) == 4000
    with pytest.raises(RecordingError, match="is the recording itself"):
        export(Reader(path), path, replace=True)


@pytest.mark.parametrize("ending", ["csv", "mcap", "npz"])
def test_a_disk_that_refuses_leaves_nothing(tmp_path: Path, ending: str) -> None:
    path = mcap(tmp_path / "a.mcap")
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / f"b.{ending}"
    with pytest.raises(RecordingError, match=f"b.{ending}: it cannot be written: Not a directory"):
        export(Reader(path), out)


def test_an_error_in_the_middle_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = mcap(tmp_path / "a.mcap")
    written = 0

    def write(self: object, records: object, chosen: object) -> None:
        nonlocal written
        written += 1
        if written == 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(recorder.CsvWriter, "write", write)
    with pytest.raises(RecordingError, match="No space left on device"):
        export(Reader(path), tmp_path / "b.csv")
    assert [file.name for file in tmp_path.iterdir()] == ["a.mcap"]


def test_a_recording_of_another_schema_is_exported_and_drawn_with_its_units(tmp_path: Path) -> None:
    path = of_another_schema(tmp_path / "a.mcap")
    assert export(Reader(path), tmp_path / "b.csv") == export(Reader(path), tmp_path / "b.npz") == 1000
    with open(tmp_path / "b.csv") as table:
        assert (
            table.readline()
            == "Time,number,time_ns,state,kiln_kelvin,J1_pos,J2_pos,J1_kiln_zones,J2_kiln_zones,J3_kiln_zones\n"
        )
    again = read(tmp_path / "b.csv")
    assert again.records["kiln_zones"][-1].tolist() == [1000.0, 2000.0, 3000.0]
    with np.load(tmp_path / "b.npz") as arrays:
        assert set(arrays) == {*OTHER.names, "seconds"}
    drawn = figure(Reader(path))
    assert [axes.get_ylabel() for axes in drawn.axes] == ["actual position\nrad"]
    drawn = figure(Reader(path, ["kiln_*"]))
    assert [axes.get_ylabel() for axes in drawn.axes] == ["kiln kelvin\nK", "kiln zones\nW"]


@pytest.mark.parametrize(
    ("source", "said"), [("a.csv", "it has no configuration of this version"), ("b.mcap", "it lacks cycle, dc_time_ns")]
)
def test_mcap_is_not_made_of_what_lacks_signals_or_the_configuration(tmp_path: Path, source: str, said: str) -> None:
    path = csv(tmp_path / source) if source.endswith("csv") else mcap(tmp_path / source, signals=("wkc", "held"))
    with pytest.raises(RecordingError, match=said):
        export(Reader(path), tmp_path / "out.mcap")


def test_an_envelope_keeps_the_extremes_of_any_number_of_values_in_rising_time() -> None:
    chance = np.random.default_rng(1)
    values = chance.normal(size=(50_000, 2))
    values[31_234, 1] = 99.0
    envelope = Envelope(1e-3, 2)
    for at in range(0, len(values), 700):
        part = values[at : at + 700]
        envelope.add(np.arange(at, at + len(part), dtype=np.float64) * 1e-3, part)
    times, drawn = envelope.curve()
    assert len(times) <= 8192
    assert (np.diff(times) >= 0).all()
    assert (drawn.min(axis=0) == values.min(axis=0)).all()
    assert times[drawn[:, 1].argmax()] == pytest.approx(31.234, abs=0.02)


def test_a_peak_of_one_cycle_in_many_is_in_the_picture_with_states_and_warnings(tmp_path: Path) -> None:
    records = cycles(20_000)
    records["actual_torque"][12_345, 2] = 50.0
    records["state"][15_000:] = 8
    drawn = figure(Reader(mcap(tmp_path / "a.mcap", records)))
    (torque,) = (axes for axes in drawn.axes if axes.get_ylabel() == "actual torque\nNm")
    highest = {line.get_label(): np.max(line.get_ydata()) for line in torque.lines}
    assert highest["joint3"] == 50.0
    assert highest["joint2"] < 10.0
    assert {text.get_text() for text in drawn.axes[0].texts} == {"fault", "a warning"}
    assert [axes.get_ylabel() for axes in drawn.axes][2] == "following error\nrad"


def test_the_following_error_of_a_joint_that_does_what_the_frame_before_said_is_zero_also_beside_a_gap(
    tmp_path: Path,
) -> None:
    records = cycles(2000)
    records["actual_position"][1:] = records["sent_position"][:-1]
    records["actual_position"][0] = records["sent_position"][0]
    records["actual_position"][1500, 1] += 0.25
    kept = np.concatenate((records[:700], records[900:]))
    drawn = figure(Reader(mcap(tmp_path / "a.mcap", kept)))
    (error,) = (axes for axes in drawn.axes if axes.get_ylabel() == "following error\nrad")
    lines = {line.get_label(): np.asarray(line.get_ydata()) for line in error.lines}
    assert np.abs(lines["joint1"]).max() == 0.0
    assert np.abs(lines["joint2"]).max() == pytest.approx(0.25)


def test_chosen_signals_of_a_span_are_drawn_each_by_itself(tmp_path: Path) -> None:
    drawn = figure(Reader(csv(tmp_path / "a.csv"), ["actual_velocity", "sent_position"], 0.5, 1.0))
    assert [axes.get_ylabel() for axes in drawn.axes] == ["actual velocity\nrad/s", "sent position\nrad"]
    times = drawn.axes[0].lines[0].get_xdata()
    assert (np.min(times), np.max(times)) == pytest.approx((0.5, 1.0), abs=1e-3)
