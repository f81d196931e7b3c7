"""KickCAT, another master, brings a segment to OP: `kickcat_child.py INTERFACE`; writes its results as JSON."""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import kickcat  # type: ignore[import-not-found]

PATIENCE_S, LONGEST = 2.0, 64


def main() -> None:
    link = kickcat.create_link(sys.argv[1], "")
    link.set_timeout(0.04)
    bus = kickcat.Bus(link)
    bus.init(PATIENCE_S)
    bus.create_mapping(4096)
    bus.request_state(kickcat.State.SAFE_OP)
    bus.wait_for_state(kickcat.State.SAFE_OP, PATIENCE_S)
    slaves = bus.slaves()
    for slave in slaves:
        slave.set_output_bytes(bytes(slave.output_size))
    bus.request_state(kickcat.State.OPERATIONAL)
    end = time.monotonic() + PATIENCE_S
    states: list[Any] = []
    while time.monotonic() < end and set(states) != {kickcat.State.OPERATIONAL}:
        bus.process_data()
        states = [bus.get_state(slave) for slave in slaves]

    def read(slave: Any, index: int, subindex: int, access: Any) -> bytes:
        answer: bytes = bus.read_sdo(slave, index, subindex, access, LONGEST, PATIENCE_S)
        return answer

    results = [
        {
            "state": state.name,
            "bytes": [slave.output_size, slave.input_size],
            "name": read(slave, 0x1008, 0, kickcat.Access.PARTIAL).decode(),
            "whole": read(slave, 0x1018, 1, kickcat.Access.COMPLETE).hex(),
            "one by one": read(slave, 0x1018, 1, kickcat.Access.EMULATE_COMPLETE).hex(),
            "object": bus.read_object_description(slave, 0x1018)[0],
            "entry": bus.read_entry_description(slave, 0x1018, 1)[0],
        }
        for slave, state in zip(slaves, states, strict=True)
    ]
    # Its link writes to standard output too.
    print("\n" + json.dumps(results))


if __name__ == "__main__":
    main()
