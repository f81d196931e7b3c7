"""How commands reach the running platform."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from rtcp.runtime.client import ControlClient


def connect(command: str) -> ControlClient:
    """Connect under the command's name, which others are told when they are refused.

    Raises:
        ControlError: as `ControlClient` does, `not running` above all.
    """
    return ControlClient(f"rtcp {command} (pid {os.getpid()})")


def ask(command: str, verb: str, arguments: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Send one request on a connection of its own and return the result.

    Raises:
        ControlError: what the platform answered, or that there is none.
    """
    with connect(command) as client:
        return client.call(verb, arguments)
