"""Bodies of an arm as capsules, and the least distance between them: closed forms on plain floats.

A capsule is all that is nearer than its radius to a segment, its axis. Distances are signed, m: positive between bodies
that are apart, negative where they overlap.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations, product
from math import hypot, inf, sqrt
from typing import Final

from kinematics.forward import frames
from kinematics.model import JOINTS, ArmModel, Capsule
from kinematics.pose import IDENTITY, Pose, Vector, applied

SLIM: Final = 0.03
THICK: Final = 0.045
JOINT_LENGTH: Final = 2.5
"""Radii of the default bodies of links and of joints, relative to `extent`; length of a joint's cylinder, relative to
its radius."""
_PARALLEL: Final = 1e-14
"""Squared sine of the angle of two axes below which they count as parallel."""


def extent(model: ArmModel) -> float:
    """The sum of all lengths of an arm's rows, m; 1 for an arm without any."""
    return sum(abs(row.a) + abs(row.d) for row in model.rows) or 1.0


def rods(model: ArmModel) -> tuple[tuple[int, Vector, Vector], ...]:
    """Straight pieces that connect each joint to the next, and the last one to the tool: link, start and end in it, m.

    Along the common normal to the next axis, then along that axis; a piece without length is left out.
    """
    pieces: list[tuple[int, Vector, Vector]] = []
    for link in range(JOINTS):
        sine, cosine, a, d, _ = model.constants[link]
        corner = (a, 0.0, 0.0)
        pieces += [(link, (0.0, 0.0, 0.0), corner), (link, corner, (a, -sine * d, cosine * d))]
    pieces.append((JOINTS, (0.0, 0.0, 0.0), model.tool.position))
    return tuple(piece for piece in pieces if piece[1] != piece[2])


def capsules(model: ArmModel) -> tuple[Capsule, ...]:
    """The bodies of an arm: `model.bodies`, or by default one capsule around each of its `rods`.

    The default capsules contain everything that `to_urdf` draws: the end of a rod's capsule is the circumscribed sphere
    of the joint's cylinder there. The bodies of the tool, if known, come last and replace the rod from the flange to
    the tool.
    """
    tool = model.tool_bodies
    if model.bodies:
        return (*model.bodies, *(tool or ()))
    radius = THICK * extent(model) * hypot(1.0, 0.5 * JOINT_LENGTH)
    pieces = [piece for piece in rods(model) if tool is None or piece[0] != JOINTS]
    return (*(Capsule(link, start, end, radius) for link, start, end in pieces), *(tool or ()))


def with_every_tool(models: Sequence[ArmModel]) -> ArmModel:
    """The first model with the tool bodies of all `models`, one for each tool of an arm: the shape to keep clear of."""
    first = models[0]
    if len(models) == 1:
        return first
    count = len(capsules(replace(first, tool_bodies=())))
    return replace(first, tool_bodies=tuple(body for model in models for body in capsules(model)[count:]))


def self_pairs(model: ArmModel) -> tuple[tuple[int, int], ...]:
    """Pairs of `capsules(model)` that may collide with each other.

    Pairs of one link and of neighbouring links are left out, and pairs that overlap in every configuration. Pairs of
    default bodies are also left out if they overlap with all joints at 0, or as near as their ranges allow: these
    bodies are too thick for the arm, and only `model.bodies` can guard such a pair.
    """
    bodies = capsules(model)
    derived = 0 if model.bodies else len(bodies) - len(model.tool_bodies or ())
    home = Placed(bodies)
    home.place(frames(model, [min(max(0.0, limit.lower), limit.upper) for limit in model.limits]))
    pairs = []
    for i, j in combinations(range(len(bodies)), 2):
        a, b = (bodies[i], bodies[j]) if bodies[i].link <= bodies[j].link else (bodies[j], bodies[i])
        if b.link - a.link < 2 or _meet(model, a, b):
            continue
        if min(i, j) >= derived or distance(home, home, ((i, j),))[0] > 0.0:
            pairs.append((i, j))
    return tuple(pairs)


def _meet(model: ArmModel, inner: Capsule, outer: Capsule) -> bool:
    """Whether two bodies overlap in every configuration.

    The origin of frame i + 1 is fixed in link i; from there to the origin of frame j it is no farther than the lengths
    of the rows between.
    """
    sine, cosine, a, d, _ = model.constants[inner.link]
    between = sum(hypot(row.a, row.d) for row in model.rows[inner.link + 1 : outer.link])
    gap = _from_axis((a, -sine * d, cosine * d), inner) + between + _from_axis((0.0, 0.0, 0.0), outer)
    return gap <= inner.radius + outer.radius


