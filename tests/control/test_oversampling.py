"""A terminal of several values a cycle, made from an ESI and set up by a file from it, on the in-process bus."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.config import default_config, load, load_segment, segment_path
from rtcp.config.device_file import file_text
from rtcp.config.loader import load_device
from rtcp.config.model import ConfigError, SlaveConfig
from rtcp.config.rules import period_findings
from rtcp.config.segment import SegmentSlave
from rtcp.esi.reader import find_device, read_esi
from rtcp.fieldbus.errors import BusError
from rtcp.ipc.states import State
from rtcp.telemetry.experiments.experiment import Setup
from rtcp.telemetry.experiments.oversampling import OversamplingExperiment
from rtcp.testing.simulation import Simulation

FILES = Path(__file__).resolve().parents[1] / "esi" / "files"
ESI = FILES / "analog.xml"
SAMPLING = FILES / "sampling.xml"
"""A terminal with a PDO for each value (OSIndexInc), and a cycle count beside them."""
SHIPPED = load(default_config())
SLOT = len(SHIPPED.slaves)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "analog.yaml"
    text = file_text(find_device(read_esi(ESI)), mode="DcOversampling")
    path.write_text(text.replace("name: value_in", "name: measured").replace("name: enable_in", "name: alive"))
    return path


@contextmanager
def with_terminal(file: Path, esi: Path) -> Iterator[Simulation]:
    slaves = (*SHIPPED.slaves, SlaveConfig("probe", load_device(file)))
    config = replace(SHIPPED, slaves=slaves, cycle=replace(SHIPPED.cycle, period_us=1000.0))
    segment = load_segment(segment_path(SHIPPED))
    segment = replace(segment, slaves=(*segment.slaves, SegmentSlave(esi=str(esi))))
    with Simulation(config, segment=segment, follow_clock=False) as made:
        made.bring_to(State.READY)
        made.run(0.1)
        yield made


@pytest.fixture
def arm(file: Path) -> Iterator[Simulation]:
    with with_terminal(file, ESI) as made:
        yield made


def measured(arm: Simulation, name: str = "measured") -> float:
    arm.run(0.01)
    record = arm.observer.latest()
    assert record is not None
    return float(record[f"probe_{name}"][0])


def test_the_value_of_a_channel_is_the_mean_of_its_samples(arm: Simulation) -> None:
    device = arm.bus.slaves[SLOT].device
    assert [int(device.objects[0x1C13, n].value) for n in range(11)] == [10, *[0x1A00] * 10]
    entry = device.objects[0x6000, 2]
    entry.value = 700
    assert measured(arm) == pytest.approx(700.0)
    entry.samples = [-5, 5, 100, 200, 0, 0, 0, 0, 300, 400]
    assert measured(arm) == pytest.approx(100.0)
    record = arm.observer.latest()
    assert record is not None
    assert [name for name in record.dtype.names if name.startswith("probe_")].count("probe_measured") == 1


def test_each_value_may_have_a_pdo_and_an_object_of_its_own_beside_a_single_cycle_count(tmp_path: Path) -> None:
    file = tmp_path / "sampling.yaml"
    file.write_text(file_text(find_device(read_esi(SAMPLING)), mode="DcSync8"))
    with with_terminal(file, SAMPLING) as arm:
        slave = arm.bus.slaves[SLOT]
        objects = slave.device.objects
        first, second = range(0x1A00, 0x1A08), range(0x1A80, 0x1A88)
        assert [int(objects[0x1C13, n].value) for n in range(19)] == [18, 0x1B00, *first, 0x1B01, *second]
        assert slave.input_bytes == 36
        # ETG.1000.4, 6.8.5: SYNC0 eight times a cycle, SYNC1 with every eighth.
        assert slave.read(0, 0x09A0, 8) == struct.pack("<II", 125_000, 875_000)
        for n, value in enumerate((-5, 5, 100, 200, 0, 0, 300, 200)):
            objects[0x6000 + 16 * n, 1].value = value
            objects[0x6000 + 16 * n, 2].value = 7
        objects[0x6800, 1].value = 1234
        values = [measured(arm, name) for name in ("ch1_value", "ch2_value", "ch1_cycle_count", "ch2_cycle_count")]
        assert values == pytest.approx([100.0, 7.0, 1234.0, 0.0])


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("kind: generic", "kind: encoder", "kinds analog and generic alone"),
        ("  - index: 0x1600", "  - index: 0x1600\n    samples: 2", "kinds analog and generic alone"),
        ("name: measured", "name: measured, modulo: 100", "which has no mean"),
        ("samples: 10", "samples: 0", "samples"),
        ("samples: 10", "samples: 10\n    sample_increment: 8191", "index 0x17FF7 for the last of 10 values"),
    ],
)
def test_samples_of_what_has_no_mean_are_refused(file: Path, old: str, new: str, sentence: str) -> None:
    text = file.read_text().replace("kind: analog", "kind: generic")
    assert old in text
    file.write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=sentence):
        load_device(file)


def test_of_further_values_the_start_compares_pdos_and_lengths(tmp_path: Path) -> None:
    file = tmp_path / "sampling.yaml"
    text = file_text(find_device(read_esi(SAMPLING)), mode="DcSync8")
    # Other objects than the terminal maps, as some ESI files have them.
    file.write_text(text.replace("sample_increment: 16", "sample_increment: 1"))
    with with_terminal(file, SAMPLING) as arm:
        arm.bus.slaves[SLOT].device.objects[0x6000 + 16 * 7, 1].value = 80
        assert measured(arm, "ch1_value") == pytest.approx(10.0)
    for old, new in (("sub_index: 2, type: int16", "sub_index: 3, type: int16"), ("type: int16", "type: int32")):
        file.write_text(text.replace(old, new))
        with pytest.raises(BusError, match="differs from the device's file"), with_terminal(file, SAMPLING):
            pass


def test_a_pdo_among_those_of_further_values_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "sampling.yaml"
    text = file_text(find_device(read_esi(SAMPLING)), mode="DcSync8")
    file.write_text(text.replace("index: 0x1A80", "index: 0x1A07"))
    with pytest.raises(ConfigError, match="found 0x1a07, the index of tpdo"):
        load_device(file)


def test_a_period_that_sync0_does_not_divide_in_whole_ns_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "sampling.yaml"
    file.write_text(file_text(find_device(read_esi(SAMPLING)), mode="DcSync8"))
    device = load_device(file)
    assert not list(period_findings(device, 1000.0))
    assert [finding.where for finding in period_findings(device, 333.3)] == [("sync0_factor",)]


def test_the_noise_of_the_mean_falls_with_the_root_of_the_samples(tmp_path: Path) -> None:
    setup = Setup(tmp_path, lambda options: None, lambda text: None)
    rows = {row.figure: row for row in OversamplingExperiment(0.5).run(setup)}
    assert [rows[f"{name}: ratio of the two"].met for name in ("voltage", "current")] == [True, True]
    assert rows["voltage: one conversion a cycle, standard deviation"].here == pytest.approx(35.8, rel=0.1)
    assert rows["voltage: 15 conversions a cycle, averaged over 10 ms"].here < 4.0
