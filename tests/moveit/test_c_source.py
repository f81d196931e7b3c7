"""The exported C: plain C99 without dependencies, with the results of `kinematics`; refused for other models."""

from __future__ import annotations

import re
import shutil
import subprocess
import threading
from collections.abc import Callable
from dataclasses import replace
from math import inf, nan, pi
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from kinematics.c_source import c_name, numbers_digest, to_c
from kinematics.forward import forward, frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import Pose, Rotation
from kinematics.solution import Singularity
from rtcp.config import find_arm, load_kinematics
from tests.kinematics.arms import TOOL, assistive, count, irb120, ur5, with_general_rows, with_row, with_tool
from tests.moveit.solver import STRICT, CSolver, compare, needs_c, needs_cpp

Q = (0.5, 0.4, -0.9, 0.7, 0.8, -0.6)
ARMS: dict[str, Callable[[], ArmModel]] = {
    "assistive_arm": lambda: load_kinematics(find_arm("assistive_arm")),
    "abb_irb120": lambda: load_kinematics(find_arm("abb_irb120")),
    "with a tool": lambda: with_tool(irb120()),
    "with an oblique wrist": lambda: with_row(with_row(with_tool(assistive()), 4, alpha=-1.1), 5, alpha=0.9),
    "with every offset": lambda: with_row(
        with_row(with_row(irb120(), 1, a=0.05, d=0.03), 2, d=-0.02), 0, alpha=0.3, a=0.1
    ),
    "with turned joints": lambda: with_row(with_row(assistive(), 0, offset=0.4, a=0.05), 3, offset=-0.7),
    "with links of one length": lambda: with_row(assistive(), 2, a=0.55),
    "with a lower arm behind": lambda: with_row(assistive(), 2, a=-0.44),
    "with wide limits": lambda: replace(irb120(), limits=(JointLimit(-7.0, 6.5),) * 6),
    "with narrow limits": lambda: replace(assistive(), limits=(JointLimit(0.1, 0.9),) * 6),
}  # fmt: skip


