"""The cables of a chain and the supply of its slaves: how far a frame comes, and what the ports show of it."""

from __future__ import annotations

from collections.abc import Sequence

from rtcp.virtual.slave import Slave


class Chain:
    """Cable n lies behind slave n (0: between the master and slave 1); slaves count from 1.

    What is broken twice must be joined twice.
    """

    def __init__(self, slaves: Sequence[Slave]) -> None:
        self._slaves = tuple(slaves)
        self._cuts = [0] * len(self._slaves)
        self._outages = [0] * len(self._slaves)
        self.reach = len(self._slaves)
        """So many slaves are reached by a frame."""

    def cut(self, cable: int) -> None:
        """Break a cable."""
        self._cuts[cable] += 1
        self._follow()

    def join(self, cable: int) -> None:
        """Join a cable again."""
        self._cuts[cable] -= 1
        self._follow()

    def power_off(self, number: int, t: int) -> None:
        """Take the supply from a slave."""
        self._outages[number - 1] += 1
        if self._outages[number - 1] == 1:
            self._slaves[number - 1].power_off(t)
        self._follow()

    def power_on(self, number: int, t: int) -> None:
        """Give a slave its supply back."""
        self._outages[number - 1] -= 1
        if not self._outages[number - 1]:
            self._slaves[number - 1].power_on(t)
        self._follow()

    def _linked(self, cable: int) -> bool:
        """Whether the cable is whole and what is at both of its ends has supply."""
        if cable == len(self._slaves) or self._cuts[cable] or self._outages[cable]:
            return False
        return cable == 0 or not self._outages[cable - 1]

    def _follow(self) -> None:
        """Let ports and turnaround times follow the state of the chain."""
        links = [self._linked(cable) for cable in range(len(self._slaves) + 1)]
        self.reach = links.index(False)
        for place, slave in enumerate(self._slaves):
            if self._outages[place]:
                continue
            slave.esc.set_links(links[place], links[place + 1])
        if self.reach:
            self._turn_round(self._slaves[: self.reach])

    @staticmethod
    def _turn_round(reached: Sequence[Slave]) -> None:
        last = reached[-1]
        for slave in reached:
            if slave.esc.dc is not None:
                slave.esc.dc.turnaround = None if slave is last else 2 * (last.delay - slave.delay)