def _from_axis(point: Vector, body: Capsule) -> float:
    """Distance of a point from the axis of a body in the same frame, m."""
    placed = Placed((body, Capsule(body.link, point, point, body.radius)))
    placed.place((IDENTITY,) * (JOINTS + 1))
    return distance(placed, placed, ((0, 1),))[0] + 2.0 * body.radius


class Placed:
    """The capsules of an arm at their places in the world; created once, updated by `place`.

    Args:
        bodies: the capsules, as `capsules` returns them.
    """

    def __init__(self, bodies: Sequence[Capsule]) -> None:
        self.bodies: Final = tuple(bodies)
        self.radii: Final = [body.radius for body in bodies]
        self.halves: Final = [
            0.5 * hypot(*(b - a for a, b in zip(body.start, body.end, strict=True))) for body in bodies
        ]
        """Half the length of each axis, m."""
        self.axes: Final = [0.0] * (6 * len(self.bodies))
        """Start of each axis, x, y, z, and from there to its end, m: six numbers a capsule."""

    def place(self, poses: Sequence[Pose], base: Pose = IDENTITY) -> None:
        """Update the axes of the capsules.

        Args:
            poses: `frames` of the arm's configuration.
            base: pose of the arm's base in the world.
        """
        axes, at = self.axes, 0
        moved = base is not IDENTITY
        for body in self.bodies:
            (ax, ay, az), (bx, by, bz) = body.start, body.end
            bx, by, bz = bx - ax, by - ay, bz - az
            if body.link:
                (px, py, pz), (a, b, c, d, e, f, g, h, i) = poses[body.link - 1]
                ax, ay, az = (
                    px + a * ax + b * ay + c * az,
                    py + d * ax + e * ay + f * az,
                    pz + g * ax + h * ay + i * az,
                )
                bx, by, bz = a * bx + b * by + c * bz, d * bx + e * by + f * bz, g * bx + h * by + i * bz
            if moved:
                px, py, pz = base.position
                ax, ay, az = applied(base.rotation, (ax, ay, az))
                bx, by, bz = applied(base.rotation, (bx, by, bz))
                ax, ay, az = px + ax, py + ay, pz + az
            axes[at], axes[at + 1], axes[at + 2] = ax, ay, az
            axes[at + 3], axes[at + 4], axes[at + 5] = bx, by, bz
            at += 6


def distance(a: Placed, b: Placed, pairs: Iterable[tuple[int, int]] | None = None) -> tuple[float, int, int]:
    """Return the least distance between bodies of two arms, m, and the indices of the two; inf, -1, -1 without pairs.

    Args:
        a: the bodies of one arm.
        b: the bodies of the other arm, or of the same.
        pairs: indices in `a` and `b` of the bodies to compare; None: all pairs.
    """
    least, first, second = inf, -1, -1
    p, q, p_radii, q_radii, p_halves, q_halves = a.axes, b.axes, a.radii, b.radii, a.halves, b.halves
    for i, j in product(range(len(p_radii)), range(len(q_radii))) if pairs is None else pairs:
        m, n = 6 * i, 6 * j
        x = p[m] - q[n] + 0.5 * (p[m + 3] - q[n + 3])
        y = p[m + 1] - q[n + 1] + 0.5 * (p[m + 4] - q[n + 4])
        z = p[m + 2] - q[n + 2] + 0.5 * (p[m + 5] - q[n + 5])
        radii = p_radii[i] + q_radii[j]
        bound = least + radii + p_halves[i] + q_halves[j]
        # the bounding spheres are at least as far apart as the nearest pair until now
        if x * x + y * y + z * z >= bound * bound:
            continue
        apart = sqrt(between_axes(p, m, q, n)[0]) - radii
        if apart < least:
            least, first, second = apart, i, j
    return least, first, second


def between_axes(p: Sequence[float], m: int, q: Sequence[float], n: int) -> tuple[float, float, float]:
    """Return the squared distance of two segments, m^2, and the place of the nearest point on each, 0 to 1.

    Args:
        p: start of the first segment and vector to its end, m: six numbers from index `m` on.
        m: index in `p`.
        q: the second segment, likewise.
        n: index in `q`.

    Segments without length and parallel ones are covered. Source: Ericson, Real-Time Collision Detection, section
    5.1.9.
    """
    ux, uy, uz = p[m + 3], p[m + 4], p[m + 5]
    vx, vy, vz = q[n + 3], q[n + 4], q[n + 5]
    wx, wy, wz = p[m] - q[n], p[m + 1] - q[n + 1], p[m + 2] - q[n + 2]
    a, e = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    c, f = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    s = t = 0.0
    if a == 0.0:
        if e > 0.0:
            t = _clamped(f / e)
    elif e == 0.0:
        s = _clamped(-c / a)
    else:
        b = ux * vx + uy * vy + uz * vz
        square = a * e - b * b
        if square > _PARALLEL * a * e:
            s = _clamped((b * f - c * e) / square)
        t = (b * s + f) / e
        if t < 0.0:
            t, s = 0.0, _clamped(-c / a)
        elif t > 1.0:
            t, s = 1.0, _clamped((b - c) / a)
    x, y, z = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return x * x + y * y + z * z, s, t


