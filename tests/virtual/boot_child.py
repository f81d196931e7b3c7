"""A real master, unmodified pysoem, updates firmware in BOOT and prints the result as JSON: PID INTERFACE."""

from __future__ import annotations

import json
import struct
import sys

import pysoem

from tests.virtual.soem_child import PATIENCE_US, opened

FIRMWARE = bytes(range(256)) * 20


def words(slave: pysoem.CdefSlave, word: int, count: int) -> list[int]:
    raw = b"".join(slave.eeprom_read(word + n, PATIENCE_US)[:4] for n in range(0, count, 2))
    return list(struct.unpack(f"<{count}H", raw))


def main() -> None:
    master = opened(*sys.argv[1:])
    master.config_init()
    (slave,) = master.slaves
    slave.state = pysoem.INIT_STATE
    slave.write_state()
    slave.state_check(pysoem.INIT_STATE, PATIENCE_US)
    rx_start, rx_length, tx_start, tx_length = words(slave, 0x14, 4)
    slave.amend_mbx("out", rx_start, rx_length)
    slave.amend_mbx("in", tx_start, tx_length)
    slave.state = pysoem.BOOT_STATE
    slave.write_state()
    result: dict[str, object] = {"boot": slave.state_check(pysoem.BOOT_STATE, PATIENCE_US)}
    slave.foe_write("firmware", 0x1234, FIRMWARE, PATIENCE_US)
    result["read"] = slave.foe_read("firmware", 0x1234, len(FIRMWARE) + 1000, PATIENCE_US).hex()
    result["written"] = FIRMWARE.hex()
    try:
        slave.sdo_read(0x1018, 1)
        result["no_coe_in_boot"] = False
    except (pysoem.SdoError, pysoem.MailboxError, pysoem.PacketError, pysoem.WkcError):
        result["no_coe_in_boot"] = True
    slave.state = pysoem.INIT_STATE
    slave.write_state()
    slave.state_check(pysoem.INIT_STATE, PATIENCE_US)
    master.config_init()
    result["after"] = master.state_check(pysoem.PREOP_STATE, PATIENCE_US)
    master.close()
    print(json.dumps(result))


if __name__ == "__main__":
    main()
