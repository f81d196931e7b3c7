"""Opening a network interface for SOEM, and making its packet socket fit for a cycle."""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Any

from pysoem import pysoem

from rtcp.fieldbus.bus import BusError
from rtcp.fieldbus.registers import attach_filter

_SOEM_LAST_INDEX = 15
_SDO_TIMEOUT_US = 700_000
_ANSWER_US, _PATIENCE_US = 40_000, 500_000
"""Until SOEM sends a frame again, and until it gives up. The cycle's frames have a time of their own."""


def claim(interface: str) -> socket.socket:
    """Claim the interface for this process: two masters on one cable take the slaves from each other.

    The claim is a name that the kernel keeps per network namespace and frees with the process.

    Raises:
        BusError: another process of this platform has it.
    """
    mine = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        mine.bind(f"\0rtcp-bus-{interface}")
    except OSError as error:
        mine.close()
        raise BusError(
            f"interface {interface} is in use by another process of this platform: `rtcp stop` it first"
        ) from error
    return mine


def open_master(interface: str) -> tuple[Any, socket.socket]:
    """Return pysoem's master, open, and a duplicate of its packet socket, which no longer blocks.

    Raises:
        BusError: the interface cannot be opened.
    """
    timeouts = pysoem.settings.timeouts
    # By default an answer after 2 ms is one too late: a shared host, or a segment in software, may be off its CPU for
    # longer. In a mailbox SOEM then takes the answer to one SDO for that to the next, and its map fails.
    timeouts.ret = _ANSWER_US
    timeouts.safe = timeouts.eeprom = _PATIENCE_US
    master = pysoem.Master()
    master.sdo_read_timeout = master.sdo_write_timeout = _SDO_TIMEOUT_US
    # The slaves are led through their states by us, so that a refusal is told with its code.
    master.manual_state_change = 1
    before = _sockets()
    try:
        master.open(interface)
    except ConnectionError as error:
        raise BusError(f"interface {interface} cannot be opened by the EtherCAT master: {error}") from error
    opened = [fd for fd, _ in _sockets() - before]
    if len(opened) != 1:
        master.close()
        raise BusError(f"the master's packet socket on {interface} was not found among the open descriptors")
    duplicate = socket.socket(fileno=os.dup(opened[0]))
    # Both descriptors are one socket. Blocking, an empty receive would last a jiffy or two: 4 to 8 ms (SOEM#451).
    duplicate.setblocking(False)
    attach_filter(duplicate, 0, _SOEM_LAST_INDEX)
    return master, duplicate


def _sockets() -> set[tuple[int, str]]:
    found = set()
    for name in os.listdir("/proc/self/fd"):
        # The descriptor of the listing itself is gone by now.
        with contextlib.suppress(FileNotFoundError):
            target = os.readlink(f"/proc/self/fd/{name}")
            if target.startswith("socket:"):
                found.add((int(name), target))
    return found
