"""A cell on in-process buses: the loops of all its arms in one process and one simulated time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from rtcp.config.cell import CellConfig
from rtcp.config.segment import SegmentConfig
from rtcp.control.partners import Partners
from rtcp.ipc.commands import Command, Enable
from rtcp.ipc.observer import Answer
from rtcp.ipc.states import State
from rtcp.testing.simulation import Simulation


class CellSimulation:
    """The arms of a cell; `cycle` runs the cycle that is due next, and a cycle of one arm those that are due before.

    Args:
        cell: a cell whose arms are on EtherCAT.
        seed: seed of the buses.
        positions: name of an arm -> positions of its joints at power-on, rad.
        segments: name of an arm -> its slaves; left out: the configured segment.
        follow_clock: as of `Simulation`.
    """

    def __init__(
        self,
        cell: CellConfig,
        seed: int = 0,
        *,
        positions: Mapping[str, Sequence[float]] | None = None,
        segments: Mapping[str, SegmentConfig] | None = None,
        follow_clock: bool = True,
    ) -> None:
        self.partners = {member.name: Partners(cell, member.name) for member in cell.members}
        with contextlib.ExitStack() as stack:
            self.arms = {
                member.name: stack.enter_context(
                    Simulation(
                        member.config, seed + number, positions=(positions or {}).get(member.name),
                        segment=(segments or {}).get(member.name), follow_clock=follow_clock,
                        partners=self.partners[member.name],
                    )
                )
                for number, member in enumerate(cell.members)
            }  # fmt: skip
            self._opened = stack.pop_all()
        for partners in self.partners.values():
            partners.files = [self.arms[member.name].path for member in partners.members]
            partners.open()
        self.silent: set[str] = set()
        """Names of arms whose loop hangs, so that they have no cycles."""
        for arm in self.arms.values():
            arm.before_cycle = partial(self._catch_up, arm)

    def __enter__(self) -> CellSimulation:
        return self

    def __exit__(self, *_: object) -> None:
        for partners in self.partners.values():
            partners.close()
        self._opened.close()

    @property
    def now_ns(self) -> int:
        """Simulated time, ns."""
        return max(arm.now_ns for arm in self.arms.values())

    def cycle(self) -> None:
        """Run the cycle that is due next."""
        awake = [arm for name, arm in self.arms.items() if name not in self.silent]
        min(awake, key=lambda arm: arm.due_ns).cycle()

    def _catch_up(self, arm: Simulation) -> None:
        """Run the cycles of the other arms that are due before that of `arm`."""
        for name, other in self.arms.items():
            while other.due_ns < arm.due_ns and name not in self.silent:
                other.cycle()

    def run(self, seconds: float) -> None:
        """Run the cycles of this time, s."""
        until = self.now_ns + round(seconds * 1e9)
        while self.now_ns < until:
            self.cycle()

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Run until `condition`, at most `seconds`; return whether it was met."""
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
        """Bring all arms to holding, each under a lease."""
        if not self.until(lambda: self.all_in(State.READY), 5.0):
            raise RuntimeError("not all arms became ready")
        for name, arm in self.arms.items():
            arm.acquire()
            if (refusal := self.send(name, Enable()).refusal) is not None:
                raise RuntimeError(f"{name}: {refusal}")
        if not self.until(lambda: self.all_in(State.HOLDING), 5.0):
            raise RuntimeError("not all arms hold")

    def send(self, name: str, command: Command) -> Answer:
        """Send a command to an arm and return its answer; advances the time of all arms."""
        arm = self.arms[name]
        number = arm.observer.command(arm.lease, command)
        answer = None
        while answer is None:
            self.cycle()
            answer = arm.observer.answer(number)
        return answer
