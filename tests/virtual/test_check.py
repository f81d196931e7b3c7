"""The segment's file before a segment is made of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import ConfigError, default_config, load, segment_path
from rtcp.config.segment import load_segment
from rtcp.virtual.segment import check_segment

MISTAKES = {
    "its form": (
        "slaves:\n- model: diewu-io\n- model: cubemars-orh70\n  drift: 3\n",
        ["4: slaves[1].drift: this key does not exist; did you mean drift_ppm?"],
    ),
    "an unknown model": (
        "slaves:\n- model: diewu-io\n- model: toaster\n",
        ['3: slaves[1].model: found the text "toaster", allowed is one of cubemars-orh40, cubemars-orh50'],
    ),
    "options that the model has not or not so": (
        "slaves:\n- model: diewu-io\n  options:\n    serial: 5\n    colour: 3\n    counter_rate: yes\n",
        [
            "5: slaves[0].options.colour: the model has no option 'colour'; it has: serial",
            '6: slaves[0].options.counter_rate: found the text "yes", allowed is a number',
        ],
    ),
    "a device whose process data are too long": (
        "slaves:\n- model: diewu-io\n- model: tests.virtual.file_models:TooLong\n",
        ["3: slaves[1].model: the process data of tests.virtual.file_models:TooLong cannot be laid out: the PDOs"],
    ),
    "a delay that falls": (
        "slaves:\n- model: diewu-io\n  delay_ns: 900\n- model: diewu-io\n",
        ["4: slaves[1].delay_ns: found 820 ns, allowed is at least the 900 ns of the slave before it"],
    ),
}


@pytest.mark.parametrize(("text", "sentences"), MISTAKES.values(), ids=MISTAKES.keys())
def test_every_mistake_is_named_with_file_line_and_key(tmp_path: Path, text: str, sentences: list[str]) -> None:
    file = tmp_path / "segment.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        check_segment(file)
    for problem, sentence in zip(caught.value.problems, sentences, strict=True):
        assert problem.startswith(f"{file}:{sentence}")


def test_the_shipped_segment_has_no_mistakes_and_no_serial_number_twice() -> None:
    path = segment_path(load(default_config()))
    check_segment(path)
    serials = [slave.options.get("serial") for slave in load_segment(path).slaves]
    assert sorted(serials) == list(range(1, 8))
