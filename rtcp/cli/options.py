"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="The arm's file; else $RTCP_CONFIG, /etc/rtcp, the one that travels with the package.",
    ),
]

BusName = Annotated[
    str | None,
    typer.Option(
        "--bus",
        metavar="virtual|NAME",
        help="virtual, or a network interface as eth0; else the running platform's or the configuration's.",
    ),
]

SlaveName = Annotated[
    str, typer.Argument(metavar="SLAVE", help="Position on the cable, from 1, or the configured name.")
]

ObjectIndex = Annotated[
    str,
    typer.Argument(metavar="INDEX[:SUB]", help="Index in hex, as 0x6041 or 6041h; 0x1018:1 for a subindex."),
]

Poll = Annotated[
    bool, typer.Option("--poll", help="The virtual segment polls on a CPU of its own: faster answers, one CPU busy.")
]
"""Where a segment of software slaves is run."""
