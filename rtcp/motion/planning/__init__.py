"""Plans for trajectories and straight lines, checked whole before anything moves. Outside the cycle; no numpy.

Both functions return a `Plan`, whose `rows` (layout: `rtcp.motion.planning.rows`) go into the plan area as they are, or
raise `PlanRefused` with a sentence:

    plan_trajectory(points, limits, q_now, *, names=(), zone_at=None) -> Plan
    plan_lines(model, limits, cartesian, q_now, stops, *, speed=None, zone_at=None) -> Plan
"""

from rtcp.motion.planning.knots import plan_trajectory
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.plan import Plan, PlanRefused, Point, Stop, ZoneAt

__all__ = ["Plan", "PlanRefused", "Point", "Stop", "ZoneAt", "plan_lines", "plan_trajectory"]
