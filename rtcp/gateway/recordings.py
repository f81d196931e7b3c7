"""Recordings, on behalf of clients: each is a process of its own, which a gateway that was started anew finds again."""

from __future__ import annotations

import asyncio
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from rtcp.config.model import RecordingConfig
from rtcp.config.serialization import to_json
from rtcp.config.zero import state_directory
from rtcp.gateway.command_channel import Json
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.session import Pid, is_running, terminate, wait_for_exit

_READY_S, _END_S = 12.0, 12.0
"""Less than a client waits for its answer."""


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

    async def start_once(self, options: RecordingConfig) -> None:
        """Start the recorder that begins with the platform, unless an earlier gateway has. Raises as `start`."""
        try:
            # Removed with what the recorders tell, at the end of the platform.
            (self._directory / "recorder-begun.json").touch(mode=0o600, exist_ok=False)
        except FileExistsError:
            return
        except OSError as error:
            raise RtcpError("internal", f"{error.filename} cannot be written: {error.strerror}") from error
        await self.start(options)

    async def start(self, options: RecordingConfig) -> Json:
        """Start a recorder; return what it is doing.

        Raises:
            RtcpError: where and why it cannot: reason `relative_path` (`out`), or one of the recorder's.
        """
        path = recordings_directory() if options.out is None else Path(options.out)
        if not path.is_absolute():
            message = f'out: found "{options.out}", allowed is an absolute path'
            raise RtcpError("invalid", message, "relative_path", {"out": options.out})
        command = ("-m", "rtcp.telemetry.recorder", "--directory", str(self._directory),
                   "--options", json.dumps(to_json(replace(options, out=str(path)))))  # fmt: skip
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
            raise RtcpError(answer["kind"], str(answer["error"]), answer["reason"], answer["fields"])
        return _shown(answer["recording"], True)

    def status(self) -> list[Json]:
        """Return what the recorders of this platform do or have done, the oldest first."""
        return [_shown(found, is_running(pid)) for pid, found in self._recorders()]

    async def stop(self, only: int | None = None) -> list[Json]:
        """End the recorders that run, or the process `only`, and return what they have done."""
        running = [pid for pid, _ in self._recorders() if is_running(pid) and only in (None, pid)]
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
