"""The Simple Message server that runs as long as the platform, by `ros` in the arm's file: a process of its own."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path

from rtcp.config.model import SimpleMessageConfig
from rtcp.ipc.session import NO_PROCESS, Pid, identify, is_running, terminate

_END_S = 5.0


class RosServer:
    """Starts it once in the life of a platform, also if the gateway is restarted, and ends it.

    Args:
        directory: the runtime directory.
    """

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._file = directory / "ros-server.json"

    async def start_once(self, options: SimpleMessageConfig, loop: int) -> None:
        """Start it, unless an earlier gateway has; it writes into the gateway's log, and ends with `loop`."""
        if is_running(self._pid()):
            return
        command = ["-m", "rtcp.cli", "ros", "--simple-message", "--bind", options.bind]
        command += ["--motion-port", str(options.motion_port), "--state-port", str(options.state_port)]
        command += [
            "--until",
            str(loop),
            "--byte-order",
            options.byte_order,
            *(["--joint-feedback"] if options.joint_feedback else []),
        ]
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            *command,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=sys.stderr,
            env={**os.environ, "RTCP_RUNTIME_DIR": str(self._directory)},
        )
        pid = identify(process.pid)
        self._file.write_text(json.dumps({"pid": int(pid), "identity": pid.identity}))

    async def finish(self) -> None:
        """End the server, if it runs."""
        await asyncio.to_thread(terminate, self._pid(), _END_S)
        self._file.unlink(missing_ok=True)

    def _pid(self) -> Pid:
        try:
            content = json.loads(self._file.read_text())
            return Pid(int(content["pid"]), int(content["identity"]))
        except (OSError, ValueError, LookupError, TypeError):
            return NO_PROCESS
