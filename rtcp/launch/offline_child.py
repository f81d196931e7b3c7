"""The process that opens a bus for one question: a JSON object on standard input, one on standard output."""

from __future__ import annotations

import dataclasses
import json
import signal
import sys
from types import FrameType
from typing import Any

from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.soem import SoemBus


def answer(question: dict[str, Any]) -> dict[str, Any]:
    """Open the bus, ask, close it.

    Args:
        question: `interface`, `namespace_pid` (None: our own namespaces), `do` and the arguments of that.

    Returns:
        `slaves`, `hex` or nothing, as was asked; or `error`, a sentence, and its `kind`.

    Raises:
        BusError: as the bus raises it.
    """
    bus = SoemBus(question["interface"], namespace_pid=question["namespace_pid"])
    bus.open()
    try:
        slaves = bus.scan()
        if question["do"] == "scan":
            return {"slaves": [dataclasses.asdict(slave) for slave in slaves]}
        position, index, subindex = question["slave"], question["index"], question["subindex"]
        if not 1 <= position <= len(slaves):
            return {
                "error": f"no slave at position {position}: the bus {question['interface']} has {len(slaves)}",
                "kind": "invalid",
            }
        if question["do"] == "sdo_read":
            return {"hex": bus.sdo_read(position, index, subindex).hex()}
        bus.sdo_write(position, index, subindex, bytes.fromhex(question["hex"]))
        return {}
    finally:
        bus.close()


def _plain(value: object) -> object:
    """Turn what JSON does not know into what it does: bytes into hex, sets and enums into lists and names."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, set | frozenset):
        return sorted(value)
    return str(value)


def main() -> int:
    """Answer the question on standard input; errors of the bus are answers too."""
    # An interrupted command ends this process: the bus is closed on the way out.
    signal.signal(signal.SIGTERM, _leave)
    question = json.loads(sys.stdin.buffer.read())
    try:
        found = answer(question)
    except SdoAborted as error:
        found = {"error": str(error), "kind": "refused"}
    except BusError as error:
        found = {"error": str(error), "kind": "fault"}
    print(json.dumps(found, default=_plain), flush=True)
    return 0


def _leave(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    raise SystemExit(main())
