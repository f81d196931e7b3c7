"""Paths of a rod from straight to a wanted end pose or wanted parameters, through stable equilibria only.

The straight rod is singular: no step of its end pose leads away from it. But an arc of constant curvature needs end
moments alone, its end pose is known, and it is stable from the smallest angle on. So a straight rod is first bent to a
small arc, to a chosen side; from there the end pose moves along a geodesic, in steps that are halved where the rod
would snap or move too far.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from math import hypot
from typing import Final, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from kinematics.pose import Pose
from kinematics.pose import Rotation as Rows
from rtcp.ipc.errors import Refused, RtcpError
from rtcp.processes.rod.statics import STEPS, Equilibrium, Rod, integrate, pose_error, shoot

PRE_BENT_RAD: Final = 0.4
"""Angle between the ends of the arc from which the end pose moves on."""
_LARGEST_MOVE: Final = 0.025
"""Largest move of a node in a step, in lengths of the rod."""
_LARGEST_STEP, _SMALLEST_STEP = 0.1, 1e-4
_STRAIGHT: Final = 1e-3
_ATTEMPTS: Final = 2000


class Form(enum.Enum):
    """Kinds of shapes that can be drawn at random."""

    ARC = "arc"
    S = "s"
    OUT_OF_PLANE = "out of plane"


def pre_bend(rod: Rod, side: tuple[float, float], angle: float = PRE_BENT_RAD) -> tuple[Equilibrium, ...]:
    """Return the arcs from the straight rod to an angle, rad, between the ends; `side`: the direction in e2, e3.

    Raises:
        Refused: strain.
    """
    along = np.array(side) / hypot(*side)

    def arc(part: float) -> Equilibrium:
        moment = rod.moment(part * angle / rod.length) * rod.length / rod.bending_stiffness
        return integrate(rod, [0.0, -moment * along[1], moment * along[0], 0.0, 0.0, 0.0])

    straight = integrate(rod, np.zeros(6))
    return (straight, *_advance(arc(_SMALLEST_STEP), lambda part, _: arc(max(part, _SMALLEST_STEP))))


def bend(rod: Rod, end: Pose, side: tuple[float, float] | None = None) -> tuple[Equilibrium, ...]:
    """Return equilibria from the straight rod to an end pose (frame of the start), each beside the one before.

    Args:
        rod: unloaded and straight.
        end: its rotation is less than half a turn; further ones by `follow_pose` from the last equilibrium.
        side: the direction in e2, e3 in which it begins to bend; None: that of the end pose.

    Raises:
        Refused: `rod_out_of_reach`, `rod_straight`, `rod_strain`, `rod_unstable`, `rod_no_equilibrium`.
    """
    reach = hypot(*end.position)
    if not reach < rod.length:
        raise RtcpError(
            "refused",
            f"the end pose is {reach:.4g} m from the start, a bent rod of {rod.length:g} m allows less than its "
            "length: bring the ends nearer to each other",
            "rod_out_of_reach",
            {"distance": reach, "length": rod.length},
        )
    if reach > rod.length * (1.0 - _STRAIGHT**2):
        raise RtcpError(
            "refused",
            f"the end pose leaves the rod straight within {_STRAIGHT**2:g} of its length, where its shape is not "
            "determined: bring the ends nearer to each other",
            "rod_straight",
            {"distance": reach, "length": rod.length},
        )
    if side is None:
        _, _, _, ey, _, _, ez, _, _ = end.rotation
        lateral = [(end.position[1], end.position[2]), (ey * rod.length, ez * rod.length), (rod.length, 0.0)]
        side = next(vector for vector in lateral if hypot(*vector) > _STRAIGHT * rod.length)
    arcs = pre_bend(rod, side)
    return (*arcs, *follow_pose(arcs[-1], end)[1:])


def follow_pose(start: Equilibrium, end: Pose) -> tuple[Equilibrium, ...]:
    """Return equilibria from `start`, the first, to an end pose, along the geodesic of the end pose.

    Raises:
        Refused: as `bend`.
    """
    error = pose_error(start, end)
    orientation = np.reshape(start.end.rotation, (3, 3))
    begin, offset = np.array(start.end.position), np.array(end.position) - np.array(start.end.position)

    def solve(part: float, before: Equilibrium) -> Equilibrium:
        rotation = orientation @ Rotation.from_rotvec(part * error[:3]).as_matrix()
        x, y, z = (begin + part * offset).tolist()
        return shoot(start.rod, Pose((x, y, z), cast(Rows, tuple(rotation.ravel().tolist()))), before)

    return _advance(start, solve)


def follow_parameters(start: Equilibrium, a: npt.ArrayLike) -> tuple[Equilibrium, ...]:
    """Return equilibria from `start`, the first, to parameters `a`, (6,), along the straight line between them.

    Raises:
        Refused: as `bend`.
    """
    goal = np.asarray(a, dtype=np.float64)

    def solve(part: float, before: Equilibrium) -> Equilibrium:
        parameters = start.a + part * (goal - start.a)
        return integrate(start.rod, parameters, start.set_shape, start.weight.tolist(), len(start.s) - 1)

    return _advance(start, solve)


def check(equilibrium: Equilibrium) -> None:
    """Check that a plan may pass through an equilibrium.

    Raises:
        Refused: `rod_strain` or `rod_unstable`, with the place along the rod.
    """
    rod, strain = equilibrium.rod, equilibrium.largest_strain
    if not strain <= rod.usable_strain:
        at = float(equilibrium.s[int(equilibrium.strain.argmax())])
        allowed = f"{rod.usable_strain:.3g} is allowed, {rod.hard_strain:.3g} is the hard limit"
        raise RtcpError(
            "refused",
            f"the strain at {at:.4g} m along the rod is {strain:.4g}, {allowed}: choose a thinner rod or a wider bend",
            "rod_strain",
            {"strain": strain, "usable": rod.usable_strain, "hard": rod.hard_strain, "s": at},
        )
    place = equilibrium.conjugate_point
    if place is not None:
        raise RtcpError(
            "refused",
            f"the rod would snap: it has a conjugate point at {place:.4g} m, none is allowed up to its length of "
            f"{rod.length:g} m: choose another end pose, or another way to it",
            "rod_unstable",
            {"conjugate_point": place, "length": rod.length},
        )


def sample_equilibrium(rod: Rod, form: Form, generator: np.random.Generator) -> Equilibrium:
    """Return a random stable equilibrium of a form, within the usable strain; drawn in the parameters.

    Raises:
        Refused: none was drawn: the rod is too thick for its length.
    """
    for _ in range(_ATTEMPTS):
        if form is Form.ARC:
            turned = generator.uniform(0.0, 2.0 * np.pi)
            moment = rod.moment(generator.uniform(0.5, 3.0) / rod.length) * rod.length / rod.bending_stiffness
            a = np.array([0.0, moment * np.sin(turned), moment * np.cos(turned), 0.0, 0.0, 0.0])
        elif form is Form.S:
            a = generator.uniform(-1.0, 1.0, 6) * [0.0, 0.0, 8.0, 20.0, 20.0, 0.0]
        else:
            a = generator.uniform(-1.0, 1.0, 6) * [3.0, 6.0, 6.0, 20.0, 20.0, 20.0]
        drawn = integrate(rod, a)
        if drawn.is_stable and drawn.largest_strain <= rod.usable_strain and _has_form(drawn, form):
            return drawn
    raise RtcpError(
        "refused",
        f"no stable shape was drawn in {_ATTEMPTS} attempts for a rod of {rod.diameter:g} m by {rod.length:g} m with a "
        f"strain of at most {rod.usable_strain:g}: choose a thinner or longer rod",
        "rod_no_equilibrium",
    )


def _has_form(drawn: Equilibrium, form: Form) -> bool:
    if form is Form.S:
        changes = np.flatnonzero(np.diff(np.sign(drawn.u[:, 2])))
        return len(changes) == 1 and STEPS // 4 < changes[0] < 3 * STEPS // 4
    if form is Form.OUT_OF_PLANE:
        spread = np.linalg.svd(drawn.p - drawn.p.mean(axis=0), compute_uv=False)
        return bool(spread[-1] > 0.02 * spread[0])
    return True


def _advance(start: Equilibrium, solve: Callable[[float, Equilibrium], Equilibrium]) -> tuple[Equilibrium, ...]:
    """Equilibria from part 0 to part 1 of a path, in steps that are halved where one is refused or moves too far."""
    check(start)
    passed, part, step = [start], 0.0, _LARGEST_STEP
    while part < 1.0:
        following = min(part + step, 1.0)
        try:
            equilibrium = solve(following, passed[-1])
            check(equilibrium)
            _check_beside(passed[-1], equilibrium)
        except Refused as refused:
            step *= 0.5
            if step < _SMALLEST_STEP:
                message = f"at {part:.1%} of the way {refused.message}"
                raise RtcpError("refused", message, refused.reason, {**refused.fields, "part": part}) from None
            continue
        passed.append(equilibrium)
        part, step = following, min(1.5 * step, _LARGEST_STEP)
    return tuple(passed)


def _check_beside(before: Equilibrium, after: Equilibrium) -> None:
    move = float(np.abs(after.p - before.p).max()) / before.rod.length
    if move > _LARGEST_MOVE:
        raise RtcpError(
            "refused",
            f"the rod would jump by {move:.3g} of its length, {_LARGEST_MOVE:g} is allowed: choose another way",
            "rod_unstable",
            {"move": move},
        )
