"""An oscilloscope's file in the form of each maker gives the same cycle, and its figures are those of the thesis."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from rtcp.cli import experiment
from rtcp.cli.__main__ import main
from rtcp.config.find import default_config
from rtcp.telemetry.experiments.experiment import Row, Setup, carry_out, read_result
from rtcp.telemetry.experiments.oscilloscope import CaptureError, read_capture, toggles
from rtcp.telemetry.experiments.timing import SOURCE_CYCLES, OscilloscopeExperiment, spread

INTERVAL_S = 2e-6
START_S = -0.01


def signal(cycles_us: Sequence[float], slow_us: float = 0.0, noise_v: float = 0.0) -> list[float]:
    """Levels of an output that toggles after each of these cycles, rising last `slow_us` later than it is switched."""
    edges = np.cumsum([300.0, *cycles_us])
    samples = np.arange(0.0, edges[-1] + 300.0, INTERVAL_S * 1e6)
    switched = np.searchsorted(edges, samples, side="right") % 2
    delayed = np.searchsorted(edges, samples - slow_us, side="right") % 2
    levels = 0.1 + 4.8 * (switched & delayed)
    return list((levels + noise_v * np.random.default_rng(1).standard_normal(len(levels))).round(4))


def keysight(levels: Sequence[float]) -> str:
    rows = (f"{START_S + at * INTERVAL_S:+.6E},{level:+.5E}" for at, level in enumerate(levels))
    return "x-axis,1\nsecond,Volt\n" + "\n".join(rows) + "\n"


def tektronix(levels: Sequence[float]) -> str:
    head = [
        "Model,MDO3024", "Firmware Version,1.30", ",", "Waveform Type,ANALOG", "Point Format,Y", "Horizontal Units,s",
        f"Sample Interval,{INTERVAL_S}", f"Record Length,{len(levels)}", "Vertical Units,V", ",", "Label,", "TIME,CH1",
    ]  # fmt: skip
    return "\n".join((*head, *(f"{START_S + at * INTERVAL_S:.6e},{level}" for at, level in enumerate(levels))))


def tektronix_tds(levels: Sequence[float]) -> str:
    """Older models write the header into columns of their own beside the first rows."""
    head = [f"Record Length,{len(levels):e}", f"Sample Interval,{INTERVAL_S:e}", "Source,CH1", "Vertical Units,V"]
    head += [","] * (len(levels) - len(head))
    return "\r\n".join(
        f"{begin},,  {START_S + at * INTERVAL_S:.9f},  {level:.5f},"
        for at, (begin, level) in enumerate(zip(head, levels, strict=True))
    )


def rigol(levels: Sequence[float]) -> str:
    rows = (f"{at},{level:.4e},," for at, level in enumerate(levels))
    return f"X,CH1,Start,Increment,\nSequence,Volt,{START_S:e},{INTERVAL_S:e}\n" + "\n".join(rows)


def rigol_new(levels: Sequence[float]) -> str:
    rows = "\n".join(f"{level:.5e}," for level in levels)
    return f"CH1(V),t0 = {START_S:e}, tInc = {INTERVAL_S:e},\n{rows}\n"


def siglent(levels: Sequence[float]) -> str:
    head = [
        f"Record Length,Analog:{len(levels)}", f"Sample Interval,Analog:{INTERVAL_S:.12f}", "Vertical Units,CH1:V",
        "Vertical Scale,CH1:1.00", "Horizontal Units,S", "Model Number,SDS1104X-E", "Source,CH1", "Second,Volt",
    ]  # fmt: skip
    return "\n".join((*head, *(f"{START_S + at * INTERVAL_S:.11f},{level:.5f}" for at, level in enumerate(levels))))


def rigol_with_time(levels: Sequence[float]) -> str:
    """A column of time beside start and interval, which the newest models write both."""
    rows = "\n".join(f"{START_S + at * INTERVAL_S:.7e},{level:.5e},," for at, level in enumerate(levels))
    return f"Time(s),CH1(V),t0 = {START_S:e}, tInc = {INTERVAL_S:e},\n{rows}\n"


def lecroy(levels: Sequence[float]) -> str:
    head = [
        "LECROYWS434,12345,Waveform", f"Segments,1,SegmentSize,{len(levels)}", "Segment,TrigTime,TimeSinceSegment1",
        "#1,28-Nov-2026 10:00:00,0", "Time,Ampl",
    ]  # fmt: skip
    return "\n".join((*head, *(f"{START_S + at * INTERVAL_S:.6e},{level}" for at, level in enumerate(levels))))


def picoscope(levels: Sequence[float]) -> str:
    rows = (f"{1e6 * (START_S + at * INTERVAL_S):.4f},{level:.8f}" for at, level in enumerate(levels))
    return "Time,Channel A\n(µs),(V)\n\n" + "\n".join(rows) + "\n"


def with_index_and_remark(levels: Sequence[float]) -> str:
    rows = (f'{at},"{1e3 * (START_S + at * INTERVAL_S):.4f}",{level}' for at, level in enumerate(levels))
    return '"No.","Time, ms","CH1, V"\n' + "\n".join(rows) + "\n# end of the export\n\n"


def with_decimal_comma(levels: Sequence[float]) -> str:
    """In ms, as a spreadsheet saves it."""
    rows = (f"{1e3 * (START_S + at * INTERVAL_S):.4f};{level}" for at, level in enumerate(levels))
    return "Zeit;Kanal A\n(ms);(V)\n\n" + "\n".join(rows).replace(".", ",")


MAKERS = (
    keysight, tektronix, tektronix_tds, rigol, rigol_new, rigol_with_time, siglent, lecroy, picoscope,
    with_index_and_remark, with_decimal_comma,
)  # fmt: skip
CYCLES_US = [480.0, 520.0, 490.0, 530.0, 470.0, 510.0] * 20


@pytest.mark.parametrize("export", MAKERS, ids=lambda export: export.__name__)
def test_the_same_signal_in_each_makers_form_has_the_same_cycles(
    tmp_path: Path, export: Callable[[Sequence[float]], str]
) -> None:
    file = tmp_path / "scope.csv"
    file.write_text(export(signal(CYCLES_US)))
    capture = read_capture(file)
    edges, rises = toggles(capture)
    assert rises
    assert capture.resolution_us == pytest.approx(1e6 * INTERVAL_S, rel=1e-3)
    assert np.diff(edges) * 1e6 == pytest.approx(CYCLES_US, abs=1e6 * INTERVAL_S)


@pytest.mark.parametrize(
    ("header", "samples_per_s", "encoding"),
    [
        ("Time,Channel A\n(ms),(V)\n", 1e3, "utf-8"),
        ("Time,Channel A\n(us),(V)\n", 1e6, "utf-8"),
        ("Time,Channel A\n(µs),(V)\n", 1e6, "latin-1"),
        ("Time,Channel A\n(μs),(V)\n", 1e6, "utf-16"),
        ("Time,Channel A\n(ns),(V)\n", 1e9, "utf-8-sig"),
        ("Time\x85,Channel A (ms)\r\n(µs),(V)\r", 1e6, "latin-1"),
        ("Time [usec],CH1\n", 1e6, "utf-8"),
        ("Time (msec),CH1\n", 1e3, "utf-8"),
        ("Time (ms),1\n", 1e3, "utf-8"),
        ("millisecond,Volt\n", 1e3, "utf-8"),
        ("Model,MDO\nHorizontal Units,ms\nHorizontal Scale,0.4\nTIME,CH1\n", 1e3, "utf-8"),
        ("Time (ms),CH1\nSource,CH1\nCoupling,DC\nAttenuation,1x\nBandwidth,20M\n", 1e3, "utf-8"),
        ("Time Base (us),5\nTIME,CH1\n", 1.0, "utf-8"),
        ('"Time (ms), relative","CH1\n', 1e3, "utf-8"),
        ("", 1.0, "utf-8"),
    ],
)
def test_the_unit_of_the_time_is_found_wherever_the_header_states_it(
    tmp_path: Path, header: str, samples_per_s: float, encoding: str
) -> None:
    rows = [f"{samples_per_s * at * INTERVAL_S:.6f},{level}" for at, level in enumerate((0, 5, 0, 5, 0, 5))]
    (tmp_path / "scope.csv").write_text("\n".join([header, *rows[:2], "", ",", *rows[2:]]), encoding)
    capture = read_capture(tmp_path / "scope.csv")
    assert capture.seconds == pytest.approx(INTERVAL_S * np.arange(6))
    assert list(capture.levels) == [0, 5, 0, 5, 0, 5]


def test_samples_that_are_counted_have_the_time_of_their_number(tmp_path: Path) -> None:
    (tmp_path / "gap.csv").write_text("X,CH1,Start,Increment\nSequence,Volt,0.5,0.1\n0,1\n1,2\n4,3\n")
    assert read_capture(tmp_path / "gap.csv").seconds == pytest.approx([0.5, 0.6, 0.9])


def test_a_long_file_needs_no_object_of_python_for_each_number(tmp_path: Path) -> None:
    samples = 100_000
    (tmp_path / "long.csv").write_text("s,V\n" + "\n".join(f"{at / 1e6:.6f},{at % 2}" for at in range(samples)))
    tracemalloc.start()
    assert len(read_capture(tmp_path / "long.csv").levels) == samples
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most / samples < 200


def test_noise_makes_no_edges(tmp_path: Path) -> None:
    (tmp_path / "noisy.csv").write_text(keysight(signal(CYCLES_US, noise_v=0.3)))
    edges, _ = toggles(read_capture(tmp_path / "noisy.csv"))
    assert len(edges) == len(CYCLES_US) + 1


def test_another_channel_is_read_by_its_number(tmp_path: Path) -> None:
    (tmp_path / "two.csv").write_text("TIME,CH1,CH2\n0,1,5\n1e-6,2,6\n2e-6,3,7\n")
    assert list(read_capture(tmp_path / "two.csv", 2).levels) == [5, 6, 7]


@pytest.mark.parametrize(
    ("text", "channel", "kind", "line"),
    [
        ("", 1, "no_table", 0),
        ("x-axis,1\nsecond,Volt\n0,1\n", 1, "no_table", 3),
        ("second,Volt\n0,0\n1,0\n1,5\n2,5\n", 1, "time", 4),
        ("second,Volt\n0,0\n1,0\n2,5\n", 2, "channel", 0),
        ("second,Volt\n0,1\n1,1\n2,1\n3,1\n", 1, "no_edges", 0),
        ("second,Volt\n0,0\n1,0\n2,0\n3,5\n4,5\n", 1, "no_edges", 0),
        (keysight(list(np.random.default_rng(2).standard_normal(500))), 1, "no_edges", 0),
        ("# only a remark\n", 1, "no_table", 0),
        ("second,Volt\n0,1\n1,1\n2,1\n3\n", 1, "no_table", 5),
        ("(ms),(V)\n\n0,0\n1,nan\n2,5\n3,0\n", 1, "row", 4),
        ("(ms),(V)\n\n0,0\n1,5\n\n2,∞\n3,0\n", 1, "row", 6),
        ("(ms),(V)\n0,0\n1,5\n2,0\n3,-∞\n", 1, "row", 5),
        ("(ms),(V)\n0,0\n1,5\n2\n3,0\n", 1, "row", 4),
        ("(ms),(V)\n0,0\n1,5\nTime,CH1\n2,5\n3,0\n", 1, "row", 4),
        ('second,Volt\n0,0\n1,"5\n2,5\n3,0\n', 1, "row", 3),
        ('second,Volt\n"0,1","0,5"\n"0,2","0,5"\n"0,3","0,5"\n', 1, "no_table", 0),
        ("(ms),(V)\n0,0\n1,5\n2," + 200_000 * "5" + "x\n3,0\n", 1, "row", 4),
        ("Time (fortnights),CH1\n0,0\n1,5\n2,0\n", 1, "unit", 1),
        ("Horizontal Units,Hz\nTIME,CH1\n0,0\n1,5\n2,0\n", 1, "unit", 1),
        ("CH1(V),t0 = -,tInc = 1e-6\n0,\n5,\n0,\n", 1, "time", 1),
        ("CH1(V),t0 = 0,tInc = 1e,\n0,\n5,\n0,\n", 1, "time", 1),
        ("X,CH1,Start,Increment\nSequence,Volt,0,nan\n0,0\n1,5\n2,0\n", 1, "time", 2),
        ("X,CH1,\nSequence,Volt,\n0,0\n1,5\n3,0\n", 1, "time", 3),
    ],
)
def test_a_file_that_cannot_be_evaluated_is_a_typed_error(
    tmp_path: Path, text: str, channel: int, kind: str, line: int
) -> None:
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(CaptureError) as raised:
        toggles(read_capture(tmp_path / "bad.csv", channel))
    assert (raised.value.kind, raised.value.line) == (kind, line)


def test_a_file_that_is_missing_is_a_typed_error(tmp_path: Path) -> None:
    with pytest.raises(CaptureError) as raised:
        read_capture(tmp_path / "none.csv")
    assert raised.value.kind == "unreadable"


def evaluated(tmp_path: Path, target_us: float, levels: Sequence[float], config: str = "") -> dict[str, Row]:
    """Carry out the experiment with one file; return its rows by their figures."""
    (tmp_path / "scope.csv").write_text(keysight(levels))
    file = default_config().with_name(config) if config else default_config()
    repeated = OscilloscopeExperiment({target_us: tmp_path / "scope.csv"})
    carry_out(repeated, Setup(tmp_path, nullcontext, print, file), "a test")
    return {row.figure: row for row in read_result(tmp_path).rows}


def test_mean_error_and_average_deviation_of_a_file_are_those_of_its_cycles_beside_tables_7_and_8(
    tmp_path: Path,
) -> None:
    rows = evaluated(tmp_path, 500.0, signal([440.0, 480.0] * 50))
    mean, reading, error, deviation = rows.values()
    assert (mean.here, mean.source) == (pytest.approx(460.0, abs=0.1), 463.0)
    assert (reading.figure, reading.source) == ("500 us, oscilloscope: mean, robot in table 7", 460)
    assert (error.here, error.source) == (pytest.approx(8.0, abs=0.1), 7.4)
    assert (deviation.here, deviation.met) == (pytest.approx(20.0, abs=0.2), True)
    assert (tmp_path / "cycle.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("config", "setup", "source"),
    [("one_actuator.yaml", "single", 450), ("bench.yaml", "multiple", 460), ("assistive_arm.yaml", "robot", 460)],
)
def test_each_setup_of_the_thesis_has_a_file_and_its_own_column(
    tmp_path: Path, config: str, setup: str, source: float
) -> None:
    rows = evaluated(tmp_path, 500.0, signal([500.0] * 50), config)
    assert rows[f"500 us, oscilloscope: mean, {setup} in table 7"].source == source


def test_an_output_that_rises_slowly_keeps_the_mean_and_shows_in_the_deviation(tmp_path: Path) -> None:
    rows = evaluated(tmp_path, 500.0, signal([500.0] * 101, slow_us=40.0))
    assert rows["500 us, oscilloscope: mean"].here == pytest.approx(500.0, abs=1.0)
    assert rows["500 us, oscilloscope: average deviation"].here == pytest.approx(40.0, abs=1.0)
    assert any("high level lasts 460.0 us" in note for note in read_result(tmp_path).notes)


def test_the_percent_errors_of_the_thesis_are_those_of_its_means_but_one() -> None:
    differing = [
        target
        for target, (mean, percent, _) in SOURCE_CYCLES.items()
        if abs(spread(np.array([mean]), target)[1] - percent) > 0.1
    ]
    assert differing == [800.0]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["cycle", "--csv", "scope.csv"], "--csv scope.csv is not allowed: TARGET_US=FILE"),
        (["cycle", "--csv", "0=scope.csv"], "TARGET_US 0 is not allowed"),
        (["cycle", "--csv", "500=a.csv", "--csv", "500.0=b.csv"], "--csv has two files for 500 us: a.csv and b.csv"),
        (
            ["step", "--csv", "500=scope.csv"],
            "--csv is not an option of step: leave it out, or use",
        ),
        (["step", "--channel", "2"], "--channel is not an option of step"),
        (["cycle", "--channel", "1"], "--channel is the column of the files of --csv"),
        (["cycle", "--speed", "0.1"], "--speed is not an option of cycle"),
        (["picks", "--trials", "3"], "--trials is not an option of picks"),
        (["all", "--records", "study"], "--records is not an option of all"),
        (["joystick", "--trials", "3", "--records", "study"], "--trials is not allowed beside --records"),
        (["square", "--speed", "-1"], "--speed -1 is not allowed"),
    ],
)
def test_an_option_in_the_wrong_place_is_one_message(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.setattr(experiment, "_carry_out", lambda *_: pytest.fail("the experiment has begun"))
    monkeypatch.chdir(tmp_path)
    assert main(["experiment", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_the_command_evaluates_files_beside_a_running_platform(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scope.csv").write_text(siglent(signal([499.0, 501.0] * 30)))
    folder = tmp_path / "out"
    assert main(["experiment", "cycle", "--csv", f"500={tmp_path / 'scope.csv'}", "--out", str(folder)]) == 0
    assert "500 us, oscilloscope: average deviation" in capsys.readouterr().out
    assert read_result(folder).command == f"rtcp experiment cycle --csv 500={tmp_path / 'scope.csv'} --channel 1"
