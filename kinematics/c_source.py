"""Export of an arm as C99: forward kinematics and the closed-form inverse in one file and its header.

`solver.h` and `solver.c` beside this module are the template. Names that begin with arm_ get the arm's own prefix, so
that one program may hold several arms, and the arm's numbers take the place of one line.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Final, NamedTuple

from kinematics.model import ArmModel
from kinematics.position_ik import PlanarArm
from kinematics.spherical import SphericalArm, has_spherical_wrist

VERSION: Final = "1"
"""Version of the C interface and its results; it changes with either."""

_HERE: Final = Path(__file__).parent
_NUMBERS: Final = "/* numbers */\n"
_UNSAFE: Final = re.compile(r"[^\x20-\x7e]|[\"\\?]")


class CSource(NamedTuple):
    """The texts of a solver in C; `prefix` begins its names and those of its files."""

    prefix: str
    header: str
    source: str

    @property
    def files(self) -> dict[str, str]:
        """Name -> text: PREFIX_kinematics.h and PREFIX_kinematics.c."""
        return {f"{self.prefix}_kinematics.h": self.header, f"{self.prefix}_kinematics.c": self.source}


def to_c(model: ArmModel) -> CSource:
    """The arm as C99, for `cc -O2 -shared -fPIC`. Poses, solutions and their order are those of `kinematics`.

    Raises ValueError with the reason for an arm that the C solver does not cover: one without a spherical wrist, or
    whose axes 2 and 3 are not parallel.
    """
    arm = _covered(model)
    prefix, digest = c_name(model.name), numbers_digest(model)
    limits = model.limits
    numbers = {
        "ROWS[6][5]": model.constants,
        "TOOL_POSITION[3]": model.tool.position,
        "TOOL_ROTATION[9]": model.tool.rotation,
        **arm,
    }
    lines = [
        f"const char arm_name[] = {_string(model.name)};",
        f"const char arm_version[] = {_string(VERSION)};",
        f"const char arm_digest[] = {_string(digest)};",
        f"const char *const arm_joint_names[6] = {{{', '.join(map(_string, model.joint_names))}}};",
        f"const double arm_lower[6] = {_value([limit.lower for limit in limits])};",
        f"const double arm_upper[6] = {_value([limit.upper for limit in limits])};",
        f"const double arm_velocity[6] = {_value([limit.velocity for limit in limits])};",
        *(f"static const double {name} = {_value(value)};" for name, value in numbers.items()),
    ]
    title = f"/* Written by `rtcp arm export-c`; {digest[:12]}. Do not edit. */\n"
    header, source = ((_HERE / name).read_text(encoding="utf-8") for name in ("solver.h", "solver.c"))
    source = source.replace(_NUMBERS, "\n".join(lines) + "\n")
    return CSource(prefix, title + _renamed(header, prefix), title + _renamed(source, prefix))


def c_name(name: str) -> str:
    """A name as C and ROS packages allow it: lower case, digits and single underscores, a letter first."""
    identifier = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")
    return identifier if identifier[:1].isalpha() else f"arm_{identifier}".rstrip("_")


def numbers_digest(model: ArmModel) -> str:
    """SHA-256, hexadecimal, of everything on which the results depend: version, rows, limits, tool and joint names."""
    limits = [(limit.lower, limit.upper, limit.velocity) for limit in model.limits]
    rows = [(row.alpha, row.a, row.d, row.offset) for row in model.rows]
    content = [VERSION, rows, limits, model.tool, model.joint_names]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _covered(model: ArmModel) -> dict[str, float | Sequence[float]]:
    """The constants of the solver, by their declarations; raises ValueError for an arm that it does not cover."""
    if not has_spherical_wrist(model):
        raise ValueError(
            f"{model.name} has no spherical wrist (axes 4, 5 and 6 do not meet in one point): it has no closed-form "
            f"inverse to export as C"
        )
    arm = SphericalArm(model)
    if not arm.is_regular:
        raise ValueError(f"joints 1 to 3 of {model.name} do not move the wrist centre in three directions: no inverse")
    if not isinstance(arm.arm, PlanarArm):
        raise ValueError(
            f"axes 2 and 3 of {model.name} are not parallel (alpha of row 3 is {model.rows[2].alpha:g} rad): the C "
            f"solver covers alpha 0 and pi; kinematics.InverseKinematics covers the others"
        )
    numbers = {**arm.numbers(), **arm.arm.numbers()}
    return {f"{name}[{len(value)}]" if isinstance(value, tuple) else name: value for name, value in numbers.items()}


def _renamed(text: str, prefix: str) -> str:
    text = re.sub(r"\barm_(?=[a-z])", f"{prefix}_", text)
    return re.sub(r"\bARM_(?=[A-Z])", f"{prefix.upper()}_", text)


def _value(value: float | Sequence[object]) -> str:
    if isinstance(value, float | int):
        return "INFINITY" if value == inf else repr(float(value))
    return f"{{{', '.join(_value(entry) for entry in value)}}}"  # type: ignore[arg-type]


def _string(text: str) -> str:
    """A string literal of C: UTF-8, all but plain characters as octal escapes."""
    return '"' + _UNSAFE.sub(lambda match: "".join(f"\\{byte:03o}" for byte in match[0].encode()), text) + '"'
