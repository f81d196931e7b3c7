"""A virtual segment whose slaves answer complete access of 0x1C12 with another object, as some firmware does."""

from __future__ import annotations

import runpy

from rtcp.virtual.coe import SdoServer

COMPLETE, UPLOAD, INDEX, OTHER = 0x10, 0x40, b"\x12\x1c", b"\x13\x1c"
answer_correctly = SdoServer.answer


def answer(self: SdoServer, request: bytes, state: int) -> bytes | None:
    reply = answer_correctly(self, request, state)
    wrong = request[0] & 0xF0 == UPLOAD | COMPLETE and request[1:3] == INDEX
    return reply[:1] + OTHER + reply[3:] if reply is not None and wrong else reply


SdoServer.answer = answer  # type: ignore[method-assign]
runpy.run_module("rtcp.virtual", run_name="__main__", alter_sys=True)
