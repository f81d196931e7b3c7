"""What holds for every test: properties are tried with the same values in every run, and none has a time limit.

A test that fails once in a hundred runs names a mistake to whoever happens to run it. To search on with values of
chance: `HYPOTHESIS_PROFILE=search make test`.
"""

from __future__ import annotations

import os
import signal

from hypothesis import HealthCheck, settings

_UNHURRIED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same", parent=_UNHURRIED, derandomize=True)
settings.register_profile("search", parent=_UNHURRIED)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Begun in the background by a shell, which has its children ignore Ctrl-C, and so all that the tests start.
    signal.signal(signal.SIGINT, signal.default_int_handler)
