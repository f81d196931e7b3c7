"""A real master, unmodified pysoem, reads and writes files over FoE and prints them as JSON: PID INTERFACE."""

from __future__ import annotations

import json
import sys

import pysoem

from tests.virtual.soem_child import PATIENCE_US, opened

WRITTEN = bytes(range(200, 0, -1)) * 2


def main() -> None:
    pid, interface = sys.argv[1:]
    master = opened(pid, interface)
    master.config_init()
    master.state_check(pysoem.PREOP_STATE, PATIENCE_US)
    (slave,) = master.slaves
    result = {"firmware": slave.foe_read("firmware", 0, 4096, PATIENCE_US).hex()}
    slave.foe_write("settings", 0, WRITTEN, PATIENCE_US)
    result["settings"] = slave.foe_read("settings", 0, 4096, PATIENCE_US).hex()
    result["written"] = WRITTEN.hex()
    master.close()
    print(json.dumps(result))


if __name__ == "__main__":
    main()
