"""Random sessions of a simulated arm, each from a seed, checked by what goes over its bus."""

from rtcp.testing.sessions.run import run_session
from rtcp.testing.sessions.session import Result

__all__ = ["Result", "run_session"]
