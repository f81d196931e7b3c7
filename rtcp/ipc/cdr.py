"""Batches of ROS 2 messages in CDR (OMG DDSI-RTPS, 10.5): strings are constant, numpy fills in the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.ipc.schema import RecordSchema

ENCAPSULATION = b"\x00\x01\x00\x00"
"""CDR, little endian (OMG DDSI-RTPS, 10.5)."""


class CdrTemplate:
    """A message under construction: fixed parts are written once, numbers that change are named."""

    def __init__(self) -> None:
        self._fixed = bytearray()
        self._fields: dict[str, tuple[str, tuple[int, ...], int]] = {}

    def string(self, text: str) -> CdrTemplate:
        """Append a fixed string."""
        encoded = text.encode() + b"\0"
        return self.count(len(encoded))._append(encoded)

    def count(self, number: int) -> CdrTemplate:
        """Append a fixed uint32, as the length of a sequence."""
        return self._align(4)._append(number.to_bytes(4, "little"))

    def numbers(self, name: str, code: str, *shape: int) -> CdrTemplate:
        """Append numbers of a numpy type (as `<f8`) that `fill` writes."""
        kind = np.dtype(code)
        self._align(kind.itemsize)
        self._fields[name] = (code, shape, len(self._fixed))
        return self._append(bytes(kind.itemsize * int(np.prod(shape, dtype=int))))

    def stamp(self, frame: str, suffix: str = "") -> CdrTemplate:
        """Append a std_msgs/Header: its time is named sec and nanosec, with `suffix`."""
        return self.numbers(f"sec{suffix}", "<i4").numbers(f"nanosec{suffix}", "<u4").string(frame)

    def record(self, schema: RecordSchema) -> CdrTemplate:
        """Append the fields of a cycle record, by their names; its size is that of `rtcp.ipc.recording.cycle_type`."""
        for field in schema.fields:
            self.numbers(field.name, np.dtype(field.type).newbyteorder("<").str, *field.shape)
        return self._align(8)

    def fill(self, count: int, values: Mapping[str, npt.ArrayLike] | npt.NDArray[np.void]) -> list[bytes]:
        """Return `count` messages; each value has `count` as its first dimension."""
        blank = np.frombuffer(ENCAPSULATION + bytes(self._fixed), np.uint8)
        rows = np.tile(blank, (count, 1))
        kind = np.dtype({
            "names": list(self._fields),
            "formats": [(code, shape) for code, shape, _ in self._fields.values()],
            "offsets": [len(ENCAPSULATION) + at for _, _, at in self._fields.values()],
            "itemsize": len(blank),
        })  # fmt: skip
        filled = rows.view(kind)[:, 0]
        for name in self._fields:
            filled[name] = values[name]
        data, size = rows.tobytes(), len(blank)
        return [data[at : at + size] for at in range(0, count * size, size)]

    def _align(self, size: int) -> CdrTemplate:
        return self._append(bytes(-len(self._fixed) % size))

    def _append(self, data: bytes) -> CdrTemplate:
        self._fixed += data
        return self


def stamps(time_ns: npt.NDArray[Any], suffixes: Sequence[str] = ("",)) -> dict[str, npt.ArrayLike]:
    """Return the fields of headers with these times, CLOCK_REALTIME ns."""
    sec, nanosec = np.divmod(time_ns, 1_000_000_000)
    return {f"{name}{suffix}": value for suffix in suffixes for name, value in (("sec", sec), ("nanosec", nanosec))}
