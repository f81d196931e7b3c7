"""The guard between two arms of a cell: their bodies keep a clearance, also while both come to rest.

The guaranteed distance is the greater of two bounds: the present distance less the travel of any point until both arms
stand; and the lesser of the distances now and at the ends of both stops, less half of that travel. The distance is
computed again only when the travel since may have used it up.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf
from typing import Final

from kinematics.capsules import Placed, capsules, distance, with_every_tool
from kinematics.forward import frames
from kinematics.model import JOINTS, ArmModel
from kinematics.pose import Pose
from rtcp.config.cell import Member
from rtcp.ipc.events import MotionEnded, PartnerForeign, PartnerNear
from rtcp.ipc.refusals import LimitsTooNearPartner, Refusal
from rtcp.motion.step_group import StepGroup

_SLOW_M: Final = 0.02
"""Largest travel between two samples of the stops with which arms that are too near move apart, m."""
_MOST_SAMPLES: Final = 8
"""Upper bound on these samples, for lack of time in a cycle; arms that need more have to move apart more slowly."""
_ROUNDING_M: Final = 1e-9


def reach_of(model: ArmModel) -> list[float]:
    """Return for each joint the upper bound on the distance of a body's axis from the joint's, m."""
    lengths = [hypot(row.a, row.d) for row in model.rows]
    tool = hypot(*model.tool.position)
    beyond = max((hypot(*end) for body in capsules(model) for end in (body.start, body.end)), default=0.0)
    return [sum(lengths[i + 1 :]) + max(tool, beyond) for i in range(JOINTS)]


class Body:
    """The bodies of an arm in the world frame.

    Args:
        model: its geometry.
        base: pose of its base.
        acceleration: least deceleration of its joints in a stop, rad/s^2; may change in place.
    """

    def __init__(self, model: ArmModel, base: Pose, acceleration: Sequence[float]) -> None:
        self.model = model
        self.base = base
        self.placed = Placed(capsules(model))
        self.reach = reach_of(model)
        self.acceleration = acceleration
        self.end = [0.0] * JOINTS

    def place(self, q: Sequence[float]) -> None:
        """Place the bodies at the joint positions `q`, rad."""
        self.placed.place(frames(self.model, q), self.base)

    def travel(self, velocity: Sequence[float], delay_s: float) -> float:
        """Return the upper bound on a point's travel until the arm, which stops after `delay_s`, stands, m."""
        distance = 0.0
        for i, reach in enumerate(self.reach):
            speed = velocity[i] if velocity[i] >= 0.0 else -velocity[i]
            distance += reach * speed * (delay_s + 0.5 * speed / self.acceleration[i])
        return distance

    def stop(self, q: Sequence[float], velocity: Sequence[float], delay_s: float, time_s: float = inf) -> float:
        """Place the bodies where the arm is at `time_s`, or at rest; return the bound on a point's speed then, m/s."""
        fastest = 0.0
        for i, reach in enumerate(self.reach):
            rate = self.acceleration[i]
            speed = velocity[i] if velocity[i] >= 0.0 else -velocity[i]
            before_s = delay_s if time_s > delay_s else time_s
            ramp_s = time_s - before_s
            slower = speed - rate * ramp_s
            if slower <= 0.0:
                ramp_s, slower = speed / rate, 0.0
            angle = speed * before_s + 0.5 * (speed + slower) * ramp_s
            self.end[i] = q[i] + angle if velocity[i] >= 0.0 else q[i] - angle
            fastest += reach * slower
        self.place(self.end)
        return fastest

    def moved(self, before: Sequence[float], q: Sequence[float]) -> float:
        """Return the upper bound on a point's motion between two configurations, m."""
        distance = 0.0
        for i, reach in enumerate(self.reach):
            turned = q[i] - before[i]
            distance += reach * (turned if turned >= 0.0 else -turned)
        return distance


def body_of(member: Member, acceleration: Sequence[float] | None = None) -> Body | None:
    """Return the body of an arm, with its configured accelerations or others; None: unknown geometry.

    It includes the bodies of all its tools: partners keep clear of each of them.
    """
    models, base = member.config.models, member.base
    if not models:
        return None
    bounds = [joint.acceleration for joint in member.config.joints] if acceleration is None else acceleration
    return Body(with_every_tool(models), Pose.from_xyzrpy(*base.position, *base.rpy), bounds)


def certain(
    a: Body,
    q: Sequence[float],
    v: Sequence[float],
    b: Body,
    p: Sequence[float],
    w: Sequence[float],
    delays_s: tuple[float, float],
) -> tuple[float, float, float]:
    """Return the guaranteed distance of two arms during their stops, the distance now, and that at rest, m.

    Args:
        a: first arm, at `q`, rad, with the speeds `v`, rad/s.
        b: second arm, at `p` with `w`.
        delays_s: time before each begins to stop.
    """
    a.place(q)
    b.place(p)
    here = distance(a.placed, b.placed)[0]
    whole = a.travel(v, delays_s[0]) + b.travel(w, delays_s[1])
    if whole == 0.0:
        return here, here, here
    a.stop(q, v, delays_s[0])
    b.stop(p, w, delays_s[1])
    then = distance(a.placed, b.placed)[0]
    return max(here - whole, min(here, then) - 0.5 * whole), here, then


