"""A virtual segment that answers every frame, however long a busy host kept it from its CPU."""

from __future__ import annotations

import runpy

from rtcp.virtual import server

server.STALE = 60_000_000_000
runpy.run_module("rtcp.virtual", run_name="__main__", alter_sys=True)
