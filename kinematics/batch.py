"""Forward kinematics of many configurations at once, with numpy.

The poses are worked on in blocks whose arrays stay in the processor's cache, each quantity in an array of its own. What
a row of the table makes constant stays a number, so that a zero costs nothing and a one costs no multiplication.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from kinematics.model import ArmModel

Array: TypeAlias = npt.NDArray[np.float64]
_Scalar: TypeAlias = Array | float  # a quantity of every pose of the block, or the same number for all
_Column: TypeAlias = tuple[_Scalar, _Scalar, _Scalar]

_BLOCK = 2048  # poses: 16 KiB for each of some thirty arrays stay in a second-level cache of 1 MiB


def forward_batch(model: ArmModel, q: npt.ArrayLike) -> tuple[Array, Array]:
    """Tool poses of N configurations: positions (N, 3) in m and rotations (N, 3, 3), base <- tool.

    `q` has the shape (N, 6), in rad. ValueError for another shape, and for a value that is not finite, which it names.
    Agrees with `forward` to round-off (1e-14 of the reach).
    """
    angles = np.asarray(q, dtype=np.float64)
    if angles.ndim != 2 or angles.shape[1] != len(model.rows):
        raise ValueError(f"q has the shape {angles.shape}, and must have (N, {len(model.rows)})")
    if not np.isfinite(angles).all():
        row, joint = np.argwhere(~np.isfinite(angles))[0]
        raise ValueError(f"q[{row}, {joint}] is {angles[row, joint]}, and must be finite")
    count = len(angles)
    positions = np.empty((count, 3))
    rotations = np.empty((count, 3, 3))
    for start in range(0, count, _BLOCK):
        block = slice(start, start + _BLOCK)
        columns = np.ascontiguousarray(angles[block].T)
        *axes, origin = _tool(model, columns)
        for i in range(3):
            positions[block, i] = origin[i]
            for j in range(3):
                rotations[block, i, j] = axes[j][i]
    return positions, rotations


def _tool(model: ArmModel, q: Array) -> tuple[_Column, _Column, _Column, _Column]:
    """Axes x, y, z and origin of the tool; `q` is (6, n)."""
    x: _Column = (1.0, 0.0, 0.0)
    y: _Column = (0.0, 1.0, 0.0)
    z: _Column = (0.0, 0.0, 1.0)
    origin: _Column = (0.0, 0.0, 0.0)
    for (sin_alpha, cos_alpha, a, d, offset), angle in zip(model.constants, q, strict=True):
        origin = _step(origin, a, x)
        y, z = _combine(cos_alpha, y, sin_alpha, z), _combine(cos_alpha, z, -sin_alpha, y)
        origin = _step(origin, d, z)
        theta = angle + offset if offset else angle
        cosine, sine = np.cos(theta), np.sin(theta)
        x, y = _combine(cosine, x, sine, y), _combine(cosine, y, -sine, x)
    tool = model.tool
    r = tool.rotation
    for length, axis in zip(tool.position, (x, y, z), strict=True):
        origin = _step(origin, length, axis)
    if r != (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0):
        x, y, z = (_step(_combine(r[j], x, r[3 + j], y), r[6 + j], z) for j in range(3))
    return x, y, z, origin


def _combine(a: _Scalar, u: _Column, b: _Scalar, v: _Column) -> _Column:
    """a u + b v."""
    return (
        _add(_times(a, u[0]), _times(b, v[0])),
        _add(_times(a, u[1]), _times(b, v[1])),
        _add(_times(a, u[2]), _times(b, v[2])),
    )


def _step(origin: _Column, length: float, axis: _Column) -> _Column:
    return _combine(1.0, origin, length, axis) if length else origin


def _times(a: Any, b: Any) -> Any:
    if isinstance(a, float):
        if a == 0.0:
            return 0.0
        if a == 1.0:
            return b
        if a == -1.0:
            return -b
    if isinstance(b, float) and b in (0.0, 1.0, -1.0):
        return _times(b, a)
    return a * b


def _add(a: Any, b: Any) -> Any:
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b
