"""A cell whose gateway is frozen or has ended: an interrupt ends, and a stop reaches the loops."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from rtcp.api import cell as module
from rtcp.api.cell import Cell
from rtcp.ipc.commands import Halt
from rtcp.ipc.errors import NotRunning
from rtcp.ipc.runtime_directory import blackboard_file
from tests.gateway.fake_loop import RunningLoop


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


def test_a_halt_reaches_the_loop_of_an_arm_whose_gateway_has_ended(tmp_path: Path) -> None:
    loop = RunningLoop(blackboard_file(tmp_path))
    cell = object.__new__(Cell)
    cell.arms, cell.processes = {"left": SimpleNamespace(directory=tmp_path)}, {}  # type: ignore[dict-item]
    cell._name = "a test"
    try:
        with pytest.raises(NotRunning, match=r"^left: 'halt' was requested and the loop has taken it") as raised:
            cell.halt()
        assert raised.value.fields == {"stop_taken": True}
        assert loop.kinds == [Halt]
    finally:
        loop.end()
        blackboard_file(tmp_path).unlink()
