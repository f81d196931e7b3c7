"""Shared by the tests of described slaves: a segment in a process, and a master without device descriptions."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtcp.virtual.objects import SdoAbort
from tests.forked import Forked, answer_of

ROOT = Path(__file__).parents[2]
VENDOR = Path(__file__).with_name("vendor.xml")

Master = Callable[..., dict[str, Any]]


@pytest.fixture
def master(tmp_path: Path) -> Master:
    """Bring a segment of these entries (YAML) to OP with pysoem, send outputs (hex); return the master's result."""

    def run(*entries: str, outputs: tuple[str, ...] = ()) -> dict[str, Any]:
        config = tmp_path / "segment.yaml"
        config.write_text("slaves:\n" + "".join(f"- {{{entry}}}\n" for entry in entries), encoding="utf-8")
        with segment(config) as pid:
            result: dict[str, Any] = answer_of("tests.virtual.any_child", str(pid), "ecat0", *outputs)
        return result

    return run


def abort_of(call: Callable[..., object], *arguments: object) -> int:
    """Return the code with which an SDO service is aborted."""
    with pytest.raises(SdoAbort) as caught:
        call(*arguments)
    return caught.value.code


@contextmanager
def segment(config: Path, *options: str) -> Iterator[int]:
    """Run a segment's process."""
    process = Forked("rtcp.virtual", "--config", str(config), *options)
    try:
        yield int(json.loads(process.line())["pid"])
    finally:
        process.end()


def described(product: int, more: str = "") -> str:
    """Return the entry of a slave of `vendor.xml`."""
    return f"esi: {VENDOR}, product: {product}{', ' if more else ''}{more}"
