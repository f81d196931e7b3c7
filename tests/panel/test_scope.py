"""The scope on records: its triggers, its ends, and that no peak is lost by decimation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rtcp.api import Invalid
from rtcp.config.find import default_config
from rtcp.config.loader import load
from rtcp.ipc.recording import cycle_type
from rtcp.ipc.schema import Field, RecordSchema, arm_schema
from rtcp.panel.scope import COLUMNS, LONGEST_S, SHORTEST_S, Scope, signals_of

PERIOD_NS = 500_000


def cycles(count: int, begin: int = 0) -> Any:
    schema = RecordSchema((*arm_schema(6).fields, Field("io_inputs", "uint32", part="io")))
    records = np.zeros(count, dtype=cycle_type(schema))
    records["time_ns"] = (np.arange(count) + begin) * PERIOD_NS
    return records


def scope(span_s: float, trigger: str = "", level: float = 0.0) -> Scope:
    return Scope(
        signals_of(load(default_config()), arm_schema(6)), ["actual_position.0"], span_s, trigger, level, PERIOD_NS
    )


@pytest.mark.parametrize("span_s", [SHORTEST_S, 1.0, LONGEST_S])
def test_a_peak_of_one_cycle_is_shown_at_every_time_base(span_s: float) -> None:
    count = int(span_s * 1e9 / PERIOD_NS)
    records = cycles(2 * count)
    records["actual_position"][count + count // 3, 0] = 1.0
    records["actual_position"][count + count // 2, 0] = -1.0
    picture = scope(span_s)
    for part in np.array_split(records, 50):
        picture.read(part)
    block = picture.block()
    assert block is not None
    assert len(block["t"]) <= 2 * COLUMNS
    assert (min(block["y"][0]), max(block["y"][0])) == (-1.0, 1.0)
    assert block["t"][0] == pytest.approx(-span_s, rel=0.01)
    peak = block["t"][block["y"][0].index(1.0)]
    assert peak == pytest.approx(-span_s * 2 / 3, abs=max(span_s / COLUMNS, 2e-3))


@pytest.mark.parametrize(
    ("trigger", "field", "value"), [("state", "state", 3), ("inputs", "io_inputs", 4), ("fault", "fault", 1)]
)
def test_an_event_holds_the_picture(trigger: str, field: str, value: int) -> None:
    picture = scope(1.0, trigger)
    picture.read(cycles(3000))
    assert picture.block() is None
    records = cycles(3000, 3000)
    records[field][1000:] = value
    records["actual_position"][1000:, 0] = 1.0
    picture.read(records)
    block = picture.block()
    assert block is not None
    assert block["t"][0] == pytest.approx(-0.2, abs=2e-3)
    assert all(y == float(t >= 0.0) for t, y in zip(block["t"], block["y"][0], strict=True) if abs(t) > 4e-3)
    assert picture.block() is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0.019, "", 0.0), "0.02 to 60 s"), ((61.0, "", 0.0), "0.02 to 60 s"), ((1.0, "speed", 0.0), 'found "speed"')],
)
def test_what_cannot_be_shown_is_refused(arguments: tuple[float, str, float], message: str) -> None:
    with pytest.raises(Invalid, match=message):
        scope(*arguments)
