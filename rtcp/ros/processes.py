"""Processes beside motion on ROS, without ROS types: a service for each command of a process.

A command without fields is a std_srvs/Trigger. ROS has no standard service that takes named values; the request of
diagnostic_msgs/AddDiagnostics is one text, which holds them as on the command line, and its response is that of a
Trigger.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from rtcp.config.model import ArmConfig


@dataclass(frozen=True)
class ProcessService:
    """The service of one command of a process."""

    process: str
    """Name of the process."""
    command: str
    """Name of the command."""
    has_fields: bool
    """Whether the command has fields, so that its request has a text."""
    needs_lease: bool = True
    """Whether the command can start something."""
    member: str = ""
    """Name of the platform in its cell; empty: the node serves one platform."""

    @property
    def name(self) -> str:
        """Name of the service: `heater/arm_heater`."""
        return f"{ros_name(self.process, self.member)}/{self.command}"


def ros_name(process: str, member: str) -> str:
    """Return the name of a process on ROS: in a cell after that of its platform, unless both are the same."""
    return process if member in ("", process) else re.sub(r"\W", "_", f"{member}_{process}", flags=re.ASCII)


def services_of(config: ArmConfig) -> Sequence[ProcessService]:
    """Return a service for each command of each process of a platform."""
    return [
        ProcessService(process.name, command.name, bool(command.field_types), command.needs_lease)
        for process in config.processes
        for command in process.COMMANDS
    ]
