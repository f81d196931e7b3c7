"""The file of the virtual segment."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import ConfigError, default_config, load, load_segment, segment_path
from rtcp.virtual.models import create


def test_the_default_segment_has_a_slave_for_every_slave_of_the_arm() -> None:
    arm = load(default_config())
    segment = load_segment(segment_path(arm))
    assert len(segment.slaves) == len(arm.slaves)
    assert [slave.model.split("-")[0] for slave in segment.slaves] == ["diewu"] + ["cubemars"] * 6


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
    "no slaves": ("slaves: []", "slaves: found an empty list, allowed is a list with at least one entry"),
    "no model": (
        "slaves: [{alias: 1}]",
        "slaves[0]: found none of them, allowed is one of model, esi and sii",
    ),
    "an unknown key": (
        "slaves: [{model: m, drift: 3}]",
        "slaves[0].drift: this key does not exist; did you mean drift_ppm? allowed are model, esi, sii, product, "
        "revision, modules, behaviour, name, after, port, drift_ppm, delay_ns, alias, options",
    ),
    "a wild drift": (
        "slaves: [{model: m, drift_ppm: 5000}]",
        "slaves[0].drift_ppm: found 5000, allowed is a number from -1000 to 1000",
    ),
    "a delay before time": (
        "slaves: [{model: m, delay_ns: -1}]",
        "slaves[0].delay_ns: found -1, allowed is an integer from 0 to 1000000",
    ),
    "one alias for two": (
        "slaves: [{model: m, alias: 7}, {model: m, alias: 7}]",
        "slaves[1].alias: found 7, the alias of slaves[0]; each needs its own, or 0 for none",
    ),
    "options that are no mapping": (
        "slaves: [{model: m, options: [1]}]",
        "slaves[0].options: found a list, allowed is a mapping",
    ),
    "an option that is a list": (
        "slaves: [{model: m, options: {a: [1]}}]",
        "slaves[0].options.a: found a list, allowed is a text, a number, true or false",
    ),
    "an option without a number": (
        "slaves: [{model: m, options: {a: .nan}}]",
        "slaves[0].options.a: found nan, allowed is a text, a number, true or false",
    ),
}


@pytest.mark.parametrize(("text", "sentence"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_in_the_segments_file_is_named(tmp_path: Path, text: str, sentence: str) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text(text + "\n")
    with pytest.raises(ConfigError) as caught:
        load_segment(file)
    assert caught.value.problems == [f"{file}:1: {sentence}"]


def test_every_model_and_option_of_the_default_segment_exists_and_is_the_device_that_the_arm_expects() -> None:
    arm = load(default_config())
    for expected, slave in zip(arm.slaves, load_segment(segment_path(arm)).slaves, strict=True):
        identity = create(slave.model, **slave.options).identity
        found = (identity.vendor_id, identity.product_code)
        assert found == (expected.device.vendor_id, expected.device.product_id)
