"""A real master, pysoem unchanged, that knows no device: `any_child.py PID INTERFACE [OUTPUTS_HEX ...]`; tells in JSON.

It maps what it finds, brings all to OP, sends these outputs (whole images, slave by slave) and tells the inputs.
"""

from __future__ import annotations

import json
import sys
import time

import pysoem
from soem_child import join, without_blocking

PATIENCE_US = 2_000_000
PERIOD_S = 0.004


def delay(slave: pysoem.CdefSlave) -> int | None:
    try:
        return int.from_bytes(slave._fprd(0x0928, 4), "little")
    except pysoem.WkcError:  # it has no clock
        return None


def main() -> None:
    pid, interface, *outputs = sys.argv[1:]
    join(pid)
    pysoem.settings.timeouts.ret = 40_000
    pysoem.settings.timeouts.safe = pysoem.settings.timeouts.eeprom = PATIENCE_US
    master = pysoem.Master()
    without_blocking(master, interface)
    found: dict[str, object] = {"found": master.config_init()}
    found["names"] = [slave.name for slave in master.slaves]
    master.state_check(pysoem.PREOP_STATE, PATIENCE_US)
    found["bytes"] = master.config_map()
    found["dc"] = master.config_dc()
    found["safe_op"] = master.state_check(pysoem.SAFEOP_STATE, PATIENCE_US)
    found["codes"] = [[slave.state, slave.al_status] for slave in master.slaves]
    for slave, data in zip(master.slaves, outputs, strict=False):
        slave.output = bytes.fromhex(data)
    master.state = pysoem.OP_STATE
    master.write_state()
    counters = []
    for _ in range(100):
        master.send_processdata()
        counters.append(master.receive_processdata(20_000))
        time.sleep(PERIOD_S)
    found["state"] = master.read_state()
    found["codes"] = [[slave.state, slave.al_status] for slave in master.slaves]
    found["expected"] = master.expected_wkc
    found["counters"] = counters[20:]
    found["inputs"] = [slave.input.hex() for slave in master.slaves]
    found["outputs"] = [slave.output.hex() for slave in master.slaves]
    found["delays"] = [delay(slave) for slave in master.slaves]
    master.state = pysoem.INIT_STATE
    master.write_state()
    master.close()
    print(json.dumps(found))


if __name__ == "__main__":
    main()
