"""The numbers of `benchmarks/dynamics.py`: its measures on true systems, its claims when slow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks import dynamics

SEEDS = 2


@pytest.mark.slow
def test_measures_find_no_error_in_the_true_system():
    system, H = dynamics.HENON_HEILES, dynamics.HENON_HEILES.hamiltonian
    points = dynamics.triangle()
    assert dynamics.hamiltonian_error(H, lambda x: H(x) + 5.0, points) < 1e-14  # but a constant
    # H is a cubic along the line from the origin, which the quadrature integrates exactly.
    assert dynamics.hamiltonian_error(dynamics.work(system), H, points) < 1e-13
    # A method of order 6 in steps of 0.05, a hundredth of a period.
    assert dynamics.energy_drift(system, system, dynamics.BOUNDED[None], 20.0)[0] < 1e-9
    states = dynamics.near_circular(np.random.default_rng(0), 10)
    bodies = dynamics.TWO_BODIES
    assert dynamics.energy_drift(bodies, bodies, states, 20.0).max() < 1e-7


@pytest.mark.slow
def test_measures_find_an_error_that_is_there():
    system, H = dynamics.HENON_HEILES, dynamics.HENON_HEILES.hamiltonian
    points = dynamics.triangle()
    error = dynamics.hamiltonian_error(lambda x: 1.1 * H(x), H, points)
    np.testing.assert_allclose(error, 0.1, rtol=1e-12)

    def rubbed(x):
        return system(x) - 0.01 * x

    def escaping(x):
        return x**3

    # Friction takes H to about H exp(-0.02 t), the cubic terms aside.
    drift = dynamics.energy_drift(rubbed, system, dynamics.BOUNDED[None], 20.0)[0]
    assert abs(drift - (1 - np.exp(-0.4))) < 0.05
    assert dynamics.energy_drift(escaping, system, 3 * dynamics.BOUNDED[None], 20.0)[0] == np.inf


def test_triangle_and_start_are_those_of_bounded_motion():
    H = np.asarray(jax.vmap(dynamics.HENON_HEILES.hamiltonian)(dynamics.triangle()))
    assert H.max() <= 1 / 6 + 1e-12
    assert len(H) > 500
    np.testing.assert_allclose(dynamics.HENON_HEILES.hamiltonian(dynamics.BOUNDED), 1 / 8)


def test_two_bodies_start_around_circular_orbits():
    states = dynamics.near_circular(np.random.default_rng(0), 200)
    q1, q2, p1, p2 = (np.asarray(part) for part in jnp.split(states, 4, axis=1))
    distance = np.linalg.norm(q2 - q1, axis=1)
    assert 0.8 < distance.min() < distance.max() < 1.2
    # The relative motion has the reduced mass 1/2 and G(m₁ + m₂) = 2: on a circle the energy is
    # −1/(2 distance), and so is that of the whole but for the slow centre.
    energy = np.asarray(jax.vmap(dynamics.TWO_BODIES.hamiltonian)(states))
    np.testing.assert_allclose(energy, -1 / (2 * distance), rtol=0.12)
    assert np.abs(p1 + p2).max() <= 0.01
    spin = np.cross(np.pad(q2 - q1, ((0, 0), (0, 1))), np.pad(p2 - p1, ((0, 0), (0, 1))))
    assert (spin[:, 2] > 0).all()


def runs(kernels, learn):
    return {name: [learn(K, seed) for seed in range(SEEDS)] for name, K in kernels.items()}


@pytest.mark.slow
def test_henon_heiles_from_100_velocities():
    found = runs(dynamics.HENON_HEILES_KERNELS, dynamics.henon_heiles)
    for plain, structured, exact in zip(*found.values(), strict=True):
        # 5e-4, 5e-5 to 2e-4, and 1e-11 were seen: the work along a line is no bad guess of H.
        assert structured.hamiltonian_error < 5e-4
        assert exact.hamiltonian_error < 1e-8  # H is in the space of the kernel
        # 2e-3, 3e-5 to 2e-4, and 1e-11.
        assert structured.drift < 5e-4
        assert plain.drift > 3 * structured.drift
        assert exact.drift < 1e-8
    # One of the seeds ends in the flat limit, in which the processor decides how good it is.
    assert np.median([one.drift for one in found["symplectic Gaussian"]]) < 2e-4


@pytest.mark.slow
def test_two_bodies_from_600_velocities():
    found = runs(dynamics.TWO_BODY_KERNELS, dynamics.two_bodies)
    for plain, structured, invariant in zip(*found.values(), strict=True):
        # 7e-3, 2e-3 to 4e-3, and 4e-5 to 9e-5 were seen.
        assert plain.field_error < 0.02
        assert structured.field_error < plain.field_error
        assert invariant.field_error < 5e-4
        # Medians of 5e-2, 3e-4 to 1e-3, and 1e-5. Single motions reach ten times as much.
        assert np.median(plain.drifts) > 0.01
        assert np.median(structured.drifts) < 5e-3
        assert np.median(invariant.drifts) < 1e-4
