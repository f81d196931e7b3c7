"""The control socket of a segment, both ends: other processes begin and clear faults, and ask, while it runs.

What the joints truly do, whatever the master hears of it, is among the questions.

A Unix socket of packets, one JSON object each: `{"do": "fault", "fault": {...}}` is answered by `{"ok": true, "result":
...}` or by `{"ok": false, "error": "a sentence"}`. Frames come first: nothing here waits for a client.
"""

from __future__ import annotations

import json
import os
import select
import socket
import stat
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from rtcp.config.document import shown
from rtcp.config.validation import unknown_key
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.registry import FaultRegistry, installed, parse, sentence_of
from rtcp.virtual.models.cubemars import CubemarsDrive
from rtcp.virtual.models.diewu import CHANNELS, DiewuIoBox
from rtcp.virtual.segment import Segment
from rtcp.virtual.slave import Slave

LONGEST_REQUEST = 1024
MOST_KEYS = 10
"""What is read between two frames is short: no sentence takes long to find."""
MOST_CLIENTS = 16
"""When another comes, the one that has been silent longest has to go."""
BACKLOG = 16
STANDSTILL = 0.002
"""A joint slower than this, rad/s, stands."""
PATIENCE = 10_000_000_000
"""Time without a request after which joints and outputs are no longer watched, ns."""
EDGES = 1024
"""Edges of an output that are kept between two questions: what is sent in one answer must not keep a frame waiting."""


@contextmanager
def control_socket(path: Path) -> Iterator[socket.socket]:
    """Listen at `path`, for this user alone; the file is removed at the end. One that nobody listens at is replaced.

    Raises:
        ValueError: the path is in use, of something else, or cannot be made; the message is a sentence.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.setblocking(False)
        _make_room(path)
        before = os.umask(0o177)
        try:
            listener.bind(str(path))
            listener.listen(BACKLOG)
        except OSError as error:
            raise ValueError(f"the control socket {path} cannot be made: {error.strerror or error}") from error
        finally:
            os.umask(before)
        try:
            yield listener
        finally:
            with suppress(OSError):
                path.unlink()


def _make_room(path: Path) -> None:
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise ValueError(f"the control socket {path} cannot be made: there is a file that is no socket")
        if _in_use(path):
            raise ValueError(f"the control socket {path} is in use by a segment that runs: choose another path")
        path.unlink()
    except FileNotFoundError:
        pass
    except OSError as error:
        raise ValueError(f"the control socket {path} cannot be made: {error.strerror or error}") from error


def _in_use(path: Path) -> bool:
    """Whether a process listens at the socket `path`."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except (FileNotFoundError, ConnectionRefusedError, NotADirectoryError):
            return False
        except OSError:
            pass  # a full queue or the socket of another user
    return True