def parting(
    a: Body,
    q: Sequence[float],
    v: Sequence[float],
    b: Body,
    p: Sequence[float],
    w: Sequence[float],
    delays_s: tuple[float, float],
    clearance: float,
) -> bool:
    """Return whether no two bodies that are too near, or could become so, come nearer until both arms stand.

    Between two samples no point travels further than `_SLOW_M`. The arguments are those of `certain`; clearance:
    required distance, m.
    """
    remaining = a.travel(v, delays_s[0]) + b.travel(w, delays_s[1])
    fastest = a.stop(q, v, delays_s[0], 0.0)
    others = b.stop(p, w, delays_s[1], 0.0)
    moves = others > 0.0
    near = []
    for i in range(len(a.placed.radii)):
        for j in range(len(b.placed.radii)):
            pair = ((i, j),)
            apart = distance(a.placed, b.placed, pair)[0]
            if apart <= clearance + remaining:
                near.append((pair, apart))
    own, other, time_s = list(q), list(p), 0.0
    for _ in range(_MOST_SAMPLES):
        if fastest + others <= 0.0:
            return True
        time_s = time_s + _SLOW_M / (fastest + others) if remaining > _SLOW_M else inf
        fastest = a.stop(q, v, delays_s[0], time_s)
        others = b.stop(p, w, delays_s[1], time_s) if moves else 0.0
        travelled = a.moved(own, a.end) + (b.moved(other, b.end) if moves else 0.0)
        remaining -= travelled
        own[:], other[:] = a.end, b.end
        is_clear = True
        for at, (pair, before) in enumerate(near):
            apart = distance(a.placed, b.placed, pair)[0]
            is_certain = apart - remaining - 0.5 * travelled > clearance
            if apart < before - _ROUNDING_M and not is_certain:
                return False
            is_clear = is_clear and is_certain
            near[at] = pair, apart
        if is_clear:
            return True
    return False


class Neighbours:
    """Guards the distance of an arm to its partners.

    Args:
        own: this arm.
        partners: in the order of the cell; None: without geometry.
        group: records of the partners.
        clearance: required distance, m.
        period_s: cycle time.
        delay_s: time before a partner begins to stop, beyond the age of its record.
    """

    def __init__(
        self,
        own: Body,
        partners: Sequence[Body | None],
        group: StepGroup,
        clearance: float,
        period_s: float,
        delay_s: float,
    ) -> None:
        self._own = own
        self._partners = list(partners)
        self._group = group
        self._clearance = clearance
        self._period_s, self._delay_s = period_s, delay_s
        self._room = [0.0] * len(self._partners)
        """Least distance of two bodies with this arm at `_here` and the partner at `_there`, m."""
        self._here = [[0.0] * JOINTS for _ in self._partners]
        self._there = [[0.0] * JOINTS for _ in self._partners]

    def ahead(self, q: Sequence[float], velocity: Sequence[float]) -> MotionEnded | None:
        """Return why this arm may not move to `q`, rad, at these speeds, rad/s, or None."""
        if not any(velocity):
            return None
        if self._group.foreign >= 0:
            return PartnerForeign(self._group.foreign)
        return self.near(q, velocity)

    def refusal_of(
        self, q: Sequence[float], velocity: Sequence[float], acceleration: Sequence[float]
    ) -> Refusal | None:
        """Return a refusal if the stop from `q`, rad, at these rates, rad/s^2, comes too near a partner; or None."""
        own = self._own
        in_force, own.acceleration = own.acceleration, acceleration
        near = self.near(q, velocity)
        own.acceleration = in_force
        return None if near is None else LimitsTooNearPartner(near.partner, near.distance)

    def near(self, q: Sequence[float], velocity: Sequence[float], part: float = 1.0) -> PartnerNear | None:
        """Return the partner that this arm could come nearer to than a part of the clearance before both stand."""
        own, dt, clearance = self._own, self._period_s, part * self._clearance
        own_travel = own.travel(velocity, dt)
        for index, body in enumerate(self._partners):
            partner = self._group.members[index]
            if body is None or not partner.time_ns:
                continue
            there, theirs = partner.position, partner.velocity
            whole = own_travel + body.travel(theirs, self._delay_s)
            used = own.moved(self._here[index], q) + body.moved(self._there[index], there)
            if self._room[index] - used - whole > clearance:
                continue
            least, here, then = certain(own, q, velocity, body, there, theirs, (dt, self._delay_s))
            self._room[index] = here
            self._here[index][:], self._there[index][:] = q, there
            delays_s = (dt, self._delay_s)
            if least > clearance or parting(own, q, velocity, body, there, theirs, delays_s, clearance):
                continue
            return PartnerNear(index, max(min(here, then), 0.0))
        return None
