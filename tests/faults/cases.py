"""The fault matrix: every fault that the virtual segment can inject, and the required reaction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Fault = Mapping[str, Any]
HOLDING, MOVING, JOGGING, JOYSTICK = "holding", "moving", "jogging", "joystick"
THREE = (HOLDING, MOVING, JOGGING)
CONTINUES = "continues"
FAULT = "fault"
EMERGENCY = "emergency_stop"
STOPS = "holding"
"""The motion ends in a controlled stop, without a fault."""


@dataclass(frozen=True)
class Case:
    """Faults injected at once, and the required reaction."""

    name: str
    faults: Sequence[Fault]
    ends_in: tuple[str, ...]
    """Allowed reactions: FAULT, EMERGENCY, CONTINUES, STOPS."""
    words: tuple[str, ...] = ()
    """Each must be in a message before the fault is cleared."""
    workloads: tuple[str, ...] = THREE
    watch_s: float = 3.0
    """How long a machine that continues is observed."""
    reset_is_refused: bool = False
    """A reset while the fault is active must be refused."""


def _fault(name: str, **own: Any) -> Fault:
    return {"fault": name, **own}


BOX, DRIVE_1, DRIVE_3, DRIVE_6 = 1, 2, 4, 7
LOST = "process data lost"
CASES: tuple[Case, ...] = (
    Case("cable: master to slave 1", [_fault("cable", after=0)], (FAULT,), (LOST,), reset_is_refused=True),
    Case("cable: slave 1 to 2", [_fault("cable", after=1)], (FAULT,), reset_is_refused=True),
    Case("cable: slave 3 to 4", [_fault("cable", after=3)], (FAULT,), reset_is_refused=True),
    Case("cable: slave 6 to 7", [_fault("cable", after=6)], (FAULT,), reset_is_refused=True),
    # Shorter than the holding of lost cycles, longer than the slave watcher needs: either may come first.
    Case("cable for 50 ms", [_fault("cable", after=3, lasts=0.05)], (CONTINUES, FAULT), watch_s=1.5),
    Case("power: IO box (reference clock)", [_fault("power", slave=BOX)], (FAULT,), reset_is_refused=True),
    Case("power: drive 3", [_fault("power", slave=DRIVE_3)], (FAULT,), reset_is_refused=True),
    Case(
        "power: drive 3, and the emergency stop is pressed",
        [_fault("power", slave=DRIVE_3), _fault("input", number=10, how="low")],
        (EMERGENCY,),
        ("emergency stop",),
        reset_is_refused=True,
    ),
    Case("power: drive 6, the last", [_fault("power", slave=DRIVE_6)], (FAULT,), reset_is_refused=True),
    Case("power for 50 ms: drive 1", [_fault("power", slave=DRIVE_1, lasts=0.05)], (FAULT,)),
    Case("falls to SAFE-OP", [_fault("al_fall", slave=DRIVE_3)], (FAULT,)),
    Case("falls to PRE-OP", [_fault("al_fall", slave=DRIVE_3, state="PRE-OP", code=0x0051)], (FAULT,)),
    Case(
        "falls and refuses OP",
        [_fault("al_refuse", slave=DRIVE_3, code=0x0030), _fault("al_fall", slave=DRIVE_3)],
        (FAULT,),
        reset_is_refused=True,
    ),
    Case(
        "falls and hangs",
        [_fault("al_fall", slave=DRIVE_3), _fault("al_hang", slave=DRIVE_3)],
        (FAULT,),
        reset_is_refused=True,
    ),
    Case("hangs in OP", [_fault("al_hang", slave=DRIVE_3)], (CONTINUES,), watch_s=0.7),
    Case("SDOs 500 ms late", [_fault("sdo_late", slave=DRIVE_1, ms=500)], (CONTINUES,), watch_s=0.7),
    Case("SDOs aborted", [_fault("sdo_abort", slave=DRIVE_1)], (CONTINUES,), watch_s=0.7),
    Case("frames lost: 1 in 100", [_fault("loss", rate=0.01)], (CONTINUES,), watch_s=1.5),
    Case("frames lost: 20 in a row", [_fault("loss", burst=20)], (CONTINUES,), watch_s=1.0),
    Case("frames lost: 4 in 5", [_fault("loss", rate=0.8)], (FAULT,), (LOST,)),
    Case("frames lost: all", [_fault("loss", rate=1.0)], (FAULT,), (LOST,), reset_is_refused=True),
    Case("answers 3 ms late: 1 in 50", [_fault("delay", ms=3, rate=0.02)], (CONTINUES,), watch_s=1.5),
    Case("answers 3 ms late: all", [_fault("delay", ms=3, rate=1.0)], (FAULT,), reset_is_refused=True),
    Case("answers twice: all", [_fault("duplicate", rate=1.0)], (CONTINUES,), watch_s=1.5),
    Case("answers out of order: 1 in 50", [_fault("reorder", rate=0.02)], (CONTINUES,), watch_s=1.5),
    # Reported at once, then at most every 10 s: possibly not in the trials after the first.
    Case(
        "damaged on the cable 3 to 4: 1 in 50",
        [_fault("corrupt", after=3, rate=0.02)],
        (CONTINUES,),
        ("enter between slave 3",),
        workloads=(HOLDING,),
    ),
    Case(
        "damaged on the cable 3 to 4: 1 in 50",
        [_fault("corrupt", after=3, rate=0.02)],
        (CONTINUES,),
        workloads=(MOVING, JOGGING),
        watch_s=1.5,
    ),
    Case("damaged on the cable 3 to 4: 20", [_fault("corrupt", after=3, burst=20)], (CONTINUES,), watch_s=1.0),
    Case(
        "damaged on the way back, 3 to 4: 1 in 50",
        [_fault("corrupt", after=3, way="back", rate=0.02)],
        (CONTINUES,),
        watch_s=1.5,
    ),
    # It depends on the bits: a statusword that reads as disabled stops the arm, a position may pass undetected.
    Case("undetected bit errors: 1 in 100", [_fault("garble", rate=0.01, bits=2)], (CONTINUES, FAULT, EMERGENCY)),
    Case("working counter wrong: 10 in a row", [_fault("wkc", slave=DRIVE_3, burst=10)], (CONTINUES,), watch_s=1.0),
    Case("working counter wrong: always", [_fault("wkc", slave=DRIVE_3, rate=1.0)], (FAULT,), (LOST,)),
    Case("drive: over-current", [_fault("drive", slave=DRIVE_3, error="over-current")], (FAULT,), ("0x2310",)),
    Case(
        "drive: over-temperature, lasting",
        [_fault("drive", slave=DRIVE_3, error="over-temperature", lasts=60)],
        (FAULT,),
        ("0x4310",),
        reset_is_refused=True,
    ),
    Case("drive: following error", [_fault("drive", slave=DRIVE_1, error="following-error")], (FAULT,), ("0x8611",)),
    Case("drive: encoder", [_fault("drive", slave=DRIVE_3, error="encoder")], (FAULT,), ("0x7305",)),
    Case("SYNC0 lost", [_fault("sync0", slave=DRIVE_3)], (FAULT,), reset_is_refused=True),
    # A jump past the next SYNC0 loses it, as in hardware that compares for equality; its phase is random.
    Case("clock jumps 200 us: drive 3", [_fault("clock_jump", slave=DRIVE_3, us=200)], (CONTINUES, FAULT)),
    Case("clock jumps 200 us: reference", [_fault("clock_jump", slave=BOX, us=200)], (CONTINUES, FAULT)),
    Case("clock drifts 200 ppm: drive 3", [_fault("clock_drift", slave=DRIVE_3)], (CONTINUES,)),
    Case("clock drifts 200 ppm: reference", [_fault("clock_drift", slave=BOX)], (CONTINUES,)),
    Case(
        "emergency stop's input stuck at pressed",
        [_fault("input", number=10, how="low")],
        (EMERGENCY,),
        ("emergency stop",),
        reset_is_refused=True,
    ),
    Case(
        "emergency stop's input bounces",
        [_fault("input", number=10, how="bounce", ms=20)],
        (EMERGENCY,),
    ),
    Case("joystick input stuck", [_fault("input", number=1, how="low")], (CONTINUES,), workloads=THREE, watch_s=1.0),
    Case("joystick out of code", [_fault("joystick_code", value=0)], (CONTINUES,), workloads=THREE, watch_s=1.0),
    Case("joystick out of code", [_fault("joystick_code", value=0)], (STOPS,), workloads=(JOYSTICK,), watch_s=1.0),
    Case(
        "toggle bounces", [_fault("input", number=9, how="bounce", ms=20)], (STOPS,), workloads=(JOYSTICK,), watch_s=1.0
    ),
    # Undetectable by the master: the button and the joystick behind such a box are dead.
    Case(
        "inputs frozen, then the emergency stop is pressed",
        [_fault("input_frozen", slave=BOX), _fault("input", number=10, how="low")],
        (CONTINUES,),
        watch_s=1.0,
    ),
    Case(
        "inputs frozen, then the joystick shows neutral",
        [_fault("input_frozen", slave=BOX), _fault("joystick_code", value=63)],
        (CONTINUES,),
        workloads=(JOYSTICK,),
        watch_s=1.0,
    ),
    Case("a push of 10 N at the tool", [_fault("push", y=10)], (CONTINUES,), watch_s=1.0),
    Case("noise of other protocols", [_fault("noise", rate_hz=500)], (CONTINUES,), watch_s=1.5),
)
