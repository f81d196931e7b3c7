"""`python -m rtcp.virtual`: run a virtual segment until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from rtcp.config.model import ConfigError
from rtcp.virtual.network import NetworkError
from rtcp.virtual.server import run

USAGE_ERROR = 2


def main() -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rtcp.virtual", description="Run a virtual EtherCAT segment.")
    parser.add_argument("--config", type=Path, required=True, help="file that lists the slaves")
    parser.add_argument("--interface", help="leave the master's end of the cable in this network under this name")
    parser.add_argument("--poll", action="store_true", help="poll for frames: faster, for a CPU of its own")
    parser.add_argument("--cpu", type=int, help="run on this CPU")
    parser.add_argument("--control", type=Path, help="listen here, at a Unix socket, for faults that are asked for")
    parser.add_argument("--faults", type=Path, help="script of faults with their times")
    parser.add_argument("--ready-fd", type=int, default=1, help="where to write one line of JSON when ready")
    arguments = parser.parse_args()

    def ready(message: dict[str, int | str | bool]) -> None:
        os.write(arguments.ready_fd, json.dumps(message).encode() + b"\n")

    try:
        run(arguments.config, arguments.interface, arguments.poll, arguments.cpu, ready, arguments.control,
            arguments.faults)  # fmt: skip
    except (ConfigError, NetworkError, ValueError) as error:
        print(error, file=sys.stderr)
        return USAGE_ERROR
    return 0


if __name__ == "__main__":
    sys.exit(main())
