"""Commands of processes beside motion, which last."""

from __future__ import annotations

import math

from rtcp.config.model import ArmConfig, ProcessConfig
from rtcp.gateway.command_channel import BROKEN, Caller, CommandChannel, Json
from rtcp.ipc.commands import ProcessCommand
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import ProcessEnded
from rtcp.ipc.schema import identifier


class ProcessActions:
    """Carries out commands of processes.

    Args:
        channel: to the loop.
        config: the platform.
    """

    def __init__(self, channel: CommandChannel, config: ArmConfig) -> None:
        self._channel = channel
        self._config = config

    async def run(self, caller: Caller, command: ProcessCommand) -> Json:
        """Carry out a command; return when the process has finished.

        Raises:
            RtcpError: it was refused, or ended early by the event in `reason` and `fields`.
        """
        channel = self._channel
        busy = f"{identifier(self._process_of(command).name)}_busy"
        since = max((record.number for record in channel.events(0)), default=0)

        def poll() -> bool | None:
            channel.check_loop()
            if channel.state in BROKEN:
                raise channel.fault_since(since)
            return None if int(channel.record()[busy]) else True

        def timed_out() -> RtcpError:
            raise AssertionError("it has no time limit")

        async with channel.lease(caller) as lease:
            head = await channel.accept(lease, command)
            await channel.wait(lambda: poll() if channel.observer.head > head else None, math.inf, timed_out)
        if channel.early_end(since) is not None:
            raise channel.fault_since(since)
        ends = [record.event for record in channel.events(since) if isinstance(record.event, ProcessEnded)]
        if ends:
            raise channel.ended(ends[-1], command.name)
        return {}

    def _process_of(self, command: ProcessCommand) -> ProcessConfig:
        for process in self._config.processes:
            if type(command) in process.COMMANDS:
                return process
        raise RtcpError("refused", f"{command.name}: this platform has no process that carries it out", "no_process")
