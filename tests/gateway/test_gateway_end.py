"""The last moments of the gateway's process."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import asyncio, os, signal
from asyncio import selector_events
from pathlib import Path
from rtcp.gateway import server as gateway

class Served:
    def __init__(self, directory):
        pass

    async def serve(self, ready):
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, ready)

def close(loop, sound=selector_events.BaseSelectorEventLoop.close):
    sound(loop)
    os.kill(os.getpid(), signal.SIGTERM)

gateway.Gateway = Served
selector_events.BaseSelectorEventLoop.close = close
asyncio.run(gateway._run(Path("."), lambda: None))
"""


def test_a_signal_while_the_gateway_ends_is_no_traceback() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
