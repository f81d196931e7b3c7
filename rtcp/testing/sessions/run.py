"""Runs the random session of a seed, of an arm or of a cell."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from random import Random
from typing import Protocol

from rtcp.config.cell import CellConfig
from rtcp.config.model import ArmConfig
from rtcp.config.segment import SegmentConfig
from rtcp.testing.sessions.cell_session import CellSession
from rtcp.testing.sessions.commander import Commander
from rtcp.testing.sessions.session import Result, Session, error_json


class AnySession(Protocol):
    """A session of an arm, or of a cell."""

    @property
    def commander(self) -> Commander:
        """The commander of the arm, or of one of the arms."""

    def run(self, seconds: float) -> None:
        """Run for this simulated time, s, or to the first violation."""

    def result(self, seed: int, error: Exception | None = None) -> Result:
        """Return the result of the session as it is now."""

    def close(self) -> None:
        """Free the memory."""


Segment = SegmentConfig | Mapping[str, SegmentConfig]
"""The slaves of an arm, or of each arm of a cell by its name."""
Inspect = Callable[[AnySession, Exception | None], None]


def run_session(
    seed: int,
    config: ArmConfig | CellConfig,
    seconds: float,
    segment: Segment | None = None,
    inspect: Inspect | None = None,
) -> Result:
    """Run the session of a seed; an error of the session is its result.

    Args:
        seed: of everything in it.
        config: the arm, or the cell.
        seconds: simulated time, s.
        segment: the slaves, in a cell those of each arm by its name; None: the configured segment.
        inspect: called with the session before it is closed, and with its error.
    """
    began = time.thread_time(), time.perf_counter()
    session: AnySession | None = None
    failure: Exception | None = None
    try:
        session = session_of(seed, config, segment)
        session.run(seconds)
    except Exception as error:
        failure = error
    try:
        if session is None:
            return Result(seed, "error", violation=error_json(failure))
        if inspect is not None:
            inspect(session, failure)
        cpu_s, wall_s = time.thread_time() - began[0], time.perf_counter() - began[1]
        return replace(session.result(seed, failure), cpu_s=cpu_s, wall_s=wall_s)
    finally:
        if session is not None:
            session.close()


def session_of(seed: int, config: ArmConfig | CellConfig, segment: Segment | None = None) -> AnySession:
    """Return the session of a seed: that of an arm, or of a cell."""
    if isinstance(config, ArmConfig):
        assert not isinstance(segment, Mapping)
        return Session(Random(seed), config, segment=segment, number=seed)
    assert not isinstance(segment, SegmentConfig)
    return CellSession(Random(seed), config, segment)
