"""What tests of described slaves share: a segment in a process, and a master that knows no device."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
VENDOR = Path(__file__).with_name("vendor.xml")

Master = Callable[..., dict[str, Any]]


@pytest.fixture
def master(tmp_path: Path) -> Master:
    """Bring a segment of these entries (YAML) to OP with pysoem, send outputs (hex); return what it found."""

    def run(*entries: str, outputs: tuple[str, ...] = ()) -> dict[str, Any]:
        config = tmp_path / "segment.yaml"
        config.write_text("slaves:\n" + "".join(f"- {{{entry}}}\n" for entry in entries), encoding="utf-8")
        with segment(config) as pid:
            command = [sys.executable, str(Path(__file__).with_name("any_child.py")), str(pid), "ecat0", *outputs]
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT)
        found: dict[str, Any] = json.loads(done.stdout)
        return found

    return run


@contextmanager
def segment(config: Path, *options: str) -> Iterator[int]:
    """Run a segment's process."""
    command = [sys.executable, "-m", "rtcp.virtual", "--config", str(config), *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert process.stdout is not None
        yield int(json.loads(process.stdout.readline())["pid"])
    finally:
        process.kill()
        process.communicate()


def described(product: int, more: str = "") -> str:
    """Return the entry of a slave of `vendor.xml`."""
    return f"esi: {VENDOR}, product: {product}{', ' if more else ''}{more}"
