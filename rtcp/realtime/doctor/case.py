"""Whom the doctor looks at: a host, and what the loop would ask of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from rtcp.realtime.doctor.card import Card
from rtcp.realtime.doctor.host import Host


@dataclass(frozen=True)
class Case:
    """The host, and the place, rank and bus of the cycle that is to run on it."""

    host: Host
    cpu: int
    priority: int
    """SCHED_FIFO priority of the loop."""
    interface: str | None
    """The bus' network interface; None for the virtual bus."""
    wait_us: float
    """How long the loop waits for its frame."""
    card: Card = field(default_factory=Card)
