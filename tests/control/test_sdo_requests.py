"""Error kinds of a client's SDO request: an abort, a timeout, a wrong address."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rtcp.control.sdo_requests import SdoRequests
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.registers import Steps
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer


class Bus:
    """A bus with one slave, each of whose objects is 0x2A or an error."""

    outcome: BusError | None = None

    def sdo(self, position: int) -> Bus:
        if position != 1:
            raise BusError("there is no slave there")
        return self

    def reading(self, index: int, subindex: int) -> Steps[bytes]:
        yield
        if self.outcome is not None:
            raise self.outcome
        return b"\x2a"


CASES: dict[str, tuple[BusError | None, dict[str, int], str]] = {
    "an abort": (SdoAborted("abort code 0x06020000", 0x06020000), {}, "refused"),
    "a silence": (BusError("no answer in time"), {}, "timeout"),
    "no such slave": (None, {"slave": 9}, "invalid"),
    "no such object": (None, {"index": 0x10000}, "invalid"),
}


@pytest.mark.parametrize(("outcome", "other", "kind"), CASES.values(), ids=CASES.keys())
def test_the_kind_of_an_error_reaches_the_client(
    board: Blackboard, path: Path, outcome: BusError | None, other: dict[str, int], kind: str
) -> None:
    observer = Observer(path)
    bus = Bus()
    bus.outcome = outcome
    requests = SdoRequests(bus, board)  # type: ignore[arg-type]
    observer.ask_service({"do": "sdo_read", "slave": 1, "index": 1, "subindex": 0} | other)
    answer: dict[str, Any] | None = None
    while answer is None:
        requests.take_steps()
        answer = observer.service_answer()
    observer.close()
    assert answer["kind"] == kind