def from_box(placed: Placed, which: int, box: Sequence[float], within: float = inf) -> tuple[float, float]:
    """Return the signed distance of a body from a box, m, and the place of the nearest point on its axis, 0 to 1.

    The result is exact: the signed distance from a box is a convex function of a point, thus also along an axis.

    Args:
        placed: the bodies.
        which: index of the body.
        box: x, y, z of the lower corner, then of the upper one, m.
        within: for a body farther than this, m, a lower bound on its distance may be returned.
    """
    axes, at, radius = placed.axes, 6 * which, placed.radii[which]
    ball = outside(*point_at(axes, at, 0.5), box) - placed.halves[which] - radius
    if ball >= within:
        return ball, 0.5
    part = 0.0
    low, high = 0.0, 1.0
    if _slope(axes, at, box, 0.0) < 0.0:
        if _slope(axes, at, box, 1.0) <= 0.0:
            part = 1.0
        else:
            # The slope rises, and is linear between the places where the axis passes the planes of the faces.
            for k in range(3):
                along = axes[at + 3 + k]
                if along:
                    for face in (box[k], box[k + 3]):
                        place = (face - axes[at + k]) / along
                        if low < place < high:
                            if _slope(axes, at, box, place) < 0.0:
                                low = place
                            else:
                                high = place
            before, after = _slope(axes, at, box, low), _slope(axes, at, box, high)
            part = high if after <= 0.0 else low - before * (high - low) / (after - before)
    apart = outside(*point_at(axes, at, part), box)
    if apart <= 0.0:
        apart, part = _deepest(axes, at, box)
    return apart - radius, part


def outside(x: float, y: float, z: float, box: Sequence[float]) -> float:
    """Return how far a point is outside a box, m; negative: how deep inside."""
    a, b, c, d, e, f = box
    dx = a - x if a - x > x - d else x - d
    dy = b - y if b - y > y - e else y - e
    dz = c - z if c - z > z - f else z - f
    if dx <= 0.0 and dy <= 0.0 and dz <= 0.0:
        return max(dx, dy, dz)
    return hypot(dx if dx > 0.0 else 0.0, dy if dy > 0.0 else 0.0, dz if dz > 0.0 else 0.0)


def point_at(axes: Sequence[float], at: int, part: float) -> Vector:
    """Return a point of the axis that begins at `at`, m; `part` is 0 at its start and 1 at its end."""
    return axes[at] + part * axes[at + 3], axes[at + 1] + part * axes[at + 4], axes[at + 2] + part * axes[at + 5]


def _slope(axes: Sequence[float], at: int, box: Sequence[float], part: float) -> float:
    """Half the derivative of the squared distance from a box along an axis, m^2."""
    slope = 0.0
    for k in range(3):
        along = axes[at + 3 + k]
        x = axes[at + k] + part * along
        if x < box[k]:
            slope += (x - box[k]) * along
        elif x > box[k + 3]:
            slope += (x - box[k + 3]) * along
    return slope


def _deepest(axes: Sequence[float], at: int, box: Sequence[float]) -> tuple[float, float]:
    """Signed distance of an axis that meets a box, m (negative), and the place on the axis, 0 to 1.

    The depth is the greatest of six linear functions: it is least at an end or where two of them are equal.
    """
    lines = [(box[k] - axes[at + k], -axes[at + 3 + k]) for k in range(3)]
    lines += [(axes[at + k] - box[k + 3], axes[at + 3 + k]) for k in range(3)]
    parts = [0.0, 1.0]
    for (a, b), (c, d) in combinations(lines, 2):
        if b != d and 0.0 < (c - a) / (b - d) < 1.0:
            parts.append((c - a) / (b - d))
    return min([(outside(*point_at(axes, at, part), box), part) for part in parts])


def _clamped(part: float) -> float:
    return 0.0 if part < 0.0 else 1.0 if part > 1.0 else part
