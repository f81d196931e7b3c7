"""Interface between the loop and a bus of any kind."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

from rtcp.config.buses import ENTRY_POINTS
from rtcp.config.cell import ControllerUnits
from rtcp.config.find import load_class
from rtcp.config.model import ArmConfig, BusConfig
from rtcp.fieldbus.bus import ProcessData
from rtcp.fieldbus.supervision import SupervisedBus


class Master(ABC):
    """A bus from `open` to `close`; a kind of bus names its class in `MASTER` (docs/extending.md).

    Args:
        config: the arm; after `start` `config.slaves` is in the order of the bus.
        interface: interface of the session: the configured or the virtual one.
        namespace_pid: process whose network namespace has it; 0: this process.
    """

    def __init__(self, config: ArmConfig, interface: str, namespace_pid: int) -> None:
        self.config = config
        self.interface = interface
        self.namespace_pid = namespace_pid
        self.notes: list[str] = []
        """Tolerated deviations, and failures of `close`, in sentences."""

    @staticmethod
    @abstractmethod
    def check_interface(name: str) -> None:
        """Raise BusError where `bus.interface` cannot be used on this host."""

    def share(self, units: ControllerUnits) -> None:
        """Take note of the other arms of the controller, before `start`."""
        return  # each arm has a connection of its own

    @property
    def supervised(self) -> SupervisedBus | None:
        """The slaves with their AL states, SDO and emergencies; None: the bus has none."""
        return None

    @abstractmethod
    def start(self, directory: Path, report: Callable[[str], None]) -> ProcessData:
        """Open the bus and return its process data.

        Args:
            directory: the runtime directory.
            report: receives sentences on the progress, for the user.

        Raises:
            BusError: it cannot be opened.
        """

    @property
    def connected(self) -> bool:
        """Whether the other side sends; not used where slaves are supervised."""
        return True

    def waiting_for(self) -> str:
        """Return a sentence on what a person has to do before the arm can be enabled; empty: nothing."""
        return ""

    def explain(self, axis: int) -> str:
        """Return a sentence on why the drive of a joint left its state; empty: unknown."""
        return ""

    @abstractmethod
    def close(self) -> None:
        """Bring the bus to rest and close it; may be called at any time, also twice."""


def master_of(bus: BusConfig) -> type[Master]:
    """Return the `Master` class of a bus.

    Raises:
        PluginError: it cannot be loaded, as its package is missing.
    """
    return load_class(EntryPoint(bus.kind, bus.MASTER, ENTRY_POINTS), Master)  # type: ignore[type-abstract]


class PacedData(ProcessData):
    """Process data of a bus that sets the pace: the other side sends first, and is answered at once."""

    def receive_until(self, deadline_ns: int) -> int:
        """Wait for a message until `deadline_ns` (CLOCK_MONOTONIC); return 1, or -1 where none came."""
        raise NotImplementedError
