"""Linear algebra of six by six matrices in plain floats: numpy's calls cost more than the arithmetic at this size.

A matrix is a sequence of rows. Nothing here checks its input: the callers have.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, inf, sqrt
from operator import mul

Vector = Sequence[float]
Matrix = Sequence[Sequence[float]]

_TINY = 1e-150  # a pivot whose square would underflow
_ORTHOGONAL = 1e-30  # square of the cosine between two rows
_SWEEPS = 30  # one-sided Jacobi converges quadratically: six to eight sweeps do in practice


def product(matrix: Matrix, vector: Vector) -> list[float]:
    """The matrix times a column."""
    return [sum(map(mul, row, vector)) for row in matrix]


def gram(rows: Matrix) -> list[list[float]]:
    """The matrix times its transpose: the scalar products of all pairs of rows, symmetric."""
    count = len(rows)
    result = [[0.0] * count for _ in range(count)]
    for i, row in enumerate(rows):
        for j in range(i + 1):
            result[i][j] = result[j][i] = sum(map(mul, row, rows[j]))
    return result


def determinant(matrix: Matrix) -> float:
    """By elimination with the largest pivot of each column."""
    rows = [list(row) for row in matrix]
    value = 1.0
    while rows:
        best = max(range(len(rows)), key=lambda i: abs(rows[i][0]))
        pivot = rows.pop(best)
        if pivot[0] == 0.0:
            return 0.0
        value *= -pivot[0] if best % 2 else pivot[0]
        tail = pivot[1:]
        rows = [[x - row[0] / pivot[0] * y for x, y in zip(row[1:], tail, strict=True)] for row in rows]
    return value


def inverse(matrix: Matrix) -> list[list[float]] | None:
    """Of six by six, by Gauss and Jordan's elimination in place; None where the largest pivot of a column is zero.

    Written out by columns, which halves its time.
    """
    rows = [list(row) for row in matrix]
    order = [0, 1, 2, 3, 4, 5]
    for k in range(6):
        best, largest = k, abs(rows[k][k])
        for i in range(k + 1, 6):
            if (candidate := abs(rows[i][k])) > largest:
                best, largest = i, candidate
        if largest < _TINY:
            return None
        if best != k:
            rows[k], rows[best] = rows[best], rows[k]
            order[k], order[best] = order[best], order[k]
        # Column k is eliminated: its place takes the column of the inverse that begins as that of the unit matrix.
        scale = 1.0 / rows[k][k]
        rows[k][k] = 1.0
        a, b, c, d, e, f = rows[k] = [scale * x for x in rows[k]]
        for i in range(6):
            row = rows[i]
            factor = row[k]
            if i != k and factor != 0.0:
                row[k] = 0.0
                u, v, w, x, y, z = row
                rows[i] = [
                    u - factor * a, v - factor * b, w - factor * c, x - factor * d, y - factor * e, z - factor * f
                ]  # fmt: skip
    if order == [0, 1, 2, 3, 4, 5]:
        return rows
    # Exchanged rows of the matrix are exchanged columns of its inverse.
    columns = sorted(range(6), key=order.__getitem__)
    return [[row[column] for column in columns] for row in rows]


def solve_positive(matrix: Matrix, right: Vector) -> list[float] | None:
    """Solve a symmetric positive definite system by Cholesky's factors; None where it is not positive definite."""
    lower: list[list[float]] = []
    forward: list[float] = []
    for i, source in enumerate(matrix):
        row: list[float] = []
        for j, above in enumerate(lower):
            row.append((source[j] - sum(map(mul, row, above))) / above[j])
        pivot = source[i] - sum(map(mul, row, row))
        if not pivot > 0.0:
            return None
        forward_i = right[i] - sum(map(mul, row, forward))
        row.append(sqrt(pivot))
        lower.append(row)
        forward.append(forward_i / row[i])
    for i in range(len(lower) - 1, -1, -1):
        row = lower[i]
        forward[i] = value = forward[i] / row[i]
        for j in range(i):
            forward[j] -= value * row[j]
    return forward


def smallest_singular_value(matrix: Matrix) -> float:
    """By one-sided Jacobi rotations (Hestenes 1958): the rows are turned until all are orthogonal.

    Small singular values keep their relative accuracy better than through the eigenvalues of the Gram matrix.
    """
    rows = [list(row) for row in matrix]
    size = len(rows)
    for _ in range(_SWEEPS):
        turned = False
        for i in range(size - 1):
            for j in range(i + 1, size):
                u, v = rows[i], rows[j]
                uu, vv, uv = sum(map(mul, u, u)), sum(map(mul, v, v)), sum(map(mul, u, v))
                if uv * uv <= _ORTHOGONAL * uu * vv:
                    continue
                turned = True
                zeta = (vv - uu) / (2.0 * uv)
                tangent = (1.0 if zeta >= 0.0 else -1.0) / (abs(zeta) + hypot(1.0, zeta))
                cosine = 1.0 / hypot(1.0, tangent)
                sine = cosine * tangent
                rows[i] = [cosine * x - sine * y for x, y in zip(u, v, strict=True)]
                rows[j] = [sine * x + cosine * y for x, y in zip(u, v, strict=True)]
        if not turned:
            break
    return min((sqrt(sum(map(mul, row, row))) for row in rows), default=inf)
