"""A cell on in-process buses: the loops of all its arms in one process and one simulated time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType

from rtcp.config.cell import CellConfig
from rtcp.control.partners import Partners
from rtcp.ipc.commands import Command, Enable
from rtcp.ipc.observer import Answer
from rtcp.ipc.states import State
from rtcp.launch.simulation import Simulation


class CellSimulation:
    """The arms of a cell; `cycle` lets the cycle pass that is due first.

    Args:
        cell: its arms are on EtherCAT.
        seed: of what is left to chance on the buses.
        positions: rad, where the joints of an arm stand at power-on, by its name.
    """

    def __init__(
        self, cell: CellConfig, seed: int = 0, *, positions: Mapping[str, Sequence[float]] | None = None
    ) -> None:
        self.partners = {one.name: Partners(cell, one.name) for one in cell.members}
        with contextlib.ExitStack() as made:
            self.arms = {
                one.name: made.enter_context(
                    Simulation(
                        one.config, seed + number, positions=(positions or {}).get(one.name),
                        partners=self.partners[one.name],
                    )
                )
                for number, one in enumerate(cell.members)
            }  # fmt: skip
            self._opened = made.pop_all()
        for partners in self.partners.values():
            partners.files = [self.arms[one.name].path for one in partners.members]
            partners.open()
        self.silent: set[str] = set()
        """Arms whose loop hangs: their cycles do not come."""

    def __enter__(self) -> CellSimulation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:  # fmt: skip
        self._opened.close()

    @property
    def now_ns(self) -> int:
        """Simulated time."""
        return max(arm.now_ns for arm in self.arms.values())

    def cycle(self) -> None:
        """Let the cycle pass that is due first."""
        awake = [arm for name, arm in self.arms.items() if name not in self.silent]
        min(awake, key=lambda arm: arm.due_ns).cycle()

    def run(self, seconds: float) -> None:
        """Let so much time pass."""
        until = self.now_ns + round(seconds * 1e9)
        while self.now_ns < until:
            self.cycle()

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Let time pass until `condition`, at most `seconds`; return whether it came."""
        end = self.now_ns + round(seconds * 1e9)
        while not condition():
            if self.now_ns > end:
                return False
            self.cycle()
        return True

    def all_in(self, *states: State) -> bool:
        """Return whether every arm is in one of these states."""
        return all(arm.state in states for arm in self.arms.values())

    def enable(self) -> None:
        """Bring all arms to hold, each under a lease."""
        if not self.until(lambda: self.all_in(State.READY), 5.0):
            raise RuntimeError("not all arms became ready")
        for name, arm in self.arms.items():
            arm.acquire()
            if (refusal := self.send(name, Enable()).refusal) is not None:
                raise RuntimeError(f"{name}: {refusal}")
        if not self.until(lambda: self.all_in(State.HOLDING), 5.0):
            raise RuntimeError("not all arms hold")

    def send(self, name: str, command: Command) -> Answer:
        """Send a command to an arm and return its answer; time passes for all."""
        arm = self.arms[name]
        number = arm.observer.command(arm.lease, command)
        answer = None
        while answer is None:
            self.cycle()
            answer = arm.observer.answer(number)
        return answer
