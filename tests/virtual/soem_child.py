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


def join(pid: str) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    for kind in ("user", "net"):
        if os.stat(f"/proc/{pid}/ns/{kind}").st_ino == os.stat(f"/proc/self/ns/{kind}").st_ino:
            continue
        with open(f"/proc/{pid}/ns/{kind}", "rb") as namespace:
            if libc.setns(namespace.fileno(), 0):
                raise OSError(ctypes.get_errno(), f"cannot join the {kind} namespace")


def without_blocking(master: pysoem.Master, interface: str) -> None:
    before = set(os.listdir("/proc/self/fd"))
    master.open(interface)
    for entry in set(os.listdir("/proc/self/fd")) - before:
        link = Path(f"/proc/self/fd/{entry}")
        if link.is_symlink() and os.readlink(link).startswith("socket:"):
            os.set_blocking(int(entry), False)


def read(slave: pysoem.CdefSlave, register: int) -> int:
    """A register of four bytes; read again if the host stalled beyond the frame's timeout."""
    for _ in range(5):
        try:
            return int.from_bytes(slave._fprd(register, 4), "little")
        except pysoem.WkcError:
            time.sleep(0.01)
    raise RuntimeError(f"register 0x{register:04X} cannot be read")


def main() -> None:
    pid, interface, cycles = sys.argv[1], sys.argv[2], int(sys.argv[3])
    to_stop = int(sys.argv[4]) if len(sys.argv) > 4 else None
    if pid != "-":
        join(pid)
    # By default SOEM waits 2 ms for a frame; a shared host stalls for longer.
    pysoem.settings.timeouts.ret = 40_000
    pysoem.settings.timeouts.safe = pysoem.settings.timeouts.eeprom = 2_000_000
    master = pysoem.Master()
    without_blocking(master, interface)
    result: dict[str, object] = {"slaves": master.config_init()}
    master.state_check(pysoem.PREOP_STATE, 2_000_000)
    synchronous = []
    for slave in master.slaves:
        try:
            # No sync error when the host of the test stalls.
            slave.sdo_write(0x10F1, 2, bytes(2))
            synchronous.append(slave)
        except pysoem.SdoError:
            continue
    master.config_map()
    master.config_dc()
    result["delays"] = [read(slave, 0x0928) for slave in master.slaves]
    result["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, 2_000_000)
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
    master.state = pysoem.INIT_STATE
    master.write_state()
    result["init"] = master.state_check(pysoem.INIT_STATE, 2_000_000)
    master.close()
    print(json.dumps(result))


if __name__ == "__main__":
    main()
