"""The shared platform."""

from tests.e2e.conftest import kept, running, shared

__all__ = ["kept", "running", "shared"]
