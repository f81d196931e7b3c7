"""PyElastica, which integrates a damped dynamic rod until it rests, as a third oracle of the static shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rtcp.processes.rod import Rod, integrate

ea = pytest.importorskip("elastica", reason="PyElastica is not installed: pip install 'rtcp[oracles]'")

LENGTH, DIAMETER, ELEMENTS, REST_S = 1.0, 0.05, 40, 16.0
MODULUS, RATIO, DENSITY = 1e6, 0.33, 1000.0


@pytest.mark.long("test_shooting_equals_collocation")
def test_a_clamped_rod_under_an_end_force_has_the_shape_that_pyelastica_comes_to_rest_in() -> None:
    rod = Rod(LENGTH, DIAMETER, MODULUS, RATIO, DENSITY, plateau_stress=MODULUS, plateau_end_stress=1.1 * MODULUS)
    force = np.array([0.0, 1.5, 1.0]) * rod.bending_stiffness / LENGTH**2

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping):  # type: ignore[misc, name-defined]
        pass

    simulator = Simulator()
    filament = ea.CosseratRod.straight_rod(
        ELEMENTS, np.zeros(3), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), LENGTH, 0.5 * DIAMETER, DENSITY,
        youngs_modulus=MODULUS, shear_modulus=MODULUS / (2.0 * (1.0 + RATIO)),
    )  # fmt: skip
    simulator.append(filament)
    simulator.constrain(filament).using(ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
    simulator.add_forcing_to(filament).using(ea.EndpointForces, np.zeros(3), force, ramp_up_time=0.5)
    step = 0.1 * LENGTH / ELEMENTS / np.sqrt(MODULUS / DENSITY)
    simulator.dampen(filament).using(ea.AnalyticalLinearDamper, uniform_damping_constant=1.5, time_step=step)
    simulator.finalize()
    ea.integrate(ea.PositionVerlet(), simulator, REST_S, round(REST_S / step), progress_bar=False)

    # Its first element is the clamp and bends from its middle; the moment at our start follows from the shape.
    half = 0.5 * LENGTH / ELEMENTS
    free = replace(rod, length=LENGTH - half)
    scale, a = free.length / free.bending_stiffness, np.zeros(6)
    for _ in range(80):
        shape = integrate(free, a, steps=2 * ELEMENTS - 1)
        a = 0.5 * (a + scale * np.concatenate([np.cross(shape.p[-1], force), force * free.length]))
    points = filament.position_collection.T[1:]
    assert np.abs(filament.velocity_collection).max() < 1e-4
    # PyElastica's rod also shears and stretches, by some (d / 4 L)^2 of its length.
    assert np.abs(points - shape.p[1::2] - [half, 0.0, 0.0]).max() < 1e-3 * LENGTH
    assert np.abs(points[-1] - [LENGTH, 0.0, 0.0]).max() > 0.3 * LENGTH