@pytest.fixture(scope="module", params=ARMS)
def arm(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[ArmModel, CSolver]:
    model = ARMS[request.param]()
    return model, CSolver(model, tmp_path_factory.mktemp("arm"), *STRICT)


# -- the same as kinematics -----------------------------------------------------------------------------------------


@needs_c
def test_all_solutions_are_those_of_kinematics(arm: tuple[ArmModel, CSolver]) -> None:
    """Order, branch, limits and singularities are compared too; a million poses with RTCP_THOROUGH=1."""
    compared = compare(*arm, count(3_000, 1_000_000 // len(ARMS)))
    assert compared.different == 0, compared.first
    assert compared.worst < 1e-4  # at an edge of the workspace an angle has half the digits of the pose
    assert min(compared.singular, compared.unreachable) > 0


@needs_c
def test_frames_are_those_of_kinematics(arm: tuple[ArmModel, CSolver]) -> None:
    model, solver = arm
    for q in np.random.default_rng(2).uniform(-7, 7, (200, 6)).tolist():
        for actual, wanted in zip(
            [*solver.frames(q), solver.forward(q)], [*frames(model, q), forward(model, q)], strict=True
        ):
            assert np.hstack(actual) == pytest.approx(np.hstack(wanted), abs=1e-14)


@needs_c
def test_the_first_solution_is_the_nearest_of_kinematics(arm: tuple[ArmModel, CSolver]) -> None:
    model, solver = arm
    inverse, random = InverseKinematics(model), np.random.default_rng(3)
    lower, upper = np.array([(limit.lower, limit.upper) for limit in model.limits]).T
    none = 0
    for number in range(300):
        q = random.uniform(lower, upper) if number % 4 else random.uniform(-pi, pi, 6)
        seed = (q + random.uniform(-0.5, 0.5, 6) if number % 2 else random.uniform(-pi, pi, 6)).tolist()
        pose = forward(model, q.tolist())
        wanted, solutions = inverse.solve_near(pose, seed), solver.nearest(pose, seed)
        assert solutions is not None
        none += wanted.q is None
        if wanted.q is None:
            assert solutions == []
            continue
        moves = [
            max(abs(a - b) for a, b in zip(solution, seed, strict=True))
            for solution in (wanted.q, *(solution.q for solution in solutions))
        ]
        assert moves[0] == pytest.approx(moves[1], abs=1e-9)
        assert moves[1:] == sorted(moves[1:])
        # Several may be equally near, as where joint 4 of each has to turn by pi.
        assert any(solution.q == pytest.approx(wanted.q, abs=1e-9) for solution in solutions)
        for solution in solutions:
            assert all(low <= angle <= high for angle, low, high in zip(solution.q, lower, upper, strict=True))
    assert none > 0 or model.limits[0].upper > 3.0


@needs_c
def test_joint_6_at_its_limit_is_compensated_by_joint_4_on_the_wrist_singularity(tmp_path: Path) -> None:
    model = load_kinematics(find_arm("assistive_arm"))
    solver, inverse = CSolver(model, tmp_path), InverseKinematics(model)
    q = (0.3, 0.5, -0.8, 0.4, 0.0, 2.9)
    for excess in (0.5, 0.8):
        pose = forward(model, (*q[:5], q[5] + excess))
        wanted, solutions = inverse.solve_near(pose, q), solver.nearest(pose, q)
        assert solutions
        assert wanted.q is not None
        assert solutions[0].q == pytest.approx(wanted.q, abs=1e-9)
        assert solutions[0].q[5] == model.limits[5].upper
        assert Singularity.WRIST in solutions[0].singularity


@needs_c
def test_a_free_joint_stays_at_the_seed_or_at_the_limit_nearest_to_it(tmp_path: Path) -> None:
    model = assistive()
    solver, inverse = CSolver(model, tmp_path), InverseKinematics(model)
    pose = forward(model, (0.3, 0.5, -0.8, 0.4, 0.0, 0.2))
    for seed4 in (0.1, 2.0, 4.0, -5.0):
        seed = (0.3, 0.5, -0.8, seed4, 0.0, 0.6 - min(max(seed4, -3.1), 3.1))
        wanted, solutions = inverse.solve_near(pose, seed), solver.nearest(pose, seed)
        assert solutions
        assert wanted.q is not None
        assert solutions[0].q == pytest.approx(wanted.q, abs=1e-9)


# -- arguments ------------------------------------------------------------------------------------------------------


@needs_c
def test_without_a_neighbour_a_free_joint_stays_at_zero(tmp_path: Path) -> None:
    model = irb120()
    pose = forward(model, (0.2, 0.3, 0.1, 0.0, 0.0, 0.4))
    assert CSolver(model, tmp_path).solve(pose) == CSolver(model, tmp_path).solve(pose, [0.0] * 6)


@needs_c
@pytest.mark.parametrize("value", [nan, inf, -inf])
def test_a_value_that_is_not_finite_is_invalid(tmp_path: Path, value: float) -> None:
    solver, pose = CSolver(irb120(), tmp_path), forward(irb120(), Q)
    position, rotation = (value, *pose.position[1:]), (value, *pose.rotation[1:])
    for wrong in (Pose(position, pose.rotation), Pose(pose.position, rotation)):
        assert solver.solve(wrong) is None
        assert solver.nearest(wrong, Q) is None
    assert solver.solve(pose, (*Q[:5], value)) is None
    assert solver.nearest(pose, (value, *Q[1:])) is None


@needs_c
def test_a_matrix_that_is_no_rotation_is_invalid(tmp_path: Path) -> None:
    solver, pose = CSolver(irb120(), tmp_path), forward(irb120(), Q)
    for factor in (1.01, -1.0, 0.0):
        wrong = Pose(pose.position, cast(Rotation, tuple(factor * value for value in pose.rotation)))
        assert solver.solve(wrong) is None
        assert solver.nearest(wrong, Q) is None


@needs_c
def test_threads_that_solve_at_once_get_their_own_solutions(tmp_path: Path) -> None:
    model = irb120()
    solver = CSolver(model, tmp_path)
    poses = np.random.default_rng(5).uniform(-1.5, 1.5, (4, 2_000, 6))
    given = [np.array([np.hstack(forward(model, q)) for q in part.tolist()]) for part in poses]
    alone = [solver.many(pose, q) for pose, q in zip(given, poses, strict=True)]
    together: dict[int, tuple[bytes, bytes]] = {}

    def solve(number: int) -> None:
        for _ in range(20):  # ctypes releases the lock of the interpreter during each call
            solutions, counts, _ = solver.many(given[number], poses[number])
            together[number] = solutions.tobytes(), counts.tobytes()

    threads = [threading.Thread(target=solve, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [together[number] for number in range(4)] == [(share[0].tobytes(), share[1].tobytes()) for share in alone]


# -- the file -------------------------------------------------------------------------------------------------------


@needs_c
def test_names_limits_and_digest_are_in_the_library(tmp_path: Path) -> None:
    model = replace(irb120(), name='arm "1" \\ä??/', joint_names=("q/1", "b", "c", "d", "e", 'f"'))
    model = replace(model, limits=(JointLimit(-1.0, 1.0, inf), *model.limits[1:]))
    solver = CSolver(model, tmp_path, *STRICT)
    assert solver.prefix == "arm_1"
    assert solver.text("name") == model.name
    assert solver.text("version") == "1"
    assert solver.text("digest") == numbers_digest(model)
    assert solver.joint_names() == list(model.joint_names)
    for name in ("lower", "upper", "velocity"):
        assert solver.numbers(name) == [getattr(limit, name) for limit in model.limits]


def test_the_digest_changes_with_every_number() -> None:
    model = irb120()
    changed = [
        *(with_row(model, row, **{name: 0.123}) for row in range(6) for name in ("alpha", "a", "d", "offset")),
        replace(model, tool=TOOL),
        replace(model, joint_names=("a", "b", "c", "d", "e", "f")),
        replace(model, limits=(*model.limits[:5], JointLimit(-1.0, 1.0))),
    ]
    assert len({numbers_digest(variant) for variant in [model, *changed]}) == len(changed) + 1
    assert numbers_digest(irb120()) == numbers_digest(model)


@needs_c
def test_the_library_has_constant_data_allocates_nothing_and_exports_only_its_own_names(tmp_path: Path) -> None:
    if shutil.which("nm") is None:
        pytest.skip("there is no nm on this machine")
    source = to_c(irb120())
    for name, text in source.files.items():
        (tmp_path / name).write_text(text)
    subprocess.run(["cc", *STRICT, "-O2", "-c", "irb120_kinematics.c", "-o", "solver.o"], check=True, cwd=tmp_path)
    listed = subprocess.run(["nm", "solver.o"], check=True, cwd=tmp_path, capture_output=True, text=True).stdout
    symbols = [line.split()[-2:] for line in listed.splitlines()]
    assert not [name for kind, name in symbols if kind in "bBdDC" and name != "irb120_joint_names"]
    needed = {name for kind, name in symbols if kind == "U"}
    assert needed <= {"sin", "cos", "sincos", "atan2", "sqrt", "ceil", "remainder", "memcpy", "memmove", "memset",
                      "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}  # fmt: skip
    assert all(name.startswith("irb120_") for kind, name in symbols if kind.isupper() and kind != "U")


def test_nothing_of_the_template_is_left() -> None:
    source = to_c(irb120())
    for text in source.files.values():
        assert not re.search(r"\b(arm|ARM)_\w|numbers \*/", text)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("abb-irb120", "abb_irb120"), ("Arm 7", "arm_7"), ("7", "arm_7"), ("__x__y", "x_y"), ("ä", "arm")],
)
def test_a_name_becomes_one_that_c_and_ros_allow(name: str, expected: str) -> None:
    assert c_name(name) == expected


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (ur5(), "ur5 has no spherical wrist"),
        (with_general_rows(assistive()), "assistive has no spherical wrist"),
        (with_row(irb120(), 2, alpha=0.3), r"axes 2 and 3 of irb120 are not parallel \(alpha of row 3 is 0.3 rad\)"),
        (with_row(irb120(), 1, alpha=0.0), "joints 1 to 3 of irb120 do not move"),
    ],
)
def test_an_arm_that_is_not_covered_is_refused_with_the_reason(model: ArmModel, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        to_c(model)


# -- the example of the documentation -------------------------------------------------------------------------------


@needs_cpp
@pytest.mark.parametrize(("language", "compiler"), [("c", ("cc", "-std=c99")), ("cpp", ("c++", "-std=c++17"))])
def test_the_example_of_the_documentation_runs(tmp_path: Path, language: str, compiler: tuple[str, ...]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "moveit.md").read_text()
    program, expected = re.search(rf"```{language}\n(.*?)```.*?```text\n(.*?)```", page, re.DOTALL).groups()
    model = load_kinematics(find_arm("abb_irb120"))
    for name, text in to_c(model).files.items():
        (tmp_path / name).write_text(text)
    (tmp_path / f"example.{language}").write_text(program)
    subprocess.run(["cc", "-O2", "-c", "abb_irb120_kinematics.c"], check=True, cwd=tmp_path)
    command = [*compiler, "-Wall", "-Werror", f"example.{language}", "abb_irb120_kinematics.o", "-lm", "-o", "example"]
    subprocess.run(command, check=True, cwd=tmp_path)
    done = subprocess.run(["./example"], check=True, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == expected
