"""ROS 2 over DDS without ROS: topics compatible with rmw_cyclonedds and rmw_fastrtps.

The only file that imports cyclonedds. Services and actions are not supported: the two middlewares encode the identity
of a request's client differently.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator
from functools import cache
from typing import Any

from cyclonedds.core import GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.idl.annotations import final
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from rtcp.ros.processes import ProcessService
from rtcp.ros.ros2_node import DEPTH, IN, LATCHED, OUT, Commands, Ros2Options
from rtcp.ros.ros2_types import Family, Field, dds_type, fields_of, type_hash

_BASES: dict[str, Any] = {"string": str, "bool": bool, "byte": types.uint8, "char": types.uint8} | {
    name: getattr(types, name)
    for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
}
_BLOCKED_S = 0.1
"""Longest wait of a writer for a reader that does not acknowledge (the default of DDS)."""
_ANY = SampleState.NotRead | ViewState.Any | InstanceState.Any
_LOG = logging.getLogger("rtcp.ros")


@cache
def struct_of(name: str) -> type[IdlStruct]:
    """Return the class of a message for cyclonedds; final, since ROS 2 has no appendable types."""
    fields = {field.name: _type_of(field) for field in fields_of(name)}
    fields = fields or {"structure_needs_at_least_one_member": types.uint8}
    typename = dds_type(name).replace("::", ".")
    struct: type[IdlStruct] = final(make_idl_struct(typename.rpartition(".")[2], typename, fields))
    return struct


def _type_of(field: Field) -> Any:
    inner = _BASES[field.type] if field.type in _BASES else struct_of(field.type)
    if field.length is None:
        return inner
    return types.array(inner, field.length) if field.length else types.sequence(inner)


make = Family(struct_of, lambda values, base: list(values)).make


def qos_of(topic: str, kind: str) -> Qos:
    """Return the quality of service of a topic, with the hash of its type in the user data, for rmw."""
    depth = Policy.History.KeepLast(1 if topic in LATCHED else DEPTH)
    policies = [
        Policy.Reliability.Reliable(duration(seconds=_BLOCKED_S)),
        Policy.Durability.TransientLocal if topic in LATCHED else Policy.Durability.Volatile,
        depth,
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.Userdata(f"typehash={type_hash(kind)};".encode()),
    ]
    if topic in LATCHED:
        # Without it one sample is kept, regardless of the history.
        policies.append(Policy.DurabilityService(0, depth, -1, -1, -1))
    return Qos(*policies)


@contextlib.contextmanager
def open_wire(options: Ros2Options, commands: Commands, ends: threading.Event) -> Iterator[DdsWire]:
    """Open the wire; it needs no router."""
    wire = DdsWire(options, commands)
    try:
        yield wire
    finally:
        wire.close()


class DdsWire:
    """The node as a participant."""

    make = staticmethod(make)
    topics = tuple(OUT)

    def __init__(self, options: Ros2Options, commands: Commands) -> None:
        self._options, self._commands = options, commands
        self._participant = DomainParticipant(options.domain, Qos(Policy.Userdata(b"enclave=/;")))
        self._writers: dict[str, Any] = {
            topic: DataWriter(self._participant, self._topic(topic, kind), qos_of(topic, kind))
            for topic, kind in OUT.items()
        }
        self._ends = GuardCondition(self._participant)
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def publish(self, topic: str, message: Any) -> None:
        """See `Wire`."""
        self._writers[topic].write(message)

    def publish_feedback(self, feedback: Any) -> None:
        """See `Wire`: there are no goals."""

    def serve(self, service: ProcessService) -> None:
        """See `Wire`: there are no services."""

    def close(self) -> None:
        """Stop reading."""
        self._ends.set(True)
        self._reading.join()

    def _topic(self, topic: str, kind: str) -> Any:
        return Topic(self._participant, f"rt/{self._options.resolved(topic)}", struct_of(kind))

    def _read(self) -> None:
        """Pass received messages to the commands, until `close`."""
        waiting = WaitSet(self._participant)
        waiting.attach(self._ends)
        readers: dict[str, Any] = {}
        for topic, kind in IN.items():
            # Best effort also receives from reliable writers.
            qos = Qos(Policy.Reliability.BestEffort, base=qos_of(topic, kind))
            readers[topic] = DataReader(self._participant, self._topic(topic, kind), qos)
            waiting.attach(ReadCondition(readers[topic], _ANY))
        while not self._ends.read():
            waiting.wait(duration(infinite=True))
            for topic, reader in readers.items():
                try:
                    for message in reader.take(DEPTH):
                        if isinstance(message, struct_of(IN[topic])):  # not the end of a writer
                            self._commands.receive(topic, message)
                except Exception as error:  # the thread continues; cyclonedds itself drops invalid bytes
                    _LOG.error("%s: %s", topic, error)
