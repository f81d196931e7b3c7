"""The master's own parsers on mutated answers: registers, states, mailboxes, SDOs, emergencies, PDO assignments.

RegisterPort is the real one; its socket leads into a segment in this process, and time is that segment's, so that a
million answers are a matter of minutes. What goes over real sockets is in master_child.py.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

from rtcp.config import default_config, load
from rtcp.fieldbus import AlState, BusError, al_state, registers, scan
from rtcp.fieldbus.bus import MailboxInfo, SlaveState
from rtcp.fieldbus.mailbox import Mailbox, SdoClient, parse_emergency
from rtcp.fieldbus.pdo import reading_assignment
from rtcp.fieldbus.registers import RegisterPort, finish
from rtcp.fieldbus.slave_setup import configure_slave
from rtcp.ipc.events import EmergencyMessage
from rtcp.virtual.device import Emergency
from tests.malformed.line import OP, PRE_OP, SIZES, STATION, Line
from tests.malformed.mutate import garbled
from tests.malformed.mutated_frames import Memory, Outcome

CONFIGS = load(default_config()).slaves
LONGEST_S = 60.0
"""Simulated time limit of one service, s."""
_BOX = MailboxInfo(0x1000, 128, 0x1080, 128, ("CoE",))
_TURN = 200


class Loopback:
    """The socket of RegisterPort; a `share` of the answers is mutated, late, doubled or lost."""

    def __init__(self, line: Line, random: Random) -> None:
        self.line = line
        self.share = 0.0
        self.mutated = 0
        self._random = random
        self._waiting: deque[bytes] = deque()
        self._timeout = 0.0

    def settimeout(self, seconds: float) -> None:
        self._timeout = seconds

    def send(self, frame: bytes) -> None:
        answer = self.line.give(frame)
        if answer is None:
            return
        random = self._random
        if random.random() >= self.share:
            self._waiting.append(answer)
            return
        self.mutated += 1
        kind = random.random()
        if kind < 0.8:
            self._waiting.append(garbled(answer, random))
        elif kind < 0.9:
            self._waiting += (garbled(answer, random), answer)
        elif kind < 0.95:
            self._waiting += (answer, answer)

    def recv(self, size: int) -> bytes:
        if self._waiting:
            return self._waiting.popleft()[:size]
        self.line.pass_time(round(self._timeout * 1e9) + 1)
        raise TimeoutError

    def close(self) -> None:
        self._waiting.clear()


class Clock:
    """The module `time`, as far as the master's parsers use it, in the segment's time."""

    def __init__(self, line: Line) -> None:
        self._line = line

    def monotonic(self) -> float:
        return self._line.now * 1e-9

    def sleep(self, seconds: float) -> None:
        self._line.pass_time(round(seconds * 1e9))


@contextlib.contextmanager
def looped(line: Line, random: Random, kind: type[Loopback] = Loopback) -> Iterator[tuple[RegisterPort, Loopback]]:
    """Connect the master's registers and its clock to a segment meanwhile."""
    loopback, clock = kind(line, random), Clock(line)
    modules = [module for name, module in sys.modules.items() if name.startswith("rtcp.fieldbus.")]
    timed: list[Any] = [module for module in modules if getattr(module, "time", None) is time]
    made: Any = registers
    opened = made.open_socket
    made.open_socket = lambda interface, first, last: loopback
    for module in timed:
        module.time = clock
    try:
        yield RegisterPort("loop"), loopback
    finally:
        made.open_socket = opened
        for module in timed:
            module.time = time


