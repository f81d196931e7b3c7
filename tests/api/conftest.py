"""A gateway process in front of a fake loop, as in the tests of the gateway, and the shared platform."""

from tests.e2e.conftest import enabled, kept, shared
from tests.gateway.conftest import client, directory, loop, served_loop

__all__ = ["client", "directory", "enabled", "kept", "loop", "served_loop", "shared"]
