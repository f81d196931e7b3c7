"""One trial: the arm does something, something breaks, and what follows is measured until the arm works again."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rtcp.config.model import ArmConfig
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.stops import Rung, bounds, unheard
from rtcp.telemetry.trials.activities import ACTIVITIES, START, Activity
from rtcp.telemetry.trials.bench import Bench

GOES_ON = frozenset({"holding", "moving", "stopping"})
"""States in which the machine has met no fault."""
_AFTER_S = 0.3
"""So long after a fault what is said about it is still waited for."""
_MENDED_S = 0.4
"""So long after the mending nothing may move or get torque: nobody has asked for it."""
_MOVED_RAD = 0.003
LARGEST_STEP = 1.0 + 1e-6
"""A target may step as far as its speed limit allows in a cycle, and the last bit of a double further."""
_A_LITTLE = 0.02
"""rad: by so much every joint is moved to see that the arm works again."""


@dataclass(frozen=True)
class Outcome:
    """What a trial gave."""

    fault: str
    activity: str
    state: str
    """The machine's state after the fault, before anything was mended."""
    standstill_s: float | None
    """From the fault until every joint truly stood; None where the arm went on with what it did."""
    way: float
    """How far a joint truly went until it stood, as a part of what `furthest` allows; 0 where it went on."""
    largest_step: float
    """Of any target while enabled, until the arm held again, as a part of what the speed limits allow for a cycle."""
    wrong_cycles: int
    """Cycles without the expected working counter."""
    said: tuple[str, ...]
    """What the platform said from the fault to its mending."""
    still_broken: str
    """What a reset that came before the mending was answered; empty where none was tried or it succeeded."""
    by_itself: str
    """What moved or got torque after the mending and before a reset, which must not be; empty: nothing."""
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


def furthest(config: ArmConfig) -> list[float]:
    """Return how far each joint may go (rad) from any fault until it stands, by the bounds of the ladder of stops.

    At full speed for as long as lost cycles are held, then the longest of the stops; or by the drive's own watchdog.
    """
    hold, stop, quick = (bounds(config, rung) for rung in (Rung.HOLD, Rung.CONTROLLED_STOP, Rung.QUICK_STOP))
    watchdog = unheard(config)
    return [
        max(h.way_rad + max(c.way_rad, q.way_rad), w.way_rad)
        for h, c, q, w in zip(hold, stop, quick, watchdog, strict=True)
    ]


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
        TrialFailed: the arm could not be brought to the start, does not begin to move, or does not come to rest.
    """
    bench.stand_at(START)
    doing = ACTIVITIES[activity](bench.directory)
    try:
        doing.begin(bench)
        return _break(bench, faults, doing, watch_s, reset_first)
    finally:
        with contextlib.suppress(RtcpError):
            doing.end()


def _break(
    bench: Bench, faults: Sequence[Mapping[str, Any]], doing: Activity, watch_s: float, reset_first: bool
) -> Outcome:
    bench.follow()
    bench.largest_step, wrong = 0.0, bench.wrong
    mark = bench.mark()
    begun_ns, start = time.monotonic_ns(), _positions(bench)
    for fault in faults:
        bench.fault(fault)
    state = _watch(bench, watch_s)
    standstill_s, way = None, 0.0
    if state not in GOES_ON or (doing.moves and _rests(bench)):
        standstill_s = max(0.0, (bench.until_still() - begun_ns) * 1e-9)
        allowed = furthest(bench.config)
        way = max(abs(q - s) / most for q, s, most in zip(_positions(bench), start, allowed, strict=True))
        bench.until(lambda: False, _AFTER_S)
    still_broken = ""
    if reset_first and state not in GOES_ON:
        try:
            bench.call("reset")
        except RtcpError as error:
            still_broken = error.message
        state = bench.state()
    said = tuple(bench.said_since(mark))
    with contextlib.suppress(RtcpError):
        doing.end()
    by_itself = _clear(bench, watched=state not in GOES_ON)
    mended = time.monotonic()
    resets, refusal = bench.bring_up()
    recovery_s = time.monotonic() - mended
    bench.follow()
    largest_step = bench.largest_step
    if not refusal:
        refusal = bench.move([q + _A_LITTLE for q in START])
    return Outcome(
        shown(faults), doing.name, state, standstill_s, way, largest_step, bench.wrong - wrong, said, still_broken,
        by_itself, resets, refusal, recovery_s,
    )  # fmt: skip


def _positions(bench: Bench) -> list[float]:
    return [drive["position_rad"] for drive in bench.drives()]


def _clear(bench: Bench, *, watched: bool) -> str:
    """Mend everything; where the machine stands in a fault, return what moved or got torque by itself afterwards."""
    before, state = bench.drives(), bench.state()
    bench.segment.clear()
    if not watched:
        return ""
    bench.until(lambda: False, _MENDED_S)
    after = bench.drives()
    found = [
        f"{joint.name} moved by {abs(now['position_rad'] - then['position_rad']):.4f} rad"
        for joint, then, now in zip(bench.config.joints, before, after, strict=True)
        if abs(now["position_rad"] - then["position_rad"]) > _MOVED_RAD
    ]
    found += [
        f"{joint.name} got torque"
        for joint, then, now in zip(bench.config.joints, before, after, strict=True)
        if now["torque_on"] and not then["torque_on"]
    ]
    if bench.state() != state:
        found.append(f"the machine went from {state} to {bench.state()}")
    return "; ".join(found)


def _watch(bench: Bench, watch_s: float) -> str:
    """Wait until the machine no longer goes on, or for `watch_s`; return its state then."""
    bench.until(lambda: bench.state() not in GOES_ON, watch_s)
    return bench.state()


def _rests(bench: Bench) -> bool:
    """Whether the arm holds and goes on holding: between two moves it does for a moment only."""
    return not bench.until(lambda: bench.state() != "holding", _AFTER_S)