class Master:
    """The actions of a master beside its cycle."""

    def __init__(self, line: Line, port: RegisterPort, random: Random) -> None:
        self._line, self._port, self._random = line, port, random
        lock = threading.Lock()
        self.emergencies: list[EmergencyMessage] = []
        self._boxes = [Mailbox(port, STATION + at, _BOX) for at in range(len(SIZES))]
        self._sdos = [SdoClient(box, at + 1, CONFIGS[at].name, lock, self._keep) for at, box in enumerate(self._boxes)]
        self.actions: tuple[Callable[[int], object], ...] = (
            self._states, self._wait, self._registers, self._upload, self._upload, self._name, self._download,
            self._assignment, self._mailbox, self._configure, self._serial,
        )  # fmt: skip

    def _keep(self, message: bytes, position: int) -> None:
        if (emergency := parse_emergency(message, position)) is not None:
            self.emergencies.append(emergency)

    def do(self) -> None:
        """Run a random action with a slave; raises only BusError."""
        self._random.choice(self.actions)(self._random.randrange(len(SIZES)))

    def _states(self, at: int) -> None:
        state, error, code = al_state.read_al(self._port, STATION + at)
        SlaveState(at + 1, STATION + at, "x", state, error, code).words()

    def _wait(self, at: int) -> None:
        where = {STATION + at: "it"}
        al_state.request_state(self._port, where, AlState.PREOP)
        al_state.wait_for_state(self._port, where, AlState.PREOP, 0.01)
        al_state.acknowledge(self._port, STATION + at)

    def _registers(self, at: int) -> None:
        counters = self._port.read(STATION + at, 0x0300, 20)
        assert counters is None or len(counters) == 20
        assert len(self._port.read_all(0x0130, 2).data) in (0, 2)
        scan._sync_managers(self._port, STATION + at)

    def _upload(self, at: int) -> None:
        index = self._random.choice((0x1000, 0x1018, 0x1600, 0x1C12, 0x6041, 0x6064, 0x603F))
        self._sdos[at].read(index, self._random.randrange(3))

    def _name(self, at: int) -> None:
        self._sdos[at].read(0x1008, 0)

    def _download(self, at: int) -> None:
        self._sdos[at].write(0x6065, 0, self._random.randbytes(self._random.choice((2, 4, 4, 200))))

    def _assignment(self, at: int) -> None:
        finish(reading_assignment(self._sdos[at], self._random.choice((0x1C12, 0x1C13))))

    def _mailbox(self, at: int) -> None:
        self._line.segment.slaves[at].application.device.emergencies.append(Emergency(0x8611, 1, b"12345"))
        self._line.pass_time(2_000_000)
        for _ in range(4):
            if (message := self._boxes[at].receive()) is not None:
                self._keep(message, at + 1)

    def _configure(self, at: int) -> None:
        if self._random.random() < 0.1:
            finish(configure_slave(self._sdos[at], self._port, STATION + at, CONFIGS[at], 1_000_000))

    def _serial(self, at: int) -> None:
        self._sdos[at].read(0x1018, 4)


def run(count: int, seed: int) -> Outcome:
    """Run a master's actions until `count` answers were mutated; a failure names the action's number."""
    outcome = Outcome("master, own parsers")
    random, line = Random(seed), Line()
    began = time.monotonic()
    memory: Memory | None = None
    with looped(line, random) as (port, loopback):
        while loopback.mutated < count and len(outcome.failures) < 10:
            if memory is None and loopback.mutated >= 0.3 * count:
                memory = Memory()
            loopback.share = 0.0
            loopback.close()
            try:
                line.start(random.choice((PRE_OP, OP)))
                sane = Master(line, port, random)
                assert finish(reading_assignment(sane._sdos[1], 0x1C12))[0].bits == 120
                outcome.starts += 1
            except Exception:
                outcome.failures.append(f"sane again after {loopback.mutated}:\n{traceback.format_exc()}")
                line.__init__()  # type: ignore[misc]
                continue
            loopback.share = random.choice((0.02, 0.3, 0.9))
            _mutate(line, Master(line, port, random), loopback, outcome, count)
    outcome.frames = loopback.mutated
    outcome.seconds = time.monotonic() - began
    if memory is not None:
        memory.report(outcome)
    return outcome


def _mutate(line: Line, master: Master, loopback: Loopback, outcome: Outcome, count: int) -> None:
    for _ in range(_TURN):
        if loopback.mutated >= count:
            return
        before = line.now
        try:
            master.do()
            outcome.kinds["done"] += 1
        except BusError as error:
            outcome.kinds["refused"] += 1
            if not all(len(sentence) > 10 for sentence in error.sentences):
                outcome.failures.append(f"no sentence: {error!r}")
        except Exception:
            outcome.failures.append(f"after {loopback.mutated}:\n{traceback.format_exc()}")
        if line.now - before > LONGEST_S * 1e9:
            outcome.failures.append(f"after {loopback.mutated}: took {(line.now - before) / 1e9:.0f} s")
    outcome.kinds["emergencies"] += len(master.emergencies)
