"""SDO services on request, in steps beside the cycle: a slow slave delays no other work."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from rtcp.config.scaling import OBJECTS_PER_AXIS
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import ABSENT
from rtcp.fieldbus.registers import Steps
from rtcp.fieldbus.supervision import SupervisedBus
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import DriveErrorCode
from rtcp.ipc.layout import SERVICE_LENGTH_AT, SERVICE_STATE_AT, SERVICE_TEXT_AT, SERVICE_TEXT_SIZE

_ASKED, _ANSWERED = 1, 2
_POLL_S = 0.0002
_BUDGET_S = 0.005
"""Time for one request in a poll, s; most slaves answer within it."""
_LONGEST_S = 4.0
"""Longest time for an answer, s."""
_ERROR_CODE = 0x603F


class SdoRequests:
    """Answers the request on the blackboard, and reads drives' error codes; one of each at a time.

    Args:
        bus: the configured bus.
        blackboard: provides requests, receives answers and events.
    """

    def __init__(self, bus: SupervisedBus, blackboard: Blackboard) -> None:
        self._bus = bus
        self._blackboard = blackboard
        self._answering: Steps[dict[str, Any]] | None = None
        self._asked_at = 0.0
        self._explaining: Steps[None] | None = None

    @property
    def explaining(self) -> bool:
        """Whether the error code of a drive is still being read."""
        return self._explaining is not None

    def explain(self, axis: int, position: int, slave_axis: int) -> None:
        """Start to read the error code of an axis from its drive; the result is an event."""
        self._explaining = self._explanation(axis, position, slave_axis)

    def take_steps(self) -> None:
        """Advance the pending requests and start new ones; raises BusError from an explanation that failed."""
        until = time.monotonic() + _BUDGET_S
        if self._answering is None and self._blackboard.words.acquire(SERVICE_STATE_AT) == _ASKED:
            self._answering, self._asked_at = self._answer(), time.monotonic()
        if self._answering is not None:
            if _follow(self._answering, until, self._reply):
                self._answering = None
            elif until - self._asked_at > _LONGEST_S:
                self._answering.close()
                self._answering = None
                self._reply(_error("timeout", f"the slave takes longer than {_LONGEST_S:g} s for its answer"))
        if self._explaining is not None:
            try:
                ended = _follow(self._explaining, until, lambda nothing: None)
            except BusError:
                self._explaining = None
                raise
            if ended:
                self._explaining = None

    def _explanation(self, axis: int, position: int, slave_axis: int) -> Steps[None]:
        index = _ERROR_CODE + (slave_axis - 1) * OBJECTS_PER_AXIS
        try:
            code = yield from self._bus.sdo(position).reading_int(index, 0)
        except SdoAborted as error:
            if error.code not in ABSENT:
                raise
            code = 0  # the drive has no error code
        if code:
            self._blackboard.event(DriveErrorCode(axis, position, slave_axis, code & 0xFFFF))

    def _answer(self) -> Steps[dict[str, Any]]:
        memory, words = self._blackboard.memory, self._blackboard.words
        length = words[SERVICE_LENGTH_AT]
        try:
            request = json.loads(bytes(memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + length]))
            return (yield from self._serve(request))
        except SdoAborted as error:
            where = {key: request[key] for key in ("slave", "index", "subindex")}
            return _error("refused", str(error)) | {"reason": "sdo_aborted", "fields": {**where, "code": error.code}}
        except BusError as error:
            return _error("timeout", "; ".join(error.sentences))
        except Exception as error:
            # A malformed request must not end the thread that watches the slaves.
            return _error("invalid", f"the request is not of the service's form: {type(error).__name__} {error}")

    def _reply(self, answer: dict[str, Any]) -> None:
        memory, words = self._blackboard.memory, self._blackboard.words
        text = json.dumps(answer).encode()
        if len(text) > SERVICE_TEXT_SIZE:
            sentence = f"the answer is {len(text)} bytes long, {SERVICE_TEXT_SIZE} fit"
            text = json.dumps(_error("refused", sentence)).encode()
        memory[SERVICE_TEXT_AT : SERVICE_TEXT_AT + len(text)] = text
        words[SERVICE_LENGTH_AT] = len(text)
        words.release(SERVICE_STATE_AT, _ANSWERED)

    def _serve(self, request: dict[str, Any]) -> Steps[dict[str, Any]]:
        position, index, subindex = int(request["slave"]), int(request["index"]), int(request["subindex"])
        if not (0 <= index <= 0xFFFF and 0 <= subindex <= 0xFF):
            return _error("invalid", f"object {index}:{subindex} does not exist: index 0 to 65535, subindex 0 to 255")
        try:
            objects = self._bus.sdo(position)
        except BusError as error:
            return _error("invalid", str(error))
        if request["do"] == "sdo_read":
            data = yield from objects.reading(index, subindex)
            return {"hex": data.hex()}
        if request["do"] == "sdo_write":
            data = bytes.fromhex(request["hex"])
            yield from objects.writing(index, subindex, data)
            self._bus.note_written(position, index, subindex, data)
            return {}
        raise ValueError(f"{request['do']!r} is neither sdo_read nor sdo_write")


def _error(kind: str, sentence: str) -> dict[str, Any]:
    """Return an error reply; `kind`: one of the control socket's kinds."""
    return {"error": sentence, "kind": kind}


def _follow(steps: Steps[Any], until: float, done: Callable[[Any], None]) -> bool:
    """Run steps until `until`, with sleeps between them; once they end call `done` with their result, return True."""
    try:
        next(steps)
        while time.monotonic() < until:
            time.sleep(_POLL_S)
            next(steps)
    except StopIteration as end:
        done(end.value)
        return True
    return False
