"""The slaves as a tree: the parent of each slave, and the port at which it hangs (ETG.1000.4, 4.3)."""

from __future__ import annotations

from collections.abc import Container, Sequence
from enum import Enum
from typing import NamedTuple


class PortState(str, Enum):
    """State of a port, in the words of a scan."""

    OPEN = "open"
    """A neighbour answers behind it."""
    CLOSED = "closed"
    """It has a link, but no neighbour answers."""
    NO_LINK = "no link"


BRANCHES = (3, 1, 2)
"""Ports in the order in which a frame that came in at port 0 passes them."""


def port_states(dl_status: int) -> tuple[PortState, ...]:
    """Return the states of ports 0 to 3.

    DL status (ETG.1000.4, table 34): bit 4 + n: link; bits 8 + 2n, 9 + 2n: loop closed, communication established.
    """
    states = []
    for port in range(4):
        link, loop, talks = dl_status >> 4 + port & 1, dl_status >> 8 + 2 * port & 1, dl_status >> 9 + 2 * port & 1
        states.append(PortState.OPEN if talks and not loop else PortState.CLOSED if link else PortState.NO_LINK)
    return tuple(states)


class Connection(NamedTuple):
    """Position of a slave's parent (0: the master) and the port of the parent at which the slave hangs."""

    parent: int
    port: int


class Topology:
    """The connections of a segment's slaves, which are counted from 1 in the order in which frames reach them."""

    def __init__(self, connections: Sequence[Connection]) -> None:
        self._connections = tuple(connections)
        self._children = {connection: position for position, connection in enumerate(connections, 1)}

    @classmethod
    def chain(cls, count: int) -> Topology:
        """Return the tree of slaves in a line."""
        return cls([Connection(position, 1 if position else 0) for position in range(count)])

    @classmethod
    def of(cls, ports: Sequence[Sequence[PortState]]) -> Topology:
        """Return the tree according to the slaves' ports; without a free open port a slave hangs at the one before."""
        connections: list[Connection] = []
        free: list[tuple[int, list[int]]] = []  # position, ports still without a child; innermost last
        for position, own in enumerate(ports, 1):
            while free and not free[-1][1]:
                free.pop()
            if free:
                connections.append(Connection(free[-1][0], free[-1][1].pop(0)))
            else:
                connections.append(Connection(position - 1, 1 if position > 1 else 0))
            branches = [port for port in BRANCHES if own[port] is PortState.OPEN]
            free.append((position, branches if own[0] is PortState.OPEN else branches[1:]))
        return cls(connections)

    def __len__(self) -> int:
        return len(self._connections)

    def parent(self, position: int) -> int:
        """Return the position of the parent of the slave at `position`; 0: the master."""
        return self._connections[position - 1].parent

    def port(self, position: int) -> int:
        """Return the port of its parent at which the slave at `position` hangs."""
        return self._connections[position - 1].port

    def child_at(self, position: int, port: int) -> int | None:
        """Return the position of the slave that hangs at a port; None: none does."""
        return self._children.get(Connection(position, port))

    def depth(self, position: int) -> int:
        """Return the number of slaves between the one at `position` and the master."""
        parent = self.parent(position)
        return 1 + self.depth(parent) if parent else 0

    def first_lost(self, position: int, lost: Container[int]) -> int:
        """Return the lost slave nearest to the master on the path to the one at `position`."""
        while (parent := self.parent(position)) in lost:
            position = parent
        return position
