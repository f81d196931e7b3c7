"""What kind of error an SDO service ends with: a refusal, a silence, a question that is none."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rtcp.gateway.carrier import Carrier, CommandFailed
from rtcp.gateway.commander import Commander
from rtcp.gateway.picture import Picture

from rtcp.config import default_config, load
from rtcp.control.sdo_requests import SdoRequests
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.registers import Steps
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.observer import Observer
from rtcp.ipc.session import Session


class Bus:
    """A bus with one slave, whose only object answers as a test has it."""

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


@pytest.fixture
def observer(board: Blackboard, path: Path) -> Iterator[Observer]:
    made = Observer(path)
    yield made
    made.close()


CASES: dict[str, tuple[BusError | None, dict[str, int], str]] = {
    "an abort": (SdoAborted("abort code 0x06020000", 0x06020000), {}, "refused"),
    "a silence": (BusError("no answer in time"), {}, "timeout"),
    "no such slave": (None, {"slave": 9}, "invalid"),
    "no such object": (None, {"index": 0x10000}, "invalid"),
}


@pytest.mark.parametrize(("outcome", "other", "kind"), CASES.values(), ids=CASES.keys())
def test_the_kind_of_an_error_reaches_whoever_asked(
    board: Blackboard, observer: Observer, outcome: BusError | None, other: dict[str, int], kind: str
) -> None:
    bus = Bus()
    bus.outcome = outcome
    requests = SdoRequests(bus, board)  # type: ignore[arg-type]
    config = load(default_config())
    picture = Picture(observer, Session(config, "virtual", "ecat0", 0, 0), {})
    commander = Commander(Carrier(observer, picture, config))

    async def ask() -> dict[str, Any]:
        asked = asyncio.ensure_future(
            commander.service({"do": "sdo_read", "slave": 1, "index": 1, "subindex": 0} | other)
        )
        while not asked.done():
            requests.take_steps()
            await asyncio.sleep(0.001)
        return await asked

    with pytest.raises(CommandFailed) as failed:
        asyncio.run(ask())
    assert failed.value.kind == kind
