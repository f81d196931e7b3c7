"""A real master, unmodified pysoem, without any device description.

    python -m tests.virtual.any_child PID INTERFACE [OUTPUTS_HEX ...]

brings the slaves in the namespaces of process PID to OP, sends the outputs (one image a slave) and prints JSON.
"""

from __future__ import annotations

import sys
import time

import pysoem

from tests.virtual.soem_child import PATIENCE_US, end, opened

PERIOD_S = 0.004


def delay(slave: pysoem.CdefSlave) -> int | None:
    try:
        return int.from_bytes(slave._fprd(0x0928, 4), "little")
    except pysoem.WkcError:  # no clock
        return None


def unhurried(slave: pysoem.CdefSlave) -> None:
    """Lengthen the watchdog of a slave, so that a busy host does not take it out of OP."""
    for _ in range(5):
        try:
            slave._fpwr(0x0420, (50_000).to_bytes(2, "little"))
            return
        except pysoem.WkcError:
            time.sleep(0.01)
    raise RuntimeError("the watchdog cannot be set")


def main() -> None:
    pid, interface, *outputs = sys.argv[1:]
    master = opened(pid, interface)
    result: dict[str, object] = {"slaves": master.config_init()}
    result["names"] = [slave.name for slave in master.slaves]
    master.state_check(pysoem.PREOP_STATE, PATIENCE_US)
    result["bytes"] = master.config_map()
    result["dc"] = master.config_dc()
    result["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, PATIENCE_US)
    result["codes"] = [[slave.state, slave.al_status] for slave in master.slaves]
    for slave, data in zip(master.slaves, outputs, strict=False):
        slave.output = bytes.fromhex(data)
    for slave in master.slaves:
        unhurried(slave)
    master.state = pysoem.OP_STATE
    master.write_state()
    counters = []
    for _ in range(100):
        master.send_processdata()
        counters.append(master.receive_processdata(20_000))
        time.sleep(PERIOD_S)
    result["state"] = master.read_state()
    result["codes"] = [[slave.state, slave.al_status] for slave in master.slaves]
    result["expected"] = master.expected_wkc
    result["counters"] = counters[20:]
    result["inputs"] = [slave.input.hex() for slave in master.slaves]
    result["outputs"] = [slave.output.hex() for slave in master.slaves]
    result["delays"] = [delay(slave) for slave in master.slaves]
    end(master, result)


if __name__ == "__main__":
    main()
