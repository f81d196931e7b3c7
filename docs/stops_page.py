"""The stop reactions for docs/stops.md, which `python docs/generate.py` writes.

Bounds are those of the shipped arm, from `rtcp.ipc.stops`; the tests measure against the same ones.
"""

from __future__ import annotations

from typing import get_args, get_type_hints

from rtcp.config.model import ArmConfig, StopsConfig
from rtcp.ipc.stops import Bound, Rung, bounds, tool_bounds, unheard

HEADING = "## The ladder of stops"
_EVENTS = {
    "lost_frames": "`bus.lost_cycles` lost cycles in a row, or so many more lost than good ones",
    "slave_lost": "a slave has left OP, or does not answer",
    "drive_fault": "a drive is in fault, or has left Operation Enabled by itself: the rung is that of all others",
    "clock_lost": "the cycle has not followed the reference clock for 1 s",
    "emergency_stop": "its input is active",
    "supervision": "speed, torque or following error was beyond its limit for `supervision.cycles`",
    "lease_ended": "the commander of what moves fell silent or gave up its lease",
    "enabling_switch": "it was let go while something moves",
}


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)


def _largest(found: tuple[Bound, ...]) -> tuple[str, str]:
    return f"{1000 * max(one.time_s for one in found):.0f} ms", f"{max(one.way_rad for one in found):.3f} rad"


def rungs(config: ArmConfig) -> str:
    """Return the table of rungs: what happens, how long it takes and how far it goes, and how to go on."""
    held, controlled, quick, silent = (
        _largest(found)
        for found in (
            bounds(config, Rung.HOLD),
            bounds(config, Rung.CONTROLLED_STOP),
            bounds(config, Rung.QUICK_STOP),
            unheard(config),
        )
    )
    tool = tool_bounds(config, config.cartesian.speed, config.cartesian.angular_speed)
    again = "mend the cause, `rtcp reset`, `rtcp enable`"
    rows = [
        [
            "hold", "the last targets are sent again, unchanged", f"{held[0]}, then the rung of `lost_frames`",
            f"{held[1]}", "unchanged", "by itself, with the next right working counter",
        ],
        [
            "controlled stop", "set-points down to standstill under the limits; the drives stay enabled",
            f"{controlled[0]}; {1000 * max(tool).time_s:.0f} ms where the tool's limits lead",
            f"{controlled[1]}; the tool {tool[0].way_rad:.2f} m and {tool[1].way_rad:.2f} rad",
            "holding; fault for `clock_lost`", "a new command; after `clock_lost` as after a quick stop",
        ],
        [
            "quick stop", "each drive ramps down by itself (0x6085) and holds with torque (0x605A = 6)",
            quick[0], quick[1],
            "fault; emergency stop for `emergency_stop` and `watch`, where torque goes off at standstill", again,
        ],
        [
            "torque off", "disable voltage: no ramp, the brakes close on what moves", "the brakes'", "the brakes'",
            "fault without torque, or emergency stop", again,
        ],
        [
            "(nothing is heard)", "a drive that no frame reaches ends it by its watchdog and ramps down (0x605E = 2)",
            silent[0], silent[1], "fault; the drive's torque is off", again,
        ],
    ]  # fmt: skip
    return _table(["rung", "what happens", "stands within", "way of a joint", "state after", "how to go on"], rows)


def events() -> str:
    """Return the table of events: the key of each, the rungs that it may take, and the one that it takes."""
    rows = []
    for key, hint in get_type_hints(StopsConfig).items():
        chosen = getattr(StopsConfig, key)
        rows.append([f"`stops.{key}`", _EVENTS[key], ", ".join(get_args(hint)), chosen])
    return _table(["key", "event", "rungs that it may take", "default"], rows)


def section(config: ArmConfig) -> str:
    """Return the whole section."""
    on = f"{bounds(config, Rung.HOLD)[0].way_rad:.3f} rad"
    return f"""{HEADING}

Made by `python docs/generate.py`; a test holds both together, and others measure the bounds on the
device models. The figures are those of the shipped arm, for joints at full speed, from the cycle that finds the
reason: they follow the joints' limits, `bus.lost_cycles`, 0x6085 and `watchdog_ms` of the configuration. On the bus
`virtual` hold and watchdog last `bus.timeout_scale` times as long.

{rungs(config)}

Which event takes which rung is the section `stops` of the arm's file:

{events()}

- **Hold** is the rung of every single cycle with a wrong working counter and cannot be chosen. Time stands still for
  the set-points, whatever the state and the mode, also where one slave alone is missing and all others have heard. In
  CSP a joint stands at its last target. In CSV it runs on at its last speed, at most {on} until the rung or the
  next good cycle; in CST the last torque goes on, without the damping that is closed in the master, and the way follows
  what the joint turns. Where frames are lost often, use CSP.
- **Lost cycles are counted against good ones:** one more for each lost, one less for each good. `lost_frames` comes
  where the count reaches `bus.lost_cycles`: at once after so many in a row, later where a few good ones are among them,
  never where at least every second cycle is good.
- **The emergency stop is heard while other slaves are missing:** that it is pressed is taken from every frame that some
  slave answered, for as long as the IO box is in OP. Nothing else is taken from such frames: no release, no stick, no
  permission, no position. Since nobody sees then whether the joints stand, their torque goes after 0.5 s, or after the
  quick stop's time where that is longer. An IO box that has been out of OP for 2 s, with no good cycle, takes the
  button with it: in the fault that this is, it counts as pressed, as its broken wire does, and the torque goes.
- **Torque off** beside a person: no drive holds its joint any more. The brakes close on whatever moves, and until they
  have closed a joint under weight sags: the arm may come down on what is below it. How far is the brakes' and the
  load's affair, not the configuration's: measure it before you choose it. It is the right rung where a drive that
  still has torque is the danger. After a quick stop the arm holds; `rtcp disable` takes the torque off then.
- IEC 60204-1 calls a quick stop after which the arm holds category 2, `emergency_stop: quick_stop` category 1, and
  `torque_off` category 0. These stops are software; a protective device in hardware stays the builder's.
- A guard that ends a motion always takes a controlled stop: it brakes in time on a way that was examined, which the
  drives' own ramps would leave. What has no key (a drive that does not enable, a reset that fails) is a quick stop.
- The quick stop is sent whatever a drive's statusword says: a word that is false for one frame takes no joint's torque.
- **Enabling** is supervised as motion is (`stops.supervision`); a drive that leaves Operation Enabled too early
  is a `drive_fault`. A drive obeys some frames before it shows that it does, and until then its target is the place
  that it shows: a place more than 0.03 rad from the last is not followed, and after `supervision.cycles` in a row
  a fault.
- A fault while the arm is being disabled ramps the joints down by its rung; at standstill the torque goes, as was
  asked.
- A `disable` goes on to its end where the clock is lost under `controlled_stop`: the fault is then without torque.
- Nothing goes on by itself. A drive that comes back, from another AL state or from a loss of its supply, is sent its
  own position and no enable until reset and enable. An IO box that leaves OP shows 0 at its outputs, and comes back
  with 0: what the gripper's output was, or was switched by hand, is forgotten, and counts again when it is commanded
  after the reset. Where `gripper.closed` is `off` it is at 0 that the gripper closes, as at a loss of the supply.
"""
