"""Two ways to a slave's objects: through the running platform, or over the bus opened for one question."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from rtcp.cli.connection import connect
from rtcp.cli.errors import CommandError, code_of, interruption_code, orderly_signals
from rtcp.cli.launch import refuse_a_second_platform
from rtcp.config.virtual import VIRTUAL
from rtcp.ipc.client import ControlClient
from rtcp.ipc.errors import RtcpError
from rtcp.launch import offline


class BusAccess(Protocol):
    """What `scan` and `sdo` need of a bus; every method may raise `RtcpError` or `OfflineError`."""

    name: str
    """`virtual` or the network interface."""

    def positions(self) -> dict[str, int]:
        """Return the position of each slave by its configured name."""

    def scan(self) -> list[dict[str, Any]]:
        """Return what each slave tells of itself."""

    def sdo_read(self, position: int, index: int, subindex: int) -> bytes:
        """Return an object's bytes."""

    def sdo_write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object's bytes."""


class RunningBus:
    """The bus of the running platform, which is asked over its control socket."""

    def __init__(self, client: ControlClient, status: Mapping[str, Any]) -> None:
        self._client = client
        self._slaves: list[dict[str, Any]] = list(status.get("slaves", []))
        self.name = str(status.get("bus", "-"))

    def positions(self) -> dict[str, int]:
        """Return the position of each slave by its configured name."""
        return {str(slave["name"]): int(slave["position"]) for slave in self._slaves}

    def scan(self) -> list[dict[str, Any]]:
        """Return what each slave told when it was scanned."""
        return list(self._client.call("scan").get("slaves", []))

    def sdo_read(self, position: int, index: int, subindex: int) -> bytes:
        """Return an object's bytes."""
        answer = self._client.call("sdo_read", {"slave": position, "index": index, "subindex": subindex})
        return bytes.fromhex(str(answer.get("hex", "")))

    def sdo_write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object's bytes."""
        arguments = {"slave": position, "index": index, "subindex": subindex, "hex": data.hex()}
        self._client.call("sdo_write", arguments)


class OfflineBus:
    """A bus that nobody uses: opened for each question and closed again."""

    def __init__(self, bus: str | None, config: Path | None) -> None:
        self._config = config
        self.name = offline.configuration(config).bus.interface if bus is None else bus
        if self.name == VIRTUAL:
            from rtcp.config.schema import segment_path
            from rtcp.virtual.check import check_segment

            check_segment(segment_path(offline.configuration(config)))

    def positions(self) -> dict[str, int]:
        """Return the position of each slave by its configured name."""
        return {slave.name: place for place, slave in enumerate(offline.configuration(self._config).slaves, 1)}

    def scan(self) -> list[dict[str, Any]]:
        """Return what each slave tells of itself."""
        return offline.scan(self.name, self._config)

    def sdo_read(self, position: int, index: int, subindex: int) -> bytes:
        """Return an object's bytes."""
        return offline.sdo_read(self.name, self._config, position, index, subindex)

    def sdo_write(self, position: int, index: int, subindex: int, data: bytes) -> None:
        """Write an object's bytes."""
        offline.sdo_write(self.name, self._config, position, index, subindex, data)


@contextmanager
def bus_access(command: str, bus: str | None, config: Path | None) -> Iterator[BusAccess]:
    """Give the running platform's bus if it is the one wanted, and otherwise open the wanted or configured one.

    Raises:
        CommandError: in place of what went wrong inside; a segment that was started has been ended by then.
        RtcpError: as the platform answers.
        ConfigError: when the configuration was needed and is wrong.
    """
    try:
        with orderly_signals():
            try:
                client = connect(command)
            except RtcpError as error:
                if error.kind != "not running":
                    raise
                refuse_a_second_platform()
                yield OfflineBus(bus, config)
                return
            with client:
                status = client.call("status")
                yield RunningBus(client, status) if bus in (None, status.get("bus")) else OfflineBus(bus, config)
    except offline.OfflineError as error:
        raise CommandError(str(error), code_of(error.kind)) from error
    except KeyboardInterrupt as interruption:
        raise CommandError("interrupted: nothing is left running", interruption_code(interruption)) from None


def position_of(slave: str, access: BusAccess) -> int:
    """Return the position of a slave given by position or configured name.

    Raises:
        CommandError: when there is no such name, with those that there are.
    """
    if slave.isdecimal() and len(slave) < 6 and int(slave) > 0:
        return int(slave)
    named = access.positions()
    if slave not in named:
        raise CommandError(f"no slave is called {slave!r}: a position from 1, or one of {', '.join(named) or 'none'}")
    return named[slave]
