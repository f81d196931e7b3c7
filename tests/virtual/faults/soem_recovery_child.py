"""A real master, unmodified pysoem: brings the segment to OP, starts faults and prints their effects as JSON.

    python soem_recovery_child.py PID INTERFACE CONTROL

joins the namespaces of process PID; CONTROL is the segment's control socket.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pysoem

from rtcp.virtual.faults.control import SegmentClient
from tests.virtual.soem_child import end, opened, read

PERIOD = 0.002


def cycle(master: pysoem.Master, seconds: float) -> list[int]:
    """Exchange process data for `seconds`; return the working counters."""
    counters = []
    for _ in range(round(seconds / PERIOD)):
        time.sleep(PERIOD)
        master.send_processdata()
        counters.append(master.receive_processdata(2000))
    return counters


def to_op(master: pysoem.Master) -> int:
    """Request OP of all slaves while process data flow; return the lowest state reached."""
    master.state = pysoem.OP_STATE
    master.write_state()
    for _ in range(20):
        cycle(master, 0.05)
        if master.read_state() == pysoem.OP_STATE:
            break
    return int(master.read_state())


def main() -> None:
    master = opened(*sys.argv[1:3])
    result: dict[str, object] = {"slaves": master.config_init()}
    master.config_map()
    master.state_check(pysoem.SAFEOP_STATE, 2_000_000)
    result["op"] = to_op(master)
    with SegmentClient(Path(sys.argv[3])) as segment:
        number = segment.fault({"fault": "cable", "after": 3})
        result["broken"] = cycle(master, 0.3)
        result["links"] = [read(slave, 0x0110, 2) >> 4 & 3 for slave in master.slaves[:3]]
        result["watched"] = [each["reachable"] for each in segment.truth()["slaves"]]
        segment.clear(number)
        result["lost_links"] = [read(slave, 0x0310, 2) for slave in master.slaves]
        cycle(master, 0.02)
        master.read_state()
        result["behind"] = [(slave.state, slave.al_status) for slave in master.slaves[2:5]]
        for slave in master.slaves[3:]:
            slave.state = pysoem.SAFEOP_STATE + pysoem.STATE_ACK
            slave.write_state()
        result["cleared"] = to_op(master), cycle(master, 0.02)[-5:]

        number = segment.fault({"fault": "power", "slave": 7})
        result["dark"] = cycle(master, 0.05)[-5:]
        segment.clear(number)
        last = master.slaves[6]
        result["back"] = cycle(master, 0.05)[-5:]
        result["recovered"] = last.recover()
        result["reconfigured"] = last.reconfig()
        result["again"] = to_op(master), cycle(master, 0.02)[-5:]

        # Frames that the host delays count as lost (-1): the test ignores them.
        number = segment.fault({"fault": "wkc", "slave": 3, "rate": 1.0})
        result["not_counted"] = cycle(master, 0.02)[-5:]
        segment.clear(number)
        segment.fault({"fault": "corrupt", "after": 4, "burst": 5})
        result["damaged"] = cycle(master, 0.02)
        result["errors"] = [read(slave, 0x0300, 1) + 256 * read(slave, 0x0308, 1) for slave in master.slaves]
        segment.fault({"fault": "sdo_abort", "slave": 3, "code": 0x08000022})
        try:
            master.slaves[2].sdo_read(0x6041, 0)
        except pysoem.SdoError as error:
            result["abort"] = error.abort_code
        segment.clear()
        segment.fault({"fault": "al_fall", "slave": 2, "code": 0x1234})
        result["fallen"] = cycle(master, 0.02)[-5:]
        master.read_state()
        result["al"] = [(slave.state, slave.al_status) for slave in master.slaves[:3]]
    end(master, result)


if __name__ == "__main__":
    main()
