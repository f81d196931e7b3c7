"""A cell whose gateway is frozen: an interrupt halts the others, and ends."""

from __future__ import annotations

import signal
import threading
from types import SimpleNamespace

import pytest

from rtcp.api import cell as module
from rtcp.api.cell import Cell


def test_an_interrupt_ends_though_an_arm_and_its_halt_do_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    frozen, halted = threading.Event(), threading.Event()

    def halt(cell: Cell) -> None:
        halted.set()
        frozen.wait()

    monkeypatch.setattr(module, "_INTERRUPT_S", 0.3)
    monkeypatch.setattr(Cell, "halt", halt)
    cell = object.__new__(Cell)
    cell.arms = {"left": SimpleNamespace(status=frozen.wait)}  # type: ignore[dict-item]
    cell.processes = {}
    main = threading.main_thread().ident
    assert main is not None
    threading.Timer(0.1, signal.pthread_kill, (main, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        cell._all(lambda name, robot: robot.status())
    assert halted.is_set()
    frozen.set()
