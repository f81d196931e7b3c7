"""A gateway process in front of a fake loop, as in the tests of the gateway."""

from tests.gateway.conftest import client, directory, loop, served_loop

__all__ = ["client", "directory", "loop", "served_loop"]
