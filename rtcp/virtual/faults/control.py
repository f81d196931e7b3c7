"""Requests to a running segment, server and client: begin and clear faults, query the state.

Queries include the true motion of the joints, independent of the bus.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rtcp.config.findings import shown
from rtcp.virtual.behaviour import set_value
from rtcp.virtual.device import DeviceModel
from rtcp.virtual.faults.fault import FaultRefused
from rtcp.virtual.faults.registry import FaultRegistry, installed, parse
from rtcp.virtual.models.diewu import CHANNELS, DiewuIoBox
from rtcp.virtual.models.servo import ServoAxis
from rtcp.virtual.objects import Entry, ObjectDictionary
from rtcp.virtual.request_socket import RequestClient, RequestSocket, choose
from rtcp.virtual.segment import Segment
from rtcp.virtual.slave import Slave

MOST_KEYS = 10
"""Upper bound on the keys of a fault, so that messages are found fast between two frames."""
STANDSTILL = 0.002
"""Speed below which a joint counts as at rest, rad/s."""
PATIENCE = 10_000_000_000
"""Time without a request after which monitoring of joints and outputs ends, ns."""
EDGES = 1024
"""Upper bound on stored edges of an output between two requests: sending an answer must not delay a frame."""


class Control(RequestSocket):
    """Request server of a segment."""

    def __init__(self, listener: socket.socket, registry: FaultRegistry, truth: GroundTruth) -> None:
        super().__init__(listener, self._request)
        self._registry = registry
        self._truth = truth
        self._verbs: dict[str, tuple[tuple[str, ...], Callable[[dict[str, Any], int], Any]]] = {
            "fault": (("fault",), self._fault),
            "clear": (("id",), self._clear),
            "faults": ((), lambda _, now: registry.listing(now)),
            "truth": ((), lambda _, now: truth.answer(now)),
            "clear_peaks": ((), lambda _, now: truth.clear_peaks(now)),
            "edges": (("slave", "output"), self._edges),
            "get": (("slave", "index", "subindex"), self._get),
            "set": (("slave", "index", "subindex", "value"), self._set),
        }
        """Verb of a request -> its keys and its handler."""
        for name in installed():
            # Build the checkers now: at the first use it would delay a frame too long.
            parse({"fault": name})

    def _request(self, request: dict[str, Any]) -> Any:
        now = time.monotonic_ns()
        self._truth.requested(now)
        return choose(self._verbs, request)(request, now)

    def _fault(self, request: dict[str, Any], now: int) -> dict[str, int]:
        mapping = request.get("fault")
        if isinstance(mapping, dict) and len(mapping) > MOST_KEYS:
            raise FaultRefused(f"a fault has at most {MOST_KEYS} keys, found {len(mapping)}")
        planned, findings = parse(mapping)
        if planned is None:
            raise FaultRefused("; ".join(map(str, findings)))
        if planned.at:
            raise FaultRefused("at: a fault that is asked for begins at once; only a script has times")
        return {"id": self._registry.begin(planned, now)}

    def _edges(self, request: dict[str, Any], now: int) -> list[int]:
        slave, output = request.get("slave"), request.get("output")
        if type(slave) is not int or type(output) is not int:
            raise FaultRefused(f"found slave {shown(slave)}, output {shown(output)}, allowed are two numbers, from 1")
        return self._truth.edges(slave, output, now)

    def _get(self, request: dict[str, Any], now: int) -> list[dict[str, Any]]:
        device = self._device_of(request)
        if "index" in request:
            return [_shown_entry(_entry_of(device, request))]
        images = [device.image(index) for index in device.roles.outputs + device.roles.inputs]
        return [_shown_entry(entry) for image in images if image is not None for entry in image.entries]

    def _set(self, request: dict[str, Any], now: int) -> dict[str, Any]:
        entry, value = _entry_of(self._device_of(request), request), request.get("value")
        try:
            if entry.is_bytes and isinstance(value, str):
                value = bytes.fromhex(value[2:]) if value.startswith("0x") else value.encode()
            set_value(entry, value)  # type: ignore[arg-type]  # it says which kinds an object takes
        except ValueError as error:
            raise FaultRefused(f"value: {error}") from error
        return _shown_entry(entry)

    def _device_of(self, request: dict[str, Any]) -> DeviceModel:
        device = self._truth.slave_of(request.get("slave")).device
        if not isinstance(device.objects, ObjectDictionary):
            raise FaultRefused(f"slave: the behaviour of {device.identity.name} has set its `objects` to another thing")
        return device

    def _clear(self, request: dict[str, Any], now: int) -> dict[str, list[int]]:
        number = request.get("id")
        if number is not None and type(number) is not int:
            raise FaultRefused(f"id: found {shown(number)}, allowed is the number of a fault, or none for all")
        return {"cleared": self._registry.clear(number, now)}


def _entry_of(device: DeviceModel, request: dict[str, Any]) -> Entry:
    index, subindex = request.get("index"), request.get("subindex", 0)
    if type(index) is not int or type(subindex) is not int:
        raise FaultRefused(f"found object {shown(index)}:{shown(subindex)}, allowed are two numbers")
    if (index, subindex) not in device.objects:
        raise FaultRefused(f"{device.identity.name} has no object 0x{index:04X}:{subindex}")
    return device.objects[index, subindex]


def _shown_entry(entry: Entry) -> dict[str, Any]:
    value = f"0x{entry.value.hex()}" if isinstance(entry.value, bytes) else entry.value
    return {"index": entry.index, "subindex": entry.subindex, "name": entry.name, "value": value}


class _Joint:
    """A monitored joint: time of its last motion, peak speed."""

    __slots__ = ("drive", "moved", "peak")

    def __init__(self, drive: ServoAxis) -> None:
        self.drive = drive
        self.moved = 0
        self.peak = 0.0

    def update(self, now: int) -> None:
        """Record the present motion."""
        speed = abs(self.drive.mechanics.velocity)
        if speed > STANDSTILL:
            self.moved = now
            self.peak = max(self.peak, speed)


class _Output:
    """A monitored digital output: times of its changes by frames, ns of its slave's own clock."""

    __slots__ = ("_byte", "_level", "_mask", "_slave", "edges")

    def __init__(self, slave: Slave, output: int) -> None:
        self._slave = slave
        self._byte, bit = divmod(output - 1, 8)
        self._mask = 1 << bit
        self._level: int | None = None
        self.edges: deque[int] = deque(maxlen=EDGES)

    def update(self, outputs: memoryview, t: int) -> None:
        """Record `t` if the outputs that arrived then change it."""
        level = outputs[self._byte] & self._mask
        if level != self._level:
            if self._level is not None and self._slave.clock is not None:
                self.edges.append(self._slave.clock.local(t))
            self._level = level


