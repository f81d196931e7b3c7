"""The loop's side of a bus, whatever its kind: what every one can do, and what some can do besides."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

from rtcp.config.buses import ENTRY_POINTS
from rtcp.config.find import load_class
from rtcp.config.model import ArmConfig, BusConfig
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.supervision import SupervisedBus


class Master(ABC):
    """A bus from `open` to `close`; a kind of bus names its class in `MASTER` (docs/extending.md).

    Args:
        config: the arm; `config.slaves` says what is on the bus, after `start` in the order in which it is there.
        interface: that of the session: as configured, or the virtual one.
        namespace_pid: process whose network namespace has it; 0: this process's own.
    """

    def __init__(self, config: ArmConfig, interface: str, namespace_pid: int) -> None:
        self.config = config
        self.interface = interface
        self.namespace_pid = namespace_pid
        self.notes: list[str] = []
        """Deviations that were tolerated, and what `close` could not leave in order, in sentences."""

    @staticmethod
    @abstractmethod
    def check_interface(name: str) -> None:
        """Raise BusError where `bus.interface` cannot be used on this host."""

    @property
    def supervised(self) -> SupervisedBus | None:
        """The slaves with their AL states, SDO and emergencies; None: the bus has none."""
        return None

    @abstractmethod
    def start(self, directory: Path, report: Callable[[str], None]) -> ProcessData:
        """Open the bus and return its process data; `report` takes sentences on how far it is.

        Args:
            directory: the runtime directory.
            report: for the user who waits.

        Raises:
            BusError: it cannot be opened.
        """

    @property
    def connected(self) -> bool:
        """Whether the other side speaks; of no interest where slaves are supervised."""
        return True

    def waiting_for(self) -> str:
        """Return in a sentence what people have to do before the arm can be enabled; empty: nothing."""
        return ""

    def explain(self, axis: int) -> str:
        """Return in a sentence why the drive of a joint left its state; empty: nothing is known."""
        return ""

    @abstractmethod
    def close(self) -> None:
        """Leave everything at rest; may be called at any time, also twice."""


def master_of(bus: BusConfig) -> type[Master]:
    """Return the class of the loop's side of a bus.

    Raises:
        PluginError: it cannot be loaded: a package is missing.
    """
    return load_class(EntryPoint(bus.kind, bus.MASTER, ENTRY_POINTS), Master)  # type: ignore[type-abstract]


class PacedData(ProcessData):
    """Process data of a bus that sets the pace: the other side speaks first, and is answered at once."""

    def receive_until(self, deadline_ns: int) -> int:
        """Wait until a message is there or `deadline_ns` (CLOCK_MONOTONIC); return 1, or -1 where none came."""
        raise NotImplementedError
