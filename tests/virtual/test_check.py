"""Checks of a segment's file before the segment starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import default_config, load, segment_path
from rtcp.config.segment import load_segment
from rtcp.virtual.segment import check_segment
from tests.findings import assert_finds

MISTAKES = {
    "its form": (
        "slaves:\n- model: diewu-io\n- model: cubemars-orh70\n  drift: 3\n", ["4 slaves[1].drift: unknown"],
    ),
    "an unknown model": ("slaves:\n- model: diewu-io\n- model: toaster\n", ["3 slaves[1].model: choice found=toaster"]),
    "options that the model has not or not so": (
        "slaves:\n- model: diewu-io\n  options:\n    serial: 5\n    colour: 3\n    counter_rate: yes\n",
        ["5 slaves[0].options.colour: unknown_option", "6 slaves[0].options.counter_rate: range found=yes"],
    ),
    "a device whose process data are too long": (
        "slaves:\n- model: diewu-io\n- model: tests.virtual.file_models:TooLong\n", ["3 slaves[1].model: process_data"],
    ),
    "a delay that falls": (
        "slaves:\n- model: diewu-io\n  delay_ns: 900\n- model: diewu-io\n", ["4 slaves[1].delay_ns: delay_falls"],
    ),
}  # fmt: skip


@pytest.mark.parametrize(("text", "expected"), MISTAKES.values(), ids=MISTAKES.keys())
def test_every_mistake_is_named_with_file_line_and_key(tmp_path: Path, text: str, expected: list[str]) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text(text)
    assert_finds(lambda: check_segment(file), *expected)


def test_the_shipped_segment_has_no_mistakes_and_no_serial_number_twice() -> None:
    path = segment_path(load(default_config()))
    check_segment(path)
    serials = [str(slave.options.get("serial")) for slave in load_segment(path).slaves]
    assert sorted(serials) == list("1234567")