class GroundTruth:
    """Monitors joints and outputs from the first request until requests cease; costs nothing otherwise.

    While `watching`, call `update` after each step of a device.
    """

    def __init__(self, segment: Segment, models: Sequence[str]) -> None:
        self.watching = False
        self._asked: int | None = None
        """Instant of the last request; None: no request for the truth yet."""
        self._segment = segment
        self._models = tuple(models)
        self._joints = {
            slave: [_Joint(servo) for servo in slave.device.servos] for slave in segment.slaves if slave.device.servos
        }
        self._output: tuple[int, int, _Output] | None = None

    def update(self, slave: Slave, now: int) -> None:
        """Record the joint of `slave`, just stepped, at instant `now`."""
        for joint in self._joints.get(slave, ()):
            joint.update(now)
        if self._asked is not None and now - self._asked > PATIENCE:
            self.watching = False
            self._release_output()

    def requested(self, now: int) -> None:
        """Prolong the monitoring, at any request."""
        if self._asked is not None:
            self._watch(now)

    def _watch(self, now: int) -> None:
        self.watching = True
        self._asked = now

    def clear_peaks(self, now: int) -> None:
        """Reset the peak speeds."""
        self._watch(now)
        for joints in self._joints.values():
            for joint in joints:
                joint.peak = 0.0

    def edges(self, position: int, output: int, now: int) -> list[int]:
        """Return the times of changes of an output since the last call, ns of its slave's own clock.

        The first call starts the recording; a call for another output ends it.

        Raises:
            FaultRefused: unknown output.
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
        # After a power cycle a slave has a new application.
        slave.application.outputs_watch = watched[2].update
        edges = list(watched[2].edges)
        watched[2].edges.clear()
        return edges

    def slave_of(self, wanted: object) -> Slave:
        """Return the slave at a position from 1 or with a label; raises FaultRefused."""
        slaves = self._segment.slaves
        if type(wanted) is int and 1 <= wanted <= len(slaves):
            return slaves[wanted - 1]
        places = [place for place, label in enumerate(self._models) if label == wanted]
        if len(places) != 1:
            named = f'called "{wanted[:60]}"' if isinstance(wanted, str) else shown(wanted)
            count = f"{len(places)} slaves are {named}" if places else f"there is no slave {named}"
            raise FaultRefused(f"slave: {count}; give a position from 1 to {len(slaves)}, or a name")
        return slaves[places[0]]

    def _release_output(self) -> None:
        if self._output is not None:
            self._segment.slaves[self._output[0] - 1].application.outputs_watch = None
            self._output = None

    def answer(self, now: int) -> dict[str, Any]:
        """Return the true state of each slave at instant `now`."""
        self._watch(now)
        for joints in self._joints.values():
            for joint in joints:
                joint.update(now)
        slaves = zip(self._segment.slaves, self._models, strict=True)
        return {
            "time_ns": now,
            "slaves": [self._of(position, slave, model) for position, (slave, model) in enumerate(slaves, 1)],
        }

    def _of(self, position: int, slave: Slave, model: str) -> dict[str, Any]:
        report: dict[str, Any] = {
            "position": position,
            "model": model,
            "al": slave.application.state.name.replace("_", "-"),
            "reachable": slave in self._segment.topology.reached,
        }
        report |= slave.device.truth()
        joints = [_truth_of(joint) for joint in self._joints.get(slave, ())]
        if joints:
            report |= joints[0]
        if len(joints) > 1:
            report["axes"] = joints
        return report


def _truth_of(joint: _Joint) -> dict[str, Any]:
    drive = joint.drive
    return {
        "position_rad": drive.mechanics.position,
        "velocity_rad_s": drive.mechanics.velocity,
        "state": drive.state.name.lower().replace("_", " "),
        "torque_on": drive.powered,
        "moved_ns": joint.moved,
        "peak_rad_s": joint.peak,
    }


class SegmentClient(RequestClient):
    """A connection to the control socket of a segment at `path`; raises the errors of `RequestClient`."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "segment")

    def fault(self, fault: Mapping[str, Any]) -> int:
        """Begin a fault, as `{"fault": "cable", "after": 3, "lasts": 1.5}`; return its number."""
        return int(self.ask({"do": "fault", "fault": dict(fault)})["id"])

    def clear(self, number: int | None = None) -> list[int]:
        """End a fault or all; return the numbers of those that were active."""
        request = {"do": "clear"} if number is None else {"do": "clear", "id": number}
        return list(self.ask(request)["cleared"])

    def faults(self) -> list[dict[str, Any]]:
        """Return the active faults: `id`, `fault`, `since_s`, `left_s` (None: until it is cleared), `counts`."""
        return list(self.ask({"do": "faults"}))

    def truth(self) -> dict[str, Any]:
        """Return the true state of the slaves, independent of the bus.

        `time_ns` (CLOCK_MONOTONIC) and `slaves`, a list with `position`, `model`, `al` (as "SAFE-OP"), `reachable`; of
        drives `position_rad`, `velocity_rad_s`, `state` (CiA 402), `torque_on`, `moved_ns` (last instant at which it
        was faster than 0.002 rad/s; 0: not since the first question) and `peak_rad_s` (since `clear_peaks`), of drives
        with several axes those of the first, and of each in `axes`; of a shape
        setter's box `gate`, `relay`, `relay_closed`, `current` (A) and `middle_temperature` (C). Monitoring pauses
        after 10 s without a request.
        """
        return dict(self.ask({"do": "truth"}))

    def clear_peaks(self) -> None:
        """Reset `peak_rad_s`."""
        self.ask({"do": "clear_peaks"})

    def edges(self, slave: int, output: int) -> list[int]:
        """Return the times of changes of an output (from 1) of the IO box at position `slave`, ns of the box's clock.

        The first call starts the recording; each further one returns up to 1024 edges since the last.
        """
        return list(self.ask({"do": "edges", "slave": slave, "output": output}))

    def get(self, slave: int | str, index: int | None = None, subindex: int = 0) -> list[dict[str, Any]]:
        """Return an object of a slave (a position from 1 or a name); without `index` all of its process data.

        Each has `index`, `subindex`, `name` and `value`; bytes are `0x` and hexadecimal digits.
        """
        request: dict[str, Any] = {"do": "get", "slave": slave}
        if index is not None:
            request |= {"index": index, "subindex": subindex}
        return list(self.ask(request))

    def set(self, slave: int | str, index: int, subindex: int, value: float | str) -> dict[str, Any]:
        """Set an object of a slave, as an input, without access checks; return it as `get` does."""
        request = {"do": "set", "slave": slave, "index": index, "subindex": subindex, "value": value}
        return dict(self.ask(request))
