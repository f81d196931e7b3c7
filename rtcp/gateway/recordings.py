"""Recordings, on behalf of clients: each is a process of its own, which a gateway that was started anew finds again."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rtcp.config.zero import state_directory
from rtcp.gateway.command_channel import Json
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.session import Pid, is_running, terminate, wait_for_exit

_READY_S, _END_S = 12.0, 10.0


def recordings_directory() -> Path:
    """Return where recordings go that name no place."""
    return state_directory() / "recordings"


class Recordings:
    """The recorders of one platform.

    Args:
        directory: the runtime directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    async def start(
        self, out: str | None, formats: Sequence[str], signals: Sequence[str], every: int, seconds: float | None
    ) -> Json:
        """Start a recorder; return what it is doing. Raises RtcpError: where and why it cannot."""
        path = recordings_directory() if out is None else Path(out)
        if not path.is_absolute():
            raise RtcpError("invalid", f'out: found "{out}", allowed is an absolute path')
        options = {"out": str(path), "formats": list(dict.fromkeys(formats)), "signals": list(signals),
                   "every": every, "seconds": seconds}  # fmt: skip
        command = ("-m", "rtcp.telemetry.recorder", "--directory", str(self._directory),
                   "--options", json.dumps(options))  # fmt: skip
        process = await asyncio.create_subprocess_exec(
            sys.executable, *command, stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE
        )
        assert process.stdout is not None
        try:
            line = await asyncio.wait_for(process.stdout.readline(), _READY_S)
        except BaseException as error:
            # Also where the client has gone: nobody would know of this recording.
            process.kill()
            await process.wait()
            if isinstance(error, asyncio.TimeoutError):
                raise RtcpError("timeout", f"the recorder was not ready within {_READY_S:g} s") from None
            raise
        if not line:
            raise RtcpError("internal", "the recorder ended at once: its reason is in the gateway's log")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise RtcpError(answer["kind"], str(answer["error"]))
        return _shown(answer["recording"], True)

    def status(self) -> list[Json]:
        """Return what the recorders of this platform do or have done, the oldest first."""
        return [_shown(found, is_running(pid)) for pid, found in self._recorders()]

    async def stop(self) -> list[Json]:
        """End all recorders that run and return what they have done."""
        running = [pid for pid, _ in self._recorders() if is_running(pid)]
        await asyncio.gather(*(asyncio.to_thread(terminate, pid, _END_S) for pid in running))
        return [_shown(found, False) for pid, found in self._recorders() if pid in running]

    async def finish(self) -> None:
        """Wait until all recorders have completed their files, now that the loop has ended; remove what they told."""
        running = [pid for pid, _ in self._recorders() if is_running(pid)]
        await asyncio.gather(*(asyncio.to_thread(wait_for_exit, pid, _END_S) for pid in running))
        for path in self._directory.glob("recorder-*.json"):
            path.unlink(missing_ok=True)

    def _recorders(self) -> list[tuple[Pid, dict[str, Any]]]:
        found = []
        for path in self._directory.glob("recorder-*.json"):
            try:
                one = json.loads(path.read_text())
                found.append((Pid(int(one["pid"]), int(one["identity"])), one))
            except (OSError, ValueError, LookupError, TypeError):
                continue
        return sorted(found, key=lambda one: str(one[1]["files"]))


def _shown(found: dict[str, Any], running: bool) -> Json:
    """Return a recorder's fields for clients; one that was killed has a problem."""
    shown = {name: value for name, value in found.items() if name not in ("identity", "ended")}
    if not running and not found["ended"]:
        shown["problem"] = "the recorder was ended from outside: its file is whole up to its last second"
    return {**shown, "running": running and not found["ended"]}
