"""One trial: the arm does something, something breaks, and what follows is measured until the arm works again."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.runtime.client import ControlError
from rtcp.telemetry.trials.activities import ACTIVITIES, START, Activity
from rtcp.telemetry.trials.bench import Bench

GOES_ON = frozenset({"holding", "moving", "stopping"})
"""States in which the machine has met no fault."""
_AFTER_S = 0.3
"""So long after a fault what is said about it is still waited for."""


@dataclass(frozen=True)
class Outcome:
    """What a trial gave."""

    fault: str
    activity: str
    state: str
    """The machine's state after the fault, before anything was mended."""
    standstill_s: float | None
    """From the fault until every joint truly stood; None where the arm went on with what it did."""
    largest_step: float
    """Of any target while enabled, until the arm held again, as a part of what the speed limits allow for a cycle."""
    wrong_cycles: int
    """Cycles without the expected working counter."""
    said: tuple[str, ...]
    """What the platform said from the fault to its mending."""
    still_broken: str
    """What a reset that came before the mending was answered; empty where none was tried or it succeeded."""
    resets: int
    """Resets that it took after the mending."""
    refusal: str
    """Why the arm could not be enabled again; empty: it was, and it moved."""
    recovery_s: float
    """From the mending until the arm held again."""

    @property
    def recovered(self) -> bool:
        """Whether the arm works again."""
        return not self.refusal

    @property
    def sentence(self) -> str:
        """The first thing said."""
        return self.said[0] if self.said else ""


def shown(faults: Sequence[Mapping[str, Any]]) -> str:
    """Return faults as a command names them."""
    words = []
    for fault in faults:
        own = " ".join(f"{key}={value}" for key, value in fault.items() if key != "fault")
        words.append(f"{fault['fault']} {own}".strip())
    return " + ".join(words)


def carry_out(
    bench: Bench, faults: Sequence[Mapping[str, Any]], activity: str, watch_s: float, *, reset_first: bool = False
) -> Outcome:
    """Carry out a trial on a bench whose arm holds or can be enabled.

    Args:
        bench: the platform.
        faults: made one after the other, each a mapping as `rtcp.config.faults` has it.
        activity: one of `ACTIVITIES`.
        watch_s: how long a machine that goes on is watched.
        reset_first: ask for a reset while the fault still lasts: it must not lead to an enabled arm.

    Raises:
        TrialFailed: the arm could not be brought to the start, or does not come to rest.
    """
    bench.stand_at(START)
    doing = ACTIVITIES[activity](bench.directory)
    doing.begin(bench)
    bench.follow()
    bench.largest_step, wrong = 0.0, bench.wrong
    mark = bench.mark()
    begun_ns = time.monotonic_ns()
    for fault in faults:
        bench.segment.fault(fault)
    state = _watch(bench, doing, watch_s)
    standstill_s = None
    if state not in GOES_ON or (doing.moves and _rests(bench)):
        standstill_s = max(0.0, (bench.until_still() - begun_ns) * 1e-9)
        bench.until(lambda: False, _AFTER_S)
    still_broken = ""
    if reset_first and state not in GOES_ON:
        try:
            bench.call("reset")
        except ControlError as error:
            still_broken = error.message
        state = bench.state()
    said = tuple(bench.said_since(mark))
    with contextlib.suppress(ControlError):
        doing.end()
    bench.segment.mend()
    mended = time.monotonic()
    resets, refusal = bench.bring_up()
    recovery_s = time.monotonic() - mended
    bench.follow()
    largest_step = bench.largest_step
    if not refusal:
        refusal = _move_a_little(bench)
    return Outcome(
        shown(faults), activity, state, standstill_s, largest_step, bench.wrong - wrong, said, still_broken,
        resets, refusal, recovery_s,
    )  # fmt: skip


def _watch(bench: Bench, doing: Activity, watch_s: float) -> str:
    """Wait until the machine no longer goes on, or for `watch_s`; return its state then."""
    bench.until(lambda: bench.state() not in GOES_ON, watch_s)
    return bench.state()


def _rests(bench: Bench) -> bool:
    """Whether the arm holds and goes on holding: between two moves it does for a moment only."""
    return not bench.until(lambda: bench.state() != "holding", _AFTER_S)


def _move_a_little(bench: Bench) -> str:
    try:
        bench.call("motion", name="joint")
        bench.call("move", q=[q + 0.02 for q in START], speed=0.4)
    except ControlError as error:
        return error.message
    return ""
