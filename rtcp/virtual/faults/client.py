"""Asks a running segment for faults, over its control socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

PATIENCE_S = 10.0
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
        self._socket.settimeout(PATIENCE_S)
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

    def _ask(self, request: dict[str, Any]) -> Any:
        try:
            self._socket.send(json.dumps(request).encode())
            packet = self._socket.recv(LONGEST_ANSWER)
        except TimeoutError as error:
            raise SegmentAway(f"the segment at {self._path} does not answer within {PATIENCE_S:g} s") from error
        except OSError as error:
            raise SegmentAway(f"the segment at {self._path} has gone ({error.strerror or error})") from error
        if not packet:
            raise SegmentAway(f"the segment at {self._path} has gone")
        answer = json.loads(packet)
        if not answer["ok"]:
            raise SegmentRefused(answer["error"])
        return answer["result"]
