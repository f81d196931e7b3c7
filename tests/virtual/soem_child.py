"""A real master, unmodified pysoem, in a process of its own: brings a segment to OP and prints the result as JSON.

    python soem_child.py PID|- INTERFACE CYCLES [PID_TO_STOP]

joins the namespaces of process PID first; stops the process PID_TO_STOP for 50 ms in the middle of the cycles.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import time
from pathlib import Path

import pysoem

PERIOD_NS = 2_000_000
PATIENCE_US = 2_000_000


def join(pid: str | int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    for kind in ("user", "net"):
        if os.stat(f"/proc/{pid}/ns/{kind}").st_ino == os.stat(f"/proc/self/ns/{kind}").st_ino:
            continue
        with open(f"/proc/{pid}/ns/{kind}", "rb") as namespace:
            if libc.setns(namespace.fileno(), 0):
                raise OSError(ctypes.get_errno(), f"cannot join the {kind} namespace")


def opened(pid: str, interface: str) -> pysoem.Master:
    """Join the namespaces of a process, unless it is "-", and open a master that waits longer than a host stalls."""
    if pid != "-":
        join(pid)
    pysoem.settings.timeouts.ret = 40_000
    pysoem.settings.timeouts.safe = pysoem.settings.timeouts.eeprom = PATIENCE_US
    master = pysoem.Master()
    before = set(os.listdir("/proc/self/fd"))
    master.open(interface)
    for entry in set(os.listdir("/proc/self/fd")) - before:
        link = Path(f"/proc/self/fd/{entry}")
        if link.is_symlink() and os.readlink(link).startswith("socket:"):
            os.set_blocking(int(entry), False)
    return master


def end(master: pysoem.Master, result: dict[str, object]) -> None:
    """Take the slaves to INIT and print the result."""
    master.state = pysoem.INIT_STATE
    master.write_state()
    result["init"] = master.state_check(pysoem.INIT_STATE, PATIENCE_US)
    master.close()
    print(json.dumps(result))


def read(slave: pysoem.CdefSlave, register: int, size: int = 4) -> int:
    """A register; read again if the host stalled beyond the frame's timeout."""
    for _ in range(5):
        try:
            return int.from_bytes(slave._fprd(register, size), "little")
        except pysoem.WkcError:
            time.sleep(0.01)
    raise RuntimeError(f"register 0x{register:04X} cannot be read")


def main() -> None:
    pid, interface, cycles = sys.argv[1], sys.argv[2], int(sys.argv[3])
    to_stop = int(sys.argv[4]) if len(sys.argv) > 4 else None
    master = opened(pid, interface)
    result: dict[str, object] = {"slaves": master.config_init()}
    master.state_check(pysoem.PREOP_STATE, PATIENCE_US)
    synchronous = []
    for slave in master.slaves:
        try:
            # No sync error when the host of the test stalls.
            slave.sdo_write(0x10F1, 2, bytes(2))
            synchronous.append(slave)
        except pysoem.SdoError:
            continue
    master.config_map()
    for slave in master.slaves:
        # This process has no priority: beside other work it may leave the segment without outputs for 100 ms.
        slave.set_watchdog("processdata", PATIENCE_US / 1000)
    master.config_dc()
    result["delays"] = [read(slave, 0x0928) for slave in master.slaves]
    result["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, PATIENCE_US)
    result["sizes"] = [[len(slave.output), len(slave.input)] for slave in master.slaves]
    for slave in synchronous:
        slave.dc_sync(True, PERIOD_NS, PERIOD_NS // 2)
    master.send_processdata()
    master.receive_processdata(2000)
    wake = time.monotonic_ns() + PERIOD_NS - master.dc_time % PERIOD_NS
    master.state = pysoem.OP_STATE
    master.write_state()
    counters = []
    for cycle in range(cycles + 150):
        wake += PERIOD_NS
        time.sleep(max(0, wake - time.monotonic_ns()) * 1e-9)
        if to_stop is not None and cycle == 150:
            os.kill(to_stop, signal.SIGSTOP)
        if to_stop is not None and cycle == 175:
            os.kill(to_stop, signal.SIGCONT)
        master.send_processdata()
        counters.append(master.receive_processdata(1000))
    result["state"] = master.read_state()
    result["codes"] = [slave.al_status for slave in master.slaves]
    result["expected"] = master.expected_wkc
    result["counters"] = counters[150:]
    result["differences"] = [read(slave, 0x092C) & 0x7FFFFFFF for slave in master.slaves]
    end(master, result)


if __name__ == "__main__":
    main()
