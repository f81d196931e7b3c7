"""Recordings, on behalf of clients: each is a process of its own, which a restarted gateway finds again."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Gt, Le

from rtcp.config.model import RecordingConfig, RecordingFormat
from rtcp.config.serialization import to_json
from rtcp.config.zero import state_directory
from rtcp.gateway.command_channel import Caller, Json
from rtcp.gateway.method import method
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.session import Pid, is_running, terminate, wait_for_exit

_READY_S = 120.0
"""Timeout of a recorder's start, s: a busy host may take a minute to load one."""
_REPORT_S = 5.0
"""Interval of the progress reports while a recorder starts, s: a client waits longer for its answer."""
_END_S = 12.0
"""Timeout of a recorder's end, s: less than a client waits for its answer."""


def recordings_directory() -> Path:
    """Return the default directory of recordings."""
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
            # Removed with the recorders' own files at the end of the platform.
            (self._directory / "recorder-begun.json").touch(mode=0o600, exist_ok=False)
        except FileExistsError:
            return
        except OSError as error:
            raise RtcpError("internal", f"{error.filename} cannot be written: {error.strerror}") from error
        await self.start(options)

    async def start(self, options: RecordingConfig, report: Callable[[Json], None] = lambda progress: None) -> Json:
        """Start a recorder; return its fields. Until it is ready, `report` is called every 5 s.

        Raises:
            RtcpError: it cannot start: reason `relative_path` (`out`), or one of the recorder's.
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
            ready = asyncio.ensure_future(process.stdout.readline())
            for _ in range(round(_READY_S / _REPORT_S)):
                await asyncio.wait({ready}, timeout=_REPORT_S)
                if ready.done():
                    break
                report({})
            line = await asyncio.wait_for(ready, 0.0)
        except BaseException as error:
            # Also if the client has gone: nobody would know of this recording.
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
        return _as_json(answer["recording"], True)

    @method(at_once=True)
    async def record_start(
        self,
        caller: Caller,
        out: str | None = None,
        formats: tuple[RecordingFormat, ...] = (),
        signals: tuple[str, ...] = (),
        every: Annotated[int, Ge(1), Le(1_000_000)] = 1,
        seconds: Annotated[float, Gt(0)] | None = None,
        max_file_mb: Annotated[int, Ge(1)] | None = None,
        max_file_seconds: Annotated[float, Ge(1)] | None = None,
        keep: Annotated[int, Ge(1)] | None = None,
        reserve_mb: Annotated[int, Ge(0)] = RecordingConfig.reserve_mb,
    ) -> Json:
        """Start a recording: the keys of `recording` in the arm's file. Returns what `record_status` lists."""
        rotation = (max_file_mb, max_file_seconds, keep)
        options = RecordingConfig(out, formats, signals, every, seconds, *rotation, reserve_mb)
        return await self.start(options, caller.report)

    @method(at_once=True)
    async def record_stop(self, caller: Caller, pid: int | None = None) -> Json:
        """End all recordings, or that of the process `pid`. Returns `recordings`: those that were ended."""
        ended = [process for process, _ in self._recorders() if is_running(process) and pid in (None, process)]
        await asyncio.gather(*(asyncio.to_thread(terminate, process, _END_S) for process in ended))
        return {"recordings": [_as_json(entry, False) for process, entry in self._recorders() if process in ended]}

    @method(at_once=True)
    async def record_status(self, caller: Caller) -> Json:
        """Return `recordings`: files, rotations, records, missing, bytes, seconds, whether it runs, its problem."""
        return {"recordings": [_as_json(entry, is_running(pid)) for pid, entry in self._recorders()]}

    async def finish(self) -> None:
        """Wait until all recorders have completed their files, now that the loop has ended; remove their own files."""
        running = [pid for pid, _ in self._recorders() if is_running(pid)]
        await asyncio.gather(*(asyncio.to_thread(wait_for_exit, pid, _END_S) for pid in running))
        for path in self._directory.glob("recorder-*.json"):
            path.unlink(missing_ok=True)

    def _recorders(self) -> list[tuple[Pid, dict[str, Any]]]:
        recorders = []
        for path in self._directory.glob("recorder-*.json"):
            try:
                entry = json.loads(path.read_text())
                recorders.append((Pid(int(entry["pid"]), int(entry["identity"])), entry))
            except (OSError, ValueError, LookupError, TypeError):
                continue
        return sorted(recorders, key=lambda recorder: str(recorder[1]["files"]))


def _as_json(recorder: dict[str, Any], running: bool) -> Json:
    """Return a recorder's fields for clients; one that was killed has a problem."""
    fields = {name: value for name, value in recorder.items() if name not in ("identity", "ended")}
    if not running and not recorder["ended"]:
        fields["problem"] = "the recorder was ended from outside: its file is whole up to its last second"
    return {**fields, "running": running and not recorder["ended"]}
