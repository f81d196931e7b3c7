"""The table that `rtcp demo` ends with."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.table import Table

from rtcp.cli.status_view import ABSENT, realtime_line


def table(status: Mapping[str, Any], start_to_op_s: float | None, cycle_mean_ns: float | None) -> Table:
    """Return the figures of a run: a row each, what is not known as a dash.

    Args:
        status: the platform's last status, before the drives were disabled.
        start_to_op_s: from the command to all slaves in OP, s.
        cycle_mean_ns: mean cycle, ns, as counted between two instants.
    """
    figures = Table(box=box.SIMPLE_HEAD, title="rtcp demo", title_justify="left", show_edge=False)
    figures.add_column("what")
    figures.add_column("found")
    target = _number(status.get("cycle_ns"))
    figures.add_row("state", str(status.get("state", ABSENT)))
    figures.add_row("cycle, target", _microseconds(target, 3))
    figures.add_row("cycle, mean", _mean(target, cycle_mean_ns))
    figures.add_row("cycles, missed", f"{status.get('cycles', ABSENT)}, {status.get('missed', ABSENT)}")
    for label, key in (("wake-up", "wakeup_us"), ("exchange", "exchange_us"), ("compute", "compute_us")):
        found = status.get(key)
        values = found if isinstance(found, dict) else {}
        shown = " / ".join(_plain(values.get(quantile)) for quantile in ("p50", "p99", "max"))
        figures.add_row(f"{label} p50 / p99 / max", f"{shown} us")
    clocks = status.get("dc")
    _add_clocks(figures, clocks if isinstance(clocks, dict) else {})
    figures.add_row("start to OP", ABSENT if start_to_op_s is None else f"{start_to_op_s:.2f} s")
    realtime = status.get("realtime")
    figures.add_row("real time", realtime_line(realtime if isinstance(realtime, dict) else {}))
    return figures


def _add_clocks(figures: Table, clocks: Mapping[str, Any]) -> None:
    locked = "locked" if clocks.get("locked") else "not locked"
    offsets = []
    for key, label in (("filtered_us", "filtered"), ("offset_us", "raw")):
        found = clocks.get(key)
        if isinstance(found, dict):
            offsets.append(f"{label} p99 {_plain(found.get('p99'))} us")
    figures.add_row("clock offset", ", ".join([locked, *offsets]))


def _mean(target_ns: float | None, mean_ns: float | None) -> str:
    if mean_ns is None:
        return ABSENT
    if not target_ns:
        return _microseconds(mean_ns, 3)
    return f"{_microseconds(mean_ns, 3)} ({(mean_ns / target_ns - 1) * 100:+.4f} %)"


def _microseconds(value_ns: float | None, digits: int = 1) -> str:
    return ABSENT if value_ns is None else f"{value_ns / 1000:.{digits}f} us"


def _plain(value: object) -> str:
    number = _number(value)
    return ABSENT if number is None else f"{number:.1f}"


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None
