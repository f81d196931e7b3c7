"""`python -m rtcp.virtual.irc5`: run a virtual IRC5 until SIGTERM or SIGINT."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from rtcp.config.model import ConfigError
from rtcp.virtual.irc5.server import run

USAGE_ERROR = 2


def main() -> int:
    """Parse the command line and run; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rtcp.virtual.irc5", description="Run a virtual ABB IRC5.")
    parser.add_argument("--config", type=Path, required=True, help="file that lists the mechanical units")
    parser.add_argument("--control", type=Path, help="listen here, at a Unix socket, for the operator and for faults")
    arguments = parser.parse_args()

    def ready(message: dict[str, Any]) -> None:
        print(json.dumps(message), flush=True)

    try:
        run(arguments.config, ready, arguments.control)
    except (ConfigError, ValueError) as error:
        print(error, file=sys.stderr)
        return USAGE_ERROR
    return 0


if __name__ == "__main__":
    sys.exit(main())
