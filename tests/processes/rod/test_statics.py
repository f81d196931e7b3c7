"""Equilibria of the rod against finite differences, Euler's load, collocation, and PyElastica."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from scipy.integrate import trapezoid

from kinematics.pose import IDENTITY, Pose, rotation_from_rpy
from rtcp.ipc.errors import Refused
from rtcp.processes.rod import Form, Rod, integrate, sample_equilibrium, shoot
from rtcp.processes.rod.statics import pose_error
from tests.processes.rod.collocation import solve_boundary_values

ROD = Rod(0.3, 1e-3)
A = np.array([0.2, 0.3, 3.0, -38.0, 0.0, 0.0])
THICK = Rod(0.3, 3e-3)
EULER = 4.0 * pi**2


def differences(rod: Rod, a: np.ndarray, steps: int, **loads: object) -> np.ndarray:
    at, columns = integrate(rod, a, steps=steps, **loads), []  # type: ignore[arg-type]
    for i in range(6):
        change = 1e-5 * np.eye(6)[i]
        ends = [integrate(rod, a + sign * change, steps=steps, **loads).end for sign in (1.0, -1.0)]  # type: ignore[arg-type]
        columns.append((pose_error(at, ends[0]) - pose_error(at, ends[1])) / 2e-5)
    return np.array(columns).T


def test_the_jacobian_is_that_of_differences() -> None:
    bent = integrate(ROD, A, steps=480)
    assert np.abs(bent.jacobian[-1] - differences(ROD, A, 480)).max() < 3.1e-10


def test_the_jacobian_holds_on_the_plateau_with_weight_and_with_a_set_shape() -> None:
    shape = np.outer(np.linspace(0.0, 1.0, 481), [1.0, -3.0, 4.0])
    weight = (0.3, -0.2, -THICK.weight)
    a = np.array([0.5, 1.0, 4.0, -5.0, 3.0, 2.0])
    bent = integrate(THICK, a, shape, weight, 480)
    assert not bent.is_linear
    assert np.abs(bent.jacobian[-1] - differences(THICK, a, 480, set_shape=shape, weight=weight)).max() < 1e-6


@pytest.mark.parametrize(("share", "is_stable"), [(0.999, True), (1.001, False)])
def test_a_slightly_bent_rod_is_stable_up_to_the_load_of_euler(share: float, is_stable: bool) -> None:
    assert integrate(ROD, [0.0, 0.0, 0.01, -share * EULER, 0.0, 0.0]).is_stable is is_stable


def test_the_conjugate_point_moves_to_the_length_at_which_the_load_is_that_of_euler() -> None:
    bent = integrate(ROD, [0.0, 0.0, 1e-3, -1.44 * EULER, 0.0, 0.0])
    assert bent.conjugate_point == pytest.approx(0.3 / 1.2, rel=2e-3)


def test_the_straight_rod_is_singular() -> None:
    assert not integrate(ROD, np.zeros(6)).is_stable


def test_a_pure_moment_bends_an_arc() -> None:
    bent = integrate(ROD, [0.0, 0.0, 1.5, 0.0, 0.0, 0.0])
    assert bent.end.position == pytest.approx((0.2 * np.sin(1.5), 0.2 * (1.0 - np.cos(1.5)), 0.0), abs=1e-8)
    assert bent.largest_strain == pytest.approx(0.5e-3 * 5.0)
    assert bent.is_stable


@pytest.mark.parametrize("rod", [ROD, THICK], ids=["linear", "on the plateau"])
def test_shooting_equals_collocation(rod: Rod) -> None:
    a = A if rod is ROD else np.array([0.1, 0.2, 1.2, 3.0, 1.0, 0.5])
    start = integrate(rod, a, steps=240)
    x, y, z = start.end.position
    end = Pose((x - 0.002, y + 0.004, z + 0.003), start.end.rotation)
    bent = shoot(rod, end, start)
    assert bent.is_linear is (rod is ROD)
    assert np.abs(pose_error(bent, end)).max() < 1e-10
    assert solve_boundary_values(rod, end, start, 1e-7) == pytest.approx(bent.a, abs=2e-6)


def test_shooting_and_collocation_agree_with_weight_and_a_set_shape() -> None:
    shape = np.outer(np.ones(241), [0.0, 1.0, 3.0])
    start = integrate(ROD, [0.2, 0.5, 1.5, -6.0, 2.0, 1.0], shape, (0.0, 0.0, -ROD.weight), 240)
    x, y, z = start.end.position
    end = Pose((x, y + 0.005, z), start.end.rotation)
    assert solve_boundary_values(ROD, end, start, 1e-7) == pytest.approx(shoot(ROD, end, start).a, abs=2e-6)


@pytest.mark.parametrize("seed", range(10))
def test_of_random_stable_rods_moment_and_force_balance_along_the_rod(seed: int) -> None:
    drawn = sample_equilibrium(ROD, list(Form)[seed % 3], np.random.default_rng(seed))
    force = np.einsum("nij,nj->ni", drawn.rotations, drawn.f)
    moment = np.einsum("nij,nj->ni", drawn.rotations, drawn.m) + np.cross(drawn.p, force)
    scale = ROD.bending_stiffness / ROD.length
    assert np.abs(force - force[0]).max() < 1e-4 * scale / ROD.length
    assert np.abs(moment - moment[0]).max() < 1e-4 * scale
    assert np.linalg.norm(np.diff(drawn.p, axis=0), axis=1).sum() == pytest.approx(ROD.length, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_of_random_stable_rods_the_other_end_sees_the_same_rod(seed: int) -> None:
    drawn = sample_equilibrium(ROD, Form.OUT_OF_PLANE, np.random.default_rng(seed))
    half_turn = np.diag([-1.0, -1.0, 1.0])
    scale = ROD.length / ROD.bending_stiffness
    mirrored = np.concatenate([half_turn @ drawn.m[-1] * -scale, half_turn @ drawn.f[-1] * -scale * ROD.length])
    reversed_rod = integrate(ROD, mirrored)
    assert reversed_rod.is_stable
    assert np.linalg.norm(reversed_rod.p[-1]) == pytest.approx(np.linalg.norm(drawn.p[-1]), abs=1e-6)


def test_the_moment_law_is_linear_to_the_plateau_and_monotone_to_the_hard_limit() -> None:
    kappas = np.linspace(0.0, 2.0 * THICK.hard_strain / THICK.diameter, 400)
    moments = np.array([THICK.moment(kappa) for kappa in kappas])
    linear = kappas * 0.5 * THICK.diameter <= 460.0 / 62_900.0
    assert moments[linear] == pytest.approx(THICK.bending_stiffness * kappas[linear])
    assert np.all(np.diff(moments) > 0.0)
    assert [THICK.curvature(moment)[0] for moment in moments] == pytest.approx(kappas, rel=1e-10)


def test_the_moment_law_is_the_section_integral_of_the_stress() -> None:
    kappa, radius = 40.0, 0.5 * THICK.diameter
    y = np.linspace(0.0, radius, 20_001)
    strains, stresses = [0.0, 460 / 62_900, 460 / 62_900 + 0.046, 0.1], [0.0, 460e6, 500e6, 0.0]
    stresses[3] = 500e6 + 27.8e9 * (strains[3] - strains[2])
    integrand = 4.0 * y * np.interp(kappa * y, strains, stresses) * np.sqrt(radius**2 - y * y)
    assert kappa * radius > strains[2]
    assert THICK.moment(kappa) == pytest.approx(float(trapezoid(integrand, y)), rel=1e-5)


def test_the_rod_of_a_millimetre_sags_by_its_weight_as_a_clamped_beam() -> None:
    start = integrate(ROD, [0.0, 0.0, 0.01, 0.0, 0.0, 0.0], weight=(0.0, 0.0, -ROD.weight))
    w, scale = ROD.weight, ROD.length**2 / ROD.bending_stiffness
    a = [0.0, -w * ROD.length**2 / 12.0 * scale / ROD.length, 0.0, 0.0, 0.0, w * ROD.length / 2.0 * scale]
    sag = integrate(ROD, a, weight=tuple(start.weight))
    assert sag.p[30, 2] == pytest.approx(-w * ROD.length**4 / (384.0 * ROD.bending_stiffness), rel=1e-2)


def test_an_end_pose_that_no_rod_has_is_refused() -> None:
    with pytest.raises(Refused) as refused:
        shoot(ROD, Pose((0.31, 0.0, 0.0), IDENTITY.rotation), integrate(ROD, [0.0, 0.0, 0.5, 0.0, 0.0, 0.0]))
    assert refused.value.reason == "rod_no_equilibrium"
    with pytest.raises(Refused):
        solve_boundary_values(
            ROD, Pose((0.4, 0.0, 0.0), rotation_from_rpy(0.0, 0.0, 2.0)), integrate(ROD, [0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
        )
