"""Sends frames to a segment unchanged and reports the frames received, in a process of its own.

    python raw_child.py PID INTERFACE

joins the namespaces of process PID. A request is a line of JSON, `{"frames": [hex], "gap_s": s, "answers": number,
"patience_s": s}`; its reply is `{"sent": [ns], "received": [[ns, hex]]}` (CLOCK_MONOTONIC). It waits until `answers`
frames have arrived, then `patience_s` for more.
"""

from __future__ import annotations

import json
import math
import select
import socket
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3]))

from tests.virtual.soem_child import join

EVERYTHING = 0x0003
LONGEST_WAIT_NS = 20_000_000_000
OUTGOING = 4


def collect(raw: socket.socket, until: int, received: list[tuple[int, str]], enough: float = math.inf) -> None:
    while len(received) < enough and (left := until - time.monotonic_ns()) > 0:
        if select.select([raw], [], [], left * 1e-9)[0]:
            frame, address = raw.recvfrom(2048)
            if address[2] != OUTGOING:
                received.append((time.monotonic_ns(), frame.hex()))


def main() -> None:
    join(sys.argv[1])
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(EVERYTHING)) as raw:
        raw.bind((sys.argv[2], EVERYTHING))
        for line in sys.stdin:
            request = json.loads(line)
            received: list[tuple[int, str]] = []
            sent = []
            for frame in request["frames"]:
                sent.append(time.monotonic_ns())
                raw.send(bytes.fromhex(frame))
                collect(raw, time.monotonic_ns() + round(request["gap_s"] * 1e9), received)
            collect(raw, time.monotonic_ns() + LONGEST_WAIT_NS, received, request["answers"])
            collect(raw, time.monotonic_ns() + round(request["patience_s"] * 1e9), received)
            print(json.dumps({"sent": sent, "received": received}), flush=True)


if __name__ == "__main__":
    main()
