"""A gateway's process in front of a fake loop, as the tests of the gateway have it."""

from tests.gateway.conftest import client, directory, loop, served_loop

__all__ = ["client", "directory", "loop", "served_loop"]
