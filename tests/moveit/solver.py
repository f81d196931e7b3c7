"""Compiles the exported C, calls it with the types of `kinematics`, and compares the two on many poses."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, pi
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from kinematics.c_source import to_c
from kinematics.forward import forward, forward_batch
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel
from kinematics.pose import Pose
from kinematics.solution import BRANCHES, SINGULARITIES, Solution, six

Array = npt.NDArray[np.float64]

needs_c = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler (cc) on this machine")
needs_cpp = pytest.mark.skipif(
    None in map(shutil.which, ("cc", "c++")), reason="there is no C or no C++ compiler (cc, c++) on this machine"
)
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-Wshadow")
INVALID = -1
MOST = 16
SAME = 1e-9
"""rad; beside a singularity joints may differ by more where the tool does not."""
SOLUTION = np.dtype([("q", "f8", 6), ("branch", "i4"), ("singularity", "i4"), ("outside", "i4")], align=True)
MANY = """
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#include "arm_kinematics.h"
void many(int nearest, int count, const arm_pose *poses, const double *near, arm_solution *out,
          int *counts, double *us) {
    struct timespec begin, end;
    for (int i = 0; i < count; i++) {
        clock_gettime(CLOCK_MONOTONIC, &begin);
        counts[i] = (nearest ? arm_nearest : arm_solve)(&poses[i], &near[6 * i], &out[16 * i]);
        clock_gettime(CLOCK_MONOTONIC, &end);
        us[i] = 1e6 * (double)(end.tv_sec - begin.tv_sec) + 1e-3 * (double)(end.tv_nsec - begin.tv_nsec);
    }
}
"""
"""Calls for many poses at once, with the time of each, us."""


class CPose(ctypes.Structure):
    _fields_ = (("position", ctypes.c_double * 3), ("rotation", ctypes.c_double * 9))

    def pose(self) -> Pose:
        return Pose(tuple(self.position), tuple(self.rotation))


class CSolver:
    """The exported solver of an arm, compiled in `folder` and loaded."""

    def __init__(self, model: ArmModel, folder: Path, *options: str) -> None:
        text = to_c(model)
        self.prefix = text.prefix
        for name, content in text.files.items():
            (folder / name).write_text(content)
        (folder / "many.c").write_text(MANY.replace("arm_", f"{text.prefix}_"))
        sources = [str(folder / f"{text.prefix}_kinematics.c"), str(folder / "many.c")]
        library = folder / f"lib{text.prefix}.so"
        command = ["cc", "-O2", "-ffp-contract=off", "-shared", "-fPIC", *options, "-o", str(library), *sources, "-lm"]
        subprocess.run(command, check=True)
        self.library = ctypes.CDLL(str(library))

    def text(self, name: str) -> str:
        return ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(self.library, f"{self.prefix}_{name}"))).decode()

    def numbers(self, name: str) -> list[float]:
        return list((ctypes.c_double * 6).in_dll(self.library, f"{self.prefix}_{name}"))

    def joint_names(self) -> list[str]:
        return [name.decode() for name in (ctypes.c_char_p * 6).in_dll(self.library, f"{self.prefix}_joint_names")]

    def frames(self, q: Sequence[float]) -> list[Pose]:
        poses = (CPose * 7)()
        self._function("frames")((ctypes.c_double * 6)(*q), poses)
        return [frame.pose() for frame in poses]

    def forward(self, q: Sequence[float]) -> Pose:
        result = CPose()
        self._function("forward")((ctypes.c_double * 6)(*q), ctypes.byref(result))
        return result.pose()

    def solve(self, pose: Pose, near: Sequence[float] | None = None) -> list[Solution] | None:
        """None for an argument that the solver calls invalid."""
        return self._solutions("solve", pose, near)

    def nearest(self, pose: Pose, seed: Sequence[float]) -> list[Solution] | None:
        return self._solutions("nearest", pose, seed)

    def many(
        self, poses: Array, near: Array, *, nearest: bool = False
    ) -> tuple[npt.NDArray[np.void], npt.NDArray[np.int32], Array]:
        """Solutions (N, 16), their counts (N,) and the times, us (N,), for poses (N, 12) and joint positions (N, 6)."""
        poses, near = np.ascontiguousarray(poses), np.ascontiguousarray(near)
        solutions = np.zeros((len(poses), MOST), SOLUTION)
        counts, us = np.zeros(len(poses), np.int32), np.zeros(len(poses))
        arrays = (array.ctypes.data_as(ctypes.c_void_p) for array in (poses, near, solutions, counts, us))
        self.library.many(int(nearest), len(poses), *arrays)
        return solutions, counts, us

    def _solutions(self, name: str, pose: Pose, near: Sequence[float] | None) -> list[Solution] | None:
        solutions = np.zeros(MOST, SOLUTION)
        given = CPose((ctypes.c_double * 3)(*pose[0]), (ctypes.c_double * 9)(*pose[1]))
        seed = None if near is None else (ctypes.c_double * 6)(*near)
        count = self._function(name)(ctypes.byref(given), seed, solutions.ctypes.data_as(ctypes.c_void_p))
        return None if count == INVALID else [_solution(solution) for solution in solutions[:count]]

    def _function(self, name: str) -> ctypes._NamedFuncPointer:
        return getattr(self.library, f"{self.prefix}_{name}")


def _solution(row: np.void) -> Solution:
    outside = tuple(joint for joint in range(6) if row["outside"] >> joint & 1)
    q = six(row["q"].tolist())
    return Solution(q, BRANCHES[row["branch"]], not outside, outside, SINGULARITIES[row["singularity"]])


@dataclass
class Comparison:
    """Compared poses and their differences."""

    poses: int = 0
    solutions: int = 0
    singular: int = 0
    unreachable: int = 0
    different: int = 0
    worst: float = 0.0
    """rad, over the joints of solutions, regardless of multiples of 2 pi."""
    first: str = ""


def configurations(model: ArmModel, count: int, seed: int) -> tuple[Array, Array]:
    """Joint positions (N, 6), rad, and factors (N,) of the tool's position: some above 1, to be out of reach.

    Three of 16 are on or beside the wrist's or the elbow's singularity.
    """
    random = np.random.default_rng(seed)
    q, kind = random.uniform(-1.1 * pi, 1.1 * pi, (count, 6)), np.arange(count) % 16
    beside = random.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-3], count)
    offsets = np.array([row.offset for row in model.rows])
    wrist, quarters, elbow = kind == 1, kind == 2, kind == 3
    q[wrist, 4] = beside[wrist] - offsets[4]
    q[quarters] = np.round(q[quarters] / (pi / 2)) * pi / 2 - offsets  # several singularities at once, on many
    row = model.rows[3]
    stretched = -offsets[2] - np.arctan2(-np.sin(row.alpha) * row.d, row.a)
    q[elbow, 2] = stretched + random.choice([0.0, pi], count)[elbow] + beside[elbow]
    return q, np.where(np.arange(count) % 160 == 4, random.uniform(1.0, 3.0, count), 1.0)


def compare(model: ArmModel, solver: CSolver, count: int, seed: int = 1) -> Comparison:
    """Solve poses both ways; solutions are the same where order, branch, limits, singularities and the tool are."""
    inverse, result = InverseKinematics(model), Comparison()
    for block in range(0, count, 20_000):
        q, stretch = configurations(model, min(20_000, count - block), seed + block)
        positions, rotations = forward_batch(model, q)
        poses = np.hstack([positions * stretch[:, None], rotations.reshape(-1, 9)])
        if model.rows[0].alpha == 0.0:  # every 16th onto the shoulder's singularity: the wrist centre on axis 1
            last = model.rows[5].d * np.array([0.0, 0.0, 1.0]) + model.tool.position
            levers = rotations @ np.reshape(model.tool.rotation, (3, 3)).T @ last
            centres = poses[:, :3] - levers
            poses[5::16, :2] -= (centres[:, :2] - [model.rows[0].a, 0.0])[5::16]
        nears = np.random.default_rng(seed + block).uniform(-3.0, 3.0, q.shape)
        solutions, counts, _ = solver.many(poses, nears)
        for row, number, given, near in zip(poses.tolist(), counts.tolist(), solutions, nears.tolist(), strict=True):
            pose = Pose(tuple(row[:3]), tuple(row[3:]))
            _count(result, model, pose, inverse.solve(pose, near).solutions, given[: max(number, 0)])
    return result


def _count(
    result: Comparison, model: ArmModel, pose: Pose, wanted: Sequence[Solution], given: npt.NDArray[np.void]
) -> None:
    result.poses += 1
    result.solutions += len(wanted)
    result.singular += any(solution.singularity for solution in wanted)
    result.unreachable += not wanted
    # The slow types only where the numbers are not plainly equal.
    is_same = len(wanted) == len(given)
    if is_same and wanted:
        bits = [
            (BITS[solution.branch], solution.singularity.value, sum(1 << joint for joint in solution.outside))
            for solution in wanted
        ]
        is_same = bits == given[["branch", "singularity", "outside"]].tolist()
        outside = given["outside"][:, None] >> np.arange(6) & 1
        is_same &= bool((given["q"] > np.where(outside, -pi, -inf)).all())
        difference = np.abs((given["q"] - [solution.q for solution in wanted] + pi) % (2 * pi) - pi).max(axis=1)
        result.worst = max(result.worst, float(difference.max()))
        for number in np.flatnonzero(difference > SAME):
            here = forward(model, given["q"][number].tolist())
            is_same &= max(abs(a - b) for a, b in zip((*pose[0], *pose[1]), (*here[0], *here[1]), strict=True)) < SAME
    if not is_same:
        result.different += 1
        result.first = result.first or f"{pose}: {wanted} and {given}"


BITS = {branch: bits for bits, branch in enumerate(BRANCHES)}
