"""Cart-pole and acrobot: the flows of their H against accelerations written from Newton's laws."""

# pyright: reportArgumentType=false

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hamkernel import systems

M, m, HALF, g = 0.7, 0.3, 0.6, 9.5
M1, M2, L1, C1, C2, I1, I2 = 1.3, 0.8, 1.2, 0.5, 0.4, 0.9, 0.3


def cart_pole(q, v, u):
    """Barto, Sutton & Anderson (1983), the angle counted from the upright and the other way."""
    angle, rate = np.pi - q[1], -v[1]
    force = (u + m * HALF * rate**2 * np.sin(angle)) / (M + m)
    turn = (g * np.sin(angle) - np.cos(angle) * force) / (
        HALF * (4 / 3 - m * np.cos(angle) ** 2 / (M + m))
    )
    return np.array([force - m * HALF * turn * np.cos(angle) / (M + m), -turn])


def acrobot(q, v, u):
    """Spong (1995): M(q) q̈ + h(q, q̇) + φ(q) = (0, u)."""
    swing = M2 * L1 * C2
    d22 = M2 * C2**2 + I2
    d12 = d22 + swing * np.cos(q[1])
    d11 = M1 * C1**2 + M2 * L1**2 + I1 + d22 + 2 * swing * np.cos(q[1])
    lower = M2 * C2 * g * np.sin(q[0] + q[1])
    upper = (M1 * C1 + M2 * L1) * g * np.sin(q[0]) + lower
    h1 = -swing * np.sin(q[1]) * (v[1] ** 2 + 2 * v[0] * v[1])
    h2 = swing * np.sin(q[1]) * v[0] ** 2
    return np.linalg.solve([[d11, d12], [d12, d22]], [-h1 - upper, u - h2 - lower])


CASES = {
    "cart-pole": (systems.CartPole((M, m), HALF, g), cart_pole),
    "acrobot": (systems.Acrobot((M1, M2), L1, (C1, C2), (I1, I2), g), acrobot),
}


@pytest.mark.parametrize("name", CASES)
def test_accelerations_are_those_of_newton(name):
    system, accelerations = CASES[name]
    driven = systems.Driven(system)

    @jax.jit
    def motion(x, u):
        """Velocities q̇(x), and d/dt of them along the flow."""
        return jax.jvp(lambda x: system(x)[:2], (x,), (driven(x, u),))

    rng = np.random.default_rng(0)
    for _ in range(4):
        x, u = 2 * rng.normal(size=4), rng.normal(size=1)
        v, a = motion(jnp.asarray(x), jnp.asarray(u))
        np.testing.assert_allclose(a, accelerations(x[:2], np.asarray(v), u[0]), rtol=1e-10)
    rest = np.zeros(4)
    assert float(system.hamiltonian(rest)) == 0.0
    np.testing.assert_allclose(driven(rest, np.array([2.0])), 2 * driven.input_matrix(rest)[:, 0])


def test_a_system_without_motors_asks_for_the_matrix():
    with pytest.raises(TypeError, match="where its motors act"):
        systems.Driven(systems.Pendulum())
    with pytest.raises(ValueError, match="masses"):
        systems.CartPole((1.0, -1.0))
