"""What holds for every test: properties are tried with the same values in every run, and none has a time limit.

A test that fails once in a hundred runs names a mistake to whoever happens to run it. To search on with values of
chance: `HYPOTHESIS_PROFILE=search make test`.
"""

from __future__ import annotations

import os

from hypothesis import HealthCheck, settings

_UNHURRIED = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same", parent=_UNHURRIED, derandomize=True)
settings.register_profile("search", parent=_UNHURRIED)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))
