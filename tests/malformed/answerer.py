"""A segment on a cable of its own that answers as it should, keeps what it was asked, and garbles answers on request.

    python answerer.py CONFIG SEED

prints its process id and ends with its standard input. Orders come as frames of a type that no master sends, so that
they stand in line with the others: see `ORDER` and `ask`. Time passes by the frames, 100 us for each, and in silence
a tenth as fast as it does: a master that is kept off its CPU trips no watchdog.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
from pathlib import Path
from random import Random

# Run as a file by the tests.
sys.path.insert(0, str(Path(__file__).parents[2]))

from rtcp.config.segment import load_segment
from rtcp.virtual.network import private_pair
from rtcp.virtual.protocol import ETHERTYPE, FIRST_DATAGRAM
from rtcp.virtual.segment import make_segment
from tests.malformed.mutate import garbled, shape

ORDER = b"\xff" * 6 + b"\x02" * 6 + ETHERTYPE.to_bytes(2, "big") + b"\x00\xf0"
"""Beginning of an order: an EtherCAT header of type 15; a JSON object padded with spaces follows."""
FRAME_NS = 100_000
QUIET_NS = 100_000
QUIET_S = 0.001


def ask(interface: str, **order: object) -> dict[str, object]:
    """Send an order to the answerer on the other end; return its answer.

    `garble` and `hide` give the shares of answers that are mutated and that never come; `keep` is a file into which
    the frames that came are written, one of each kind.
    """
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE)) as port:
        port.bind((interface, ETHERTYPE))
        port.send(ORDER + json.dumps(order).encode().ljust(60))
        while True:
            frame = port.recv(1518)
            if frame[:6] == b"\xfe" * 6:
                answer: dict[str, object] = json.loads(frame[len(ORDER) :])
                return answer


class Answerer:
    """Answers frames, one after the other."""

    def __init__(self, config: Path, seed: int, port: socket.socket) -> None:
        self._segment = make_segment(load_segment(config), 0)
        self._random = Random(seed)
        self._port = port
        self._kept: dict[tuple[int, ...], bytes] = {}
        self._garble = self._hide = 0.0
        self._now = 0
        self._answers = self._mutated = 0
        self._buffer = bytearray(2048)

    def take(self) -> None:
        """Receive the waiting frame."""
        self._now += FRAME_NS
        buffer, segment = self._buffer, self._segment
        size = self._port.recv_into(buffer)
        frame = bytes(buffer[:size])
        if frame.startswith(ORDER):
            self._obey(json.loads(frame[len(ORDER) :]))
            return
        if size >= FIRST_DATAGRAM:
            self._kept.setdefault(shape(frame), frame)
        if segment.process(buffer, size, self._now):
            answer = bytes(buffer[:size])
            self._answers += 1
            if self._random.random() < self._garble:
                self._mutated += 1
                answer = garbled(answer, self._random)
            if self._random.random() >= self._hide:
                self._port.send(answer)
            segment.settle(self._now)

    def _obey(self, order: dict[str, object]) -> None:
        self._garble = float(str(order.get("garble", self._garble)))
        self._hide = float(str(order.get("hide", self._hide)))
        if "keep" in order:
            Path(str(order["keep"])).write_text("\n".join(frame.hex() for frame in self._kept.values()))
        counts = json.dumps({"answers": self._answers, "mutated": self._mutated}).encode()
        self._port.send(b"\xfe" * 6 + ORDER[6:] + counts.ljust(60))

    def work(self, quiet: bool) -> None:
        """Run the events that are due."""
        segment = self._segment
        self._now += QUIET_NS if quiet else 0
        while segment.next_event <= self._now:
            segment.tick(self._now)
        while segment.busy:
            segment.step_one()


def main() -> None:
    with private_pair() as (_, own, bring_up):
        bring_up()
        port = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE))
        port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        port.bind((own, ETHERTYPE))
        answerer = Answerer(Path(sys.argv[1]), int(sys.argv[2]), port)
        print(json.dumps({"pid": os.getpid()}), flush=True)
        sources: list[socket.socket | int] = [port, 0]
        while True:
            ready, _, _ = select.select(sources, [], [], QUIET_S)
            if 0 in ready:
                return
            if port in ready:
                answerer.take()
            answerer.work(port not in ready)


if __name__ == "__main__":
    main()