class Control:
    """Answers one request a look, so that a client that floods takes no more of the time than one that asks."""

    def __init__(self, listener: socket.socket, registry: FaultRegistry, truth: GroundTruth) -> None:
        self._listener = listener
        self._registry = registry
        self._truth = truth
        self._clients: dict[int, socket.socket] = {}
        self._epoll = select.epoll()
        self._epoll.register(listener, select.EPOLLIN)
        self._verbs: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Any], int], Any]]] = {
            "fault": (("fault",), self._fault),
            "clear": (("id",), self._clear),
            "faults": ((), lambda _, now: registry.listing(now)),
            "truth": ((), lambda _, now: truth.answer(now)),
            "clear_peaks": ((), lambda _, now: truth.clear_peaks(now)),
            "edges": (("slave", "output"), self._edges),
        }
        """What a request can ask for: its keys, and what answers it."""
        for name in installed():
            # What a kind allows is worked out when it is first named, which takes longer than a frame may wait.
            parse({"fault": name})

    def close(self) -> None:
        """Let all clients go."""
        self._epoll.close()
        for client in self._clients.values():
            client.close()

    def look(self) -> None:
        """Take a new client, or answer one request, where there is one."""
        for descriptor, _ in self._epoll.poll(0, 1):
            client = self._clients.get(descriptor)
            if client is None:
                self._accept()
            else:
                self._serve(client)

    def _accept(self) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError:
            return  # it has gone already
        client.setblocking(False)
        if len(self._clients) >= MOST_CLIENTS:
            self._dismiss(next(iter(self._clients.values())))
        self._clients[client.fileno()] = client
        self._epoll.register(client, select.EPOLLIN)

    def _serve(self, client: socket.socket) -> None:
        try:
            packet = client.recv(LONGEST_REQUEST + 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet or not self._send(client, self._answer(packet)):
            self._dismiss(client)
            return
        # The one that has been silent longest stands first.
        self._clients[client.fileno()] = self._clients.pop(client.fileno())

    def _dismiss(self, client: socket.socket) -> None:
        del self._clients[client.fileno()]
        self._epoll.unregister(client)
        client.close()

    @staticmethod
    def _send(client: socket.socket, answer: dict[str, Any]) -> bool:
        """Send an answer; False to a client that does not fetch its answers, or has gone."""
        try:
            client.send(json.dumps(answer).encode(), socket.MSG_NOSIGNAL)
        except OSError:
            return False
        return True

    def _answer(self, packet: bytes) -> dict[str, Any]:
        try:
            request = _request(packet)
            verb = request.pop("do", None)
            if not isinstance(verb, str) or verb not in self._verbs:
                raise FaultRefused(f"do: found {shown(verb)}, allowed is one of {', '.join(self._verbs)}")
            now = time.monotonic_ns()
            self._truth.requested(now)
            known, answer = self._verbs[verb]
            for key in request:
                if key not in known:
                    raise FaultRefused(f"{key}: {unknown_key(key, ['do', *known])}")
            return {"ok": True, "result": answer(request, now)}
        except FaultRefused as refusal:
            return {"ok": False, "error": str(refusal)}

    def _fault(self, request: dict[str, Any], now: int) -> dict[str, int]:
        mapping = request.get("fault")
        if isinstance(mapping, dict) and len(mapping) > MOST_KEYS:
            raise FaultRefused(f"a fault has at most {MOST_KEYS} keys, found {len(mapping)}")
        planned, findings = parse(mapping)
        if planned is None:
            raise FaultRefused("; ".join(map(sentence_of, findings)))
        if planned.at:
            raise FaultRefused("at: a fault that is asked for begins at once; only a script has times")
        return {"id": self._registry.begin(planned, now)}

    def _edges(self, request: dict[str, Any], now: int) -> list[int]:
        slave, output = request.get("slave"), request.get("output")
        if type(slave) is not int or type(output) is not int:
            raise FaultRefused(f"found slave {shown(slave)}, output {shown(output)}, allowed are two numbers, from 1")
        return self._truth.edges(slave, output, now)

    def _clear(self, request: dict[str, Any], now: int) -> dict[str, list[int]]:
        number = request.get("id")
        if number is not None and type(number) is not int:
            raise FaultRefused(f"id: found {shown(number)}, allowed is the number of a fault, or none for all")
        return {"cleared": self._registry.clear(number, now)}


def _request(packet: bytes) -> dict[str, Any]:
    if len(packet) > LONGEST_REQUEST:
        raise FaultRefused(f"a request has at most {LONGEST_REQUEST} bytes")
    try:
        request = json.loads(packet)
    except (ValueError, RecursionError) as error:
        raise FaultRefused("a request is one JSON object in UTF-8, and this is none") from error
    if not isinstance(request, dict):
        raise FaultRefused(f"found {shown(request)}, allowed is an object with the key do")
    return request


class _Joint:
    """A drive that is watched: when it last moved, how fast it was at most."""

    __slots__ = ("drive", "moved", "peak")

    def __init__(self, drive: CubemarsDrive) -> None:
        self.drive = drive
        self.moved = 0
        self.peak = 0.0

    def look(self, now: int) -> None:
        """Remember what it does now."""
        speed = abs(self.drive.mechanics.velocity)
        if speed > STANDSTILL:
            self.moved = now
            self.peak = max(self.peak, speed)


class _Output:
    """A digital output that is watched: when frames changed it, ns of its slave's own clock."""

    __slots__ = ("_byte", "_level", "_mask", "_slave", "edges")

    def __init__(self, slave: Slave, output: int) -> None:
        self._slave = slave
        self._byte, bit = divmod(output - 1, 8)
        self._mask = 1 << bit
        self._level: int | None = None
        self.edges: deque[int] = deque(maxlen=EDGES)

    def look(self, outputs: memoryview, t: int) -> None:
        """Remember the instant where the outputs that arrived at `t` change it."""
        level = outputs[self._byte] & self._mask
        if level != self._level:
            if self._level is not None and self._slave.clock is not None:
                self.edges.append(self._slave.clock.local(t))
            self._level = level


class GroundTruth:
    """Watches joints and outputs from the first question on, while requests come: else a segment pays nothing.

    While `watching`, `look` is to be called after each step of a device.
    """

    def __init__(self, segment: Segment, models: Sequence[str]) -> None:
        self.watching = False
        self._asked: int | None = None
        """Instant of the last request; None: nobody has ever asked for the truth."""
        self._chain = segment.chain
        self._segment = segment
        self._models = tuple(models)
        self._joints = {
            slave: _Joint(slave.device) for slave in segment.slaves if isinstance(slave.device, CubemarsDrive)
        }
        self._output: tuple[int, int, _Output] | None = None

    def look(self, slave: Slave, now: int) -> None:
        """See whether the joint of `slave`, which was stepped, moves at instant `now`."""
        joint = self._joints.get(slave)
        if joint is not None:
            joint.look(now)
        if self._asked is not None and now - self._asked > PATIENCE:
            self.watching = False
            self._release_output()

    def requested(self, now: int) -> None:
        """Somebody asked for something: who has once asked for the truth may ask for it again."""
        if self._asked is not None:
            self._watch(now)

    def _watch(self, now: int) -> None:
        self.watching = True
        self._asked = now

    def clear_peaks(self, now: int) -> None:
        """Forget how fast the joints were."""
        self._watch(now)
        for joint in self._joints.values():
            joint.peak = 0.0

    def edges(self, position: int, output: int, now: int) -> list[int]:
        """Return when frames changed an output since the last question, ns of its slave's own clock.

        The first question begins; one about another output ends it.

        Raises:
            FaultRefused: there is no such output.
        """
        slaves = self._segment.slaves
        box = slaves[position - 1].device if 1 <= position <= len(slaves) else None
        if not isinstance(box, DiewuIoBox) or not 1 <= output <= CHANNELS:
            raise FaultRefused(f"slave {position} has no output {output}: allowed are 1 to {CHANNELS} of an IO box")
        self._watch(now)
        slave, watched = slaves[position - 1], self._output
        if watched is None or watched[:2] != (position, output):
            self._release_output()
            self._output = watched = position, output, _Output(slave, output)
        # A slave that had no supply has a new application.
        slave.application.outputs_watch = watched[2].look
        found = list(watched[2].edges)
        watched[2].edges.clear()
        return found

    def _release_output(self) -> None:
        if self._output is not None:
            self._segment.slaves[self._output[0] - 1].application.outputs_watch = None
            self._output = None

    def answer(self, now: int) -> dict[str, Any]:
        """Return what is true at instant `now`, slave by slave."""
        self._watch(now)
        for joint in self._joints.values():
            joint.look(now)
        slaves = zip(self._segment.slaves, self._models, strict=True)
        return {
            "time_ns": now,
            "slaves": [self._of(position, slave, model) for position, (slave, model) in enumerate(slaves, 1)],
        }

    def _of(self, position: int, slave: Slave, model: str) -> dict[str, Any]:
        found: dict[str, Any] = {
            "position": position,
            "model": model,
            "al": slave.application.state.name.replace("_", "-"),
            "reachable": position <= self._segment.chain.reach,
        }
        joint = self._joints.get(slave)
        if joint is not None:
            drive = joint.drive
            found |= {
                "position_rad": drive.mechanics.position,
                "velocity_rad_s": drive.mechanics.velocity,
                "state": drive.state.name.lower().replace("_", " "),
                "torque_on": drive.powered,
                "moved_ns": joint.moved,
                "peak_rad_s": joint.peak,
            }
        return found


ANSWER_TIMEOUT_S = 10.0
LONGEST_ANSWER = 1 << 20


class SegmentRefused(Exception):
    """The segment will not do this: its sentence."""


class SegmentAway(Exception):
    """No segment answers: a sentence that says where one was looked for."""


class SegmentClient:
    """A connection to the segment whose control socket is at `path`.

    Raises:
        SegmentAway: by each method, where there is no segment, or it has gone, or does not answer.
        SegmentRefused: by each method, with the segment's sentence.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_TIMEOUT_S)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise SegmentAway(f"no segment answers at {path} ({error.strerror or error})") from error

    def __enter__(self) -> SegmentClient:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:  # fmt: skip
        self.close()

    def close(self) -> None:
        """Leave; faults stay as they are."""
        self._socket.close()

    def fault(self, fault: Mapping[str, Any]) -> int:
        """Let a fault begin, as `{"fault": "cable", "after": 3, "lasts": 1.5}`; return its number."""
        return int(self._ask({"do": "fault", "fault": dict(fault)})["id"])

    def clear(self, number: int | None = None) -> list[int]:
        """End a fault, or all of them; return the numbers of those that were active."""
        request = {"do": "clear"} if number is None else {"do": "clear", "id": number}
        return list(self._ask(request)["cleared"])

    def faults(self) -> list[dict[str, Any]]:
        """Return the active faults: `id`, `fault`, `since_s`, `left_s` (None: until it is cleared), `counts`."""
        return list(self._ask({"do": "faults"}))

    def truth(self) -> dict[str, Any]:
        """Return what the slaves truly do, also when no frame comes back.

        `time_ns` (CLOCK_MONOTONIC) and `slaves`, a list with `position`, `model`, `al` (as "SAFE-OP"), `reachable`; of
        drives `position_rad`, `velocity_rad_s`, `state` (CiA 402), `torque_on`, `moved_ns` (last instant at which it
        was faster than 0.002 rad/s; 0: not since the first question) and `peak_rad_s` (since `clear_peaks`). Who asks
        for nothing for 10 s misses what moves until the next request.
        """
        return dict(self._ask({"do": "truth"}))

    def clear_peaks(self) -> None:
        """Let `peak_rad_s` count from now."""
        self._ask({"do": "clear_peaks"})

    def edges(self, slave: int, output: int) -> list[int]:
        """Return when an output (from 1) of the IO box at position `slave` changed, ns of the box's own clock.

        The first question begins; each returns what came since the one before it, of which 1024 edges are kept.
        """
        return list(self._ask({"do": "edges", "slave": slave, "output": output}))

    def _ask(self, request: dict[str, Any]) -> Any:
        try:
            self._socket.send(json.dumps(request).encode())
            packet = self._socket.recv(LONGEST_ANSWER)
        except TimeoutError as error:
            raise SegmentAway(f"the segment at {self._path} does not answer within {ANSWER_TIMEOUT_S:g} s") from error
        except OSError as error:
            raise SegmentAway(f"the segment at {self._path} has gone ({error.strerror or error})") from error
        if not packet:
            raise SegmentAway(f"the segment at {self._path} has gone")
        answer = json.loads(packet)
        if not answer["ok"]:
            raise SegmentRefused(answer["error"])
        return answer["result"]
