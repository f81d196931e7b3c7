"""The file of the virtual segment."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import default_config, load, load_segment, segment_path
from rtcp.virtual.models import create
from tests.findings import assert_finds


def test_the_default_segments_clocks_drift_apart_by_up_to_20_ppm() -> None:
    drifts = [slave.drift_ppm for slave in load_segment(segment_path(load(default_config()))).slaves]
    assert len(set(drifts)) == len(drifts)
    assert (min(drifts), max(drifts)) == (-20, 20)


def test_a_slave_needs_only_its_model(tmp_path: Path) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text("slaves:\n  - model: diewu-io\n")
    slave = load_segment(file).slaves[0]
    assert (slave.drift_ppm, slave.delay_ns, slave.alias, slave.options) == (0.0, None, 0, {})


def test_options_keep_their_types(tmp_path: Path) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text("slaves: [{model: m, options: {a: 1, b: 0.5, c: text, d: true}}]\n")
    options = load_segment(file).slaves[0].options
    assert options == {"a": 1, "b": 0.5, "c": "text", "d": True}
    assert [type(value) for value in options.values()] == [int, float, str, bool]


MISTAKES = {
    "no slaves": ("slaves: []", "1 slaves: length"),
    "no model": ("slaves: [{alias: 1}]", "1 slaves[0]: one_of_keys"),
    "an unknown key": ("slaves: [{model: m, drift: 3}]", "1 slaves[0].drift: unknown"),
    "a wild drift": ("slaves: [{model: m, drift_ppm: 5000}]", "1 slaves[0].drift_ppm: range"),
    "a delay before time": ("slaves: [{model: m, delay_ns: -1}]", "1 slaves[0].delay_ns: range"),
    "one alias for two": (
        "slaves: [{model: m, alias: 7}, {model: m, alias: 7}]",
        "1 slaves[1].alias: repeated of=slaves[0].alias",
    ),
    "options that are no mapping": ("slaves: [{model: m, options: [1]}]", "1 slaves[0].options: type"),
    "an option that is a list": ("slaves: [{model: m, options: {a: [1]}}]", "1 slaves[0].options.a: type"),
    "an option without a number": ("slaves: [{model: m, options: {a: .nan}}]", "1 slaves[0].options.a: type"),
}


@pytest.mark.parametrize(("text", "expected"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_in_the_segments_file_is_named(tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text(text + "\n")
    assert_finds(lambda: load_segment(file), expected)


def test_every_model_and_option_of_the_default_segment_exists_and_is_the_device_that_the_arm_expects() -> None:
    arm = load(default_config())
    for expected, slave in zip(arm.slaves, load_segment(segment_path(arm)).slaves, strict=True):
        identity = create(slave.model, **slave.options).identity
        codes = (identity.vendor_id, identity.product_code)
        assert codes == (expected.device.vendor_id, expected.device.product_id)
