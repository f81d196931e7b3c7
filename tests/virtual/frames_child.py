"""A raw master in a process of its own: sends broadcast reads and prints statistics of the answers as JSON.

    python frames_child.py PID INTERFACE FRAMES PERIOD_US [VLAN]

joins the namespaces of process PID; PERIOD_US 0: the next frame follows the answer. An answer after 2 ms is
late, a frame without an answer is lost. VLAN: identifier of a tag in each frame. `cpu_share` is the CPU time of process
PID by the time passed.
"""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.virtual.frames import Datagram, build
from tests.virtual.soem_child import join

LATE = 0.002
TIMEOUT = 10.0
PACKET_AUXDATA = 8


def cpu_seconds(pid: str) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    pid, interface, frames, period_us = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
    vlan = int(sys.argv[5]) if len(sys.argv) > 5 else None
    join(pid)
    protocol = 0x88A4 if vlan is None else 3
    link = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(protocol))
    link.setsockopt(263, PACKET_AUXDATA, 1)
    link.bind((interface, protocol))
    # An answer differs from its own frame in the source address.
    link.setblocking(False)
    with suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
    late, lost = 0, 0
    counters: set[int] = set()
    tags: set[int] = set()
    used = cpu_seconds(pid)
    started = due = time.monotonic()
    rest_at = started
    for number in range(frames):
        if period_us:
            due += period_us * 1e-6
            time.sleep(max(0.0, due - time.monotonic()))
        elif time.monotonic() > rest_at:
            # The kernel would throttle this process too.
            time.sleep(0.002)
            rest_at = time.monotonic() + 0.02
        frame = build(Datagram(7, number & 0xFF, 0, 0, bytes(2)))
        if vlan is not None:
            frame = frame[:12] + b"\x81\x00" + vlan.to_bytes(2, "big") + frame[12:]
        link.send(frame)
        sent = time.monotonic()
        while (waited := time.monotonic() - sent) < TIMEOUT:
            try:
                answer, ancillary, _, _ = link.recvmsg(2048, 256)
            except BlockingIOError:
                if waited > LATE:
                    time.sleep(LATE)
                continue
            if answer[6] & 0x02 and answer[17] == number & 0xFF:
                counters.add(int.from_bytes(answer[28:30], "little"))
                tags.update(int.from_bytes(data[16:18], "little") for *_, data in ancillary if data[0] & 0x10)
                late += waited > LATE
                break
        else:
            lost += 1
    share = (cpu_seconds(pid) - used) / (time.monotonic() - started)
    result = {"lost": lost, "late": late, "counters": sorted(counters), "tags": sorted(tags), "cpu_share": share}
    print(json.dumps(result))


main()
