"""`python -m rtcp.virtual.irc5`: run a virtual IRC5 until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from rtcp.config.model import ConfigError
from rtcp.virtual.irc5.controller import Controller
from rtcp.virtual.irc5.server import run
from rtcp.virtual.network import NetworkError

USAGE_ERROR = 2


def main() -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rtcp.virtual.irc5", description="Run a virtual ABB IRC5.")
    parser.add_argument("--config", type=Path, required=True, help="file that lists the mechanical units")
    parser.add_argument("--control", type=Path, help="listen here, at a Unix socket, for the operator and for faults")
    parser.add_argument(
        "--private", action="store_true", help="speak on the loopback of a network namespace of its own"
    )
    parser.add_argument("--ready-fd", type=int, default=1, help="where to write one line of JSON when ready")
    arguments = parser.parse_args()

    def ready(controller: Controller, interface: str | None) -> None:
        line = {"pid": os.getpid(), "interface": interface, "units": list(controller.units)}
        if controller.streaming is not None:
            line |= controller.streaming.ports
        os.write(arguments.ready_fd, json.dumps(line).encode() + b"\n")

    try:
        run(arguments.config, ready, arguments.control, arguments.private)
    except (ConfigError, NetworkError, ValueError) as error:
        print(error, file=sys.stderr)
        return USAGE_ERROR
    return 0


if __name__ == "__main__":
    sys.exit(main())
