"""Learned fields: derivatives at the data, potentials, parts, and the flow they generate."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import BY_NAME, canonical

import hamkernel as hk

ROUNDING = 1e-10  # a field is a sum of some dozen terms of order one


def states(N=6, n=2, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(N, n)))


def pendulum(x):
    return jnp.stack([x[1], -jnp.sin(x[0])])


@functools.cache
def fitted(structure, kernel="gaussian", n=2, ridge=1e-3):
    X = states(n=n)
    Y = jnp.tanh(X[:, ::-1]) + 0.1 * states(n=n, seed=1)
    return hk.fit(structure(BY_NAME[kernel].make(n)), X, Y, ridge)


# Derivatives.


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "kernel", ["gaussian", "gaussian_ard", "matern2.5", "matern4.5", "periodic", "partial"]
)
@pytest.mark.parametrize("structure", [hk.Symplectic, hk.DivergenceFree])
def test_the_jacobian_at_data_points_is_that_of_differences(structure, kernel):
    field = fitted(structure, kernel)
    jacobian = jax.jit(jax.vmap(jax.jacfwd(field)))(field.points)
    values, step = jax.jit(jax.vmap(field)), 1e-6
    columns = [
        (values(field.points + step * e[None]) - values(field.points - step * e[None])) / (2 * step)
        for e in jnp.eye(2)
    ]
    # Linear in the step for Matérn-5/2, times coefficients of order 10; else 1e-16 / step.
    np.testing.assert_allclose(jacobian, jnp.stack(columns, axis=-1), atol=1e-4)


def test_a_field_of_matern_three_halves_is_finite_at_data_points():
    field = fitted(hk.Symplectic, "matern1.5")
    near = jax.vmap(field)(field.points + 1e-9)
    np.testing.assert_allclose(jax.vmap(field)(field.points), near, atol=1e-6)


# Transformations.


def test_a_field_is_a_function_for_jit_vmap_grad_and_map():
    field = fitted(hk.Symplectic)
    X = states(4, seed=2)
    expected = jnp.stack([field(x) for x in X])
    for values in (
        jax.jit(jax.vmap(field))(X),
        jax.vmap(jax.jit(field))(X),
        jax.lax.map(field, X),
        eqx.filter_jit(lambda field, X: jax.vmap(field)(X))(field, X),
        jax.jit(lambda field, X: jax.vmap(jax.jit(field))(X))(field, X),
        jax.vmap(jax.checkpoint(field))(X),
    ):
        np.testing.assert_allclose(values, expected, atol=ROUNDING)


def test_two_fields_of_one_shape_are_not_taken_for_each_other():
    field = fitted(hk.Symplectic)
    other = eqx.tree_at(lambda f: f.coefficients, field, -field.coefficients)
    x = states(1)[0]
    np.testing.assert_allclose(jax.jit(field)(x), -jax.jit(other)(x), atol=ROUNDING)
    assert field == field
    assert field != other


def test_a_potential_is_a_pytree_whose_arrays_are_no_constants_of_a_program():
    field = fitted(hk.Symplectic)

    @eqx.debug.assert_max_traces(max_traces=1)
    def energy(H, x):
        return H(x)

    compiled, x = eqx.filter_jit(energy), states(1)[0]
    for scale in (1.0, 2.0, 3.0):
        scaled = eqx.tree_at(lambda f: f.coefficients, field, scale * field.coefficients)
        expected = scale * field.hamiltonian(x)
        np.testing.assert_allclose(compiled(scaled.hamiltonian, x), expected, atol=ROUNDING)


def test_potentials_work_where_the_field_is_traced():
    field, X = fitted(hk.Symplectic), states(4, seed=2)
    expected = jnp.stack([field.hamiltonian(x) for x in X])
    np.testing.assert_allclose(jax.jit(jax.vmap(field.hamiltonian))(X), expected, atol=ROUNDING)

    @jax.jit
    def energies(field, X):
        return jax.vmap(field.hamiltonian)(X)

    np.testing.assert_allclose(energies(field, X), expected, atol=ROUNDING)

    def fit_and_ask(Y):
        return hk.fit(field.kernel, field.points, Y, field.regularization).hamiltonian(X[0])

    Y = jax.vmap(field)(field.points) + field.residual
    np.testing.assert_allclose(jax.jit(fit_and_ask)(Y), expected[0], atol=ROUNDING)
    assert jnp.isfinite(jax.jit(jax.grad(fit_and_ask))(Y)).all()


# Potentials.


def test_anchoring_sets_the_constant_and_nothing_else():
    field, x, x0 = fitted(hk.Symplectic), states(1, seed=3)[0], jnp.array([0.1, 0.2])
    anchored = field.anchored(x0, 3.0)
    np.testing.assert_allclose(anchored.hamiltonian(x0), 3.0, rtol=ROUNDING)
    np.testing.assert_allclose(
        anchored.hamiltonian(x) - anchored.hamiltonian(x0),
        field.hamiltonian(x) - field.hamiltonian(x0),
        atol=ROUNDING,
    )
    np.testing.assert_array_equal(anchored(x), field(x))
    np.testing.assert_allclose(anchored.anchored(x0).hamiltonian(x0), 0.0, atol=ROUNDING)
    np.testing.assert_allclose(field.anchored([0, 1], 2).potential(jnp.array([0.0, 1.0])), 2.0)  # pyright: ignore


def test_the_potential_of_a_curl_free_field_is_no_hamiltonian():
    field = fitted(hk.CurlFree)
    x = states(1)[0]
    np.testing.assert_allclose(jax.grad(field.potential)(x), field(x), atol=ROUNDING)
    with pytest.raises(AttributeError, match=r"CurlFree is not Hamiltonian.*field\.potential\(x\)"):
        _ = field.hamiltonian


def curl_free_plus_separable(k):
    return hk.CurlFree(k) + hk.Separable(k)


def symplectic_plus_separable(k):
    return hk.Symplectic(k) + hk.Separable(k)


@pytest.mark.parametrize(
    ("structure", "reason"),
    [
        (hk.Separable, "components are independent"),
        (hk.DivergenceFree, r"matrix potential.*stream function"),
        (curl_free_plus_separable, r"CurlFree \+ Separable has no single potential.*part\(0\)"),
    ],
)
def test_a_field_without_a_potential_says_why(structure, reason):
    field = fitted(structure)
    with pytest.raises(AttributeError, match=reason):
        _ = field.potential
    with pytest.raises(AttributeError, match=reason):
        field.anchored(jnp.zeros(2))
    assert not hasattr(field, "hamiltonian")
    assert hasattr(fitted(hk.Symplectic), "hamiltonian")


def test_the_hamiltonian_of_a_sum_is_asked_of_its_part():
    field = fitted(symplectic_plus_separable)
    with pytest.raises(AttributeError, match=r"such as field\.part\(0\)\.hamiltonian\(x\)"):
        _ = field.hamiltonian
    part, x = field.part(0), states(1)[0]
    slope = jax.grad(part.hamiltonian)(x)
    np.testing.assert_allclose(part(x), canonical(2) @ slope, atol=ROUNDING)


def test_named_sums_of_one_structure_have_a_hamiltonian_as_a_whole():
    first, second, third = (hk.Symplectic(hk.Gaussian(ell)) for ell in (0.7, 1.5, 3.0))
    X = np.random.default_rng(0).normal(size=(12, 2))
    nested: Any = hk.fit(hk.Sum(a=first + second, b=third), X, X[:, ::-1], 1e-3)
    flat: Any = hk.fit(first + second + third, X, X[:, ::-1], 1e-3)
    np.testing.assert_allclose(nested.hamiltonian(X[0]), flat.hamiltonian(X[0]), rtol=1e-9)
    mixed: Any = hk.fit(hk.Sum(a=first + hk.CurlFree(hk.Gaussian()), b=third), X, X, 1e-3)
    with pytest.raises(AttributeError, match=r"Symplectic \+ CurlFree \+ Symplectic"):
        _ = mixed.potential


@pytest.mark.parametrize(("x0", "value"), [([np.nan, 0.0], 0.0), ([0.0, 0.0], np.inf)])
def test_an_anchor_that_is_not_finite_is_refused(x0, value):
    with pytest.raises(ValueError, match="x0, value and the field must be finite"):
        fitted(hk.Symplectic).anchored(np.array(x0), value)


# What they print.


def test_kernels_and_fields_print_the_values_of_their_hyperparameters():
    K = hk.CurlFree(2.0 * hk.Gaussian(jnp.array([0.5, 3.28333333])))
    assert repr(K) == "CurlFree(2 * Gaussian(lengthscale=[0.5, 3.283]))"
    text = repr(fitted(hk.Symplectic))
    assert text.startswith("KernelField of 2 coordinates\nkernel    Symplectic(")
    assert "lambda    0.001\nsolver    Cholesky, relative residual" in text
    assert "lengthscale=" in text
    # Nothing has a value while it is traced.
    traced = []
    jax.eval_shape(lambda K: traced.append(repr(K)), K)
    assert "log_lengthscale=f64[2]" in traced[0]
    jax.eval_shape(lambda field: traced.append(repr(field)) or field, fitted(hk.Symplectic))
    assert traced[1].startswith("KernelField: no numbers yet")
    assert "<th" in fitted(hk.Symplectic)._repr_html_()


def quadratic(x, z):
    return (1 + x @ z) ** 2


class Mine(eqx.Module):
    log_width: jax.Array

    def __call__(self, x, z):
        return jnp.exp(-((x - z) @ (x - z)) / jnp.exp(self.log_width))


G, M = hk.Gaussian(2.0), hk.Matern(2.5, 0.5)


@pytest.mark.parametrize(
    ("K", "text"),
    [
        (hk.Odd(hk.Symplectic(G)), "Odd(Symplectic(Gaussian(lengthscale=2)))"),
        (hk.Even(hk.Separable(3.0 * G)), "Even(Separable(3 * Gaussian(lengthscale=2)))"),
        (
            hk.CurlFree((G + quadratic) * hk.Select(quadratic, (0, 1))),
            "CurlFree((Gaussian(lengthscale=2) + quadratic) * Select(quadratic, dims=(0, 1)))",
        ),
        (
            hk.Sum(hk.Symplectic(G), rest=hk.Odd(hk.CurlFree(quadratic))),
            "Sum(Symplectic(Gaussian(lengthscale=2)), rest=Odd(CurlFree(quadratic)))",
        ),
        (
            hk.Odd(hk.DivergenceFree(G)) + hk.CurlFree(quadratic),
            "Odd(DivergenceFree(Gaussian(lengthscale=2))) + CurlFree(quadratic)",
        ),
    ],
)
def test_a_kernel_prints_as_it_is_written(K, text):
    assert repr(K) == text
    again = eval(text, {**vars(hk), "quadratic": quadratic})
    x, z = np.random.default_rng(0).normal(size=(2, 2))
    np.testing.assert_allclose(again(x, z), K(x, z), rtol=1e-14)


def test_a_long_kernel_prints_over_several_lines_which_say_the_same():
    terms = hk.Symplectic(2.0 * (G + M + quadratic) * (M + G)) + hk.Odd(hk.CurlFree(G + M + G))
    text = repr(terms)
    assert max(map(len, text.splitlines())) <= 88
    again = eval(f"({text})", {**vars(hk), "quadratic": quadratic})
    x, z = np.random.default_rng(0).normal(size=(2, 2))
    np.testing.assert_allclose(again(x, z), terms(x, z), rtol=1e-14)


def power(x, z, degree):
    return (1 + x @ z) ** degree


@pytest.mark.parametrize(
    ("k", "text"),
    [
        (Mine(jnp.log(0.25)), "Mine(width=0.25)"),
        (functools.partial(power, degree=jnp.array(3.0)), "partial(power, degree=3)"),
    ],
)
def test_a_kernel_of_ones_own_prints_its_values(k, text):
    assert repr(hk.Symplectic(k)) == f"Symplectic({text})"
    named = []
    jax.eval_shape(lambda c: named.append(repr(hk.CurlFree(lambda x, z: c * k(x, z)))), 1.0)
    assert named == ["CurlFree(<lambda>)"]


def weighted(x, z, weights):
    return jnp.sum(weights) * (x @ z)


def test_many_observations_print_in_a_few_lines():
    one = np.ones((1, 2))
    parts = [hk.Velocities(one, i * one, noise=1.0) for i in range(20)]
    lines = repr(sum(parts[1:], start=parts[0])).splitlines()
    assert len(lines) == 3
    assert "… 18 more" in lines[1]


@pytest.mark.parametrize(
    ("weights", "text"),
    [
        (jnp.full(16, 0.5), "[" + ", ".join(16 * ["0.5"]) + "]"),
        (jnp.asarray(np.full(17, 0.5)), "f64[17]"),
        (np.full((2, 2), 0.5), "f64[2,2]"),
        ({"of q": jnp.array([2.0]), "of p": 1 / 3}, "{'of p': 0.3333, 'of q': [2]}"),
        ((1 / 3,), "(0.3333,)"),
        (jax.random.key(0), "key<fry>[]"),
    ],
    ids=["sixteen", "seventeen", "a matrix", "a dictionary", "a tuple", "a key"],
)
def test_few_numbers_print_as_values_and_many_by_their_shape(weights, text):
    K = repr(hk.Separable(functools.partial(weighted, weights=weights)))
    assert "".join(K.split()) == f"Separable(partial(weighted,weights={text}))".replace(" ", "")


# Points of the wrong kind.


@pytest.mark.parametrize("call", ["__call__", "hamiltonian", "potential", "anchored"])
def test_one_state_at_a_time(call):
    field = fitted(hk.Symplectic)
    function = getattr(field, call)
    with pytest.raises(ValueError, match=r"shape \(6, 2\); one state of shape \(2,\).*jax\.vmap"):
        function(states())
    with pytest.raises(ValueError, match=r"shape \(4,\); one state of shape \(2,\)"):
        function(jnp.zeros(4))
    with pytest.raises(TypeError, match="real numbers are needed"):
        function(np.zeros(2) * 1j)


def test_an_anchor_has_one_value():
    with pytest.raises(ValueError, match=r"value has shape \(2,\); one number"):
        fitted(hk.Symplectic).anchored(jnp.zeros(2), jnp.zeros(2))


def test_states_may_be_integers_lists_or_float32():
    field = fitted(hk.Symplectic)
    expected = field(jnp.array([1.0, 2.0]))
    for x in ([1, 2], np.array([1, 2]), np.array([1.0, 2.0], np.float32)):
        np.testing.assert_array_equal(field(x), expected)  # pyright: ignore[reportArgumentType]


# Separability.

Q = hk.Select(hk.Gaussian(), 0)
P = hk.Select(hk.Polynomial(2), 1)


THIRD = np.array([[-0.5, -(0.75**0.5)], [0.75**0.5, -0.5]])
SEPARABLE = [
    hk.Symplectic(Q + P),
    hk.Symplectic(2.0 * Q + 0.5 * P),
    hk.Odd(hk.Symplectic(Q + P)),
    hk.Odd(hk.Symplectic(Q * Q + P)),
    hk.Symplectic(Q) + hk.Symplectic(P),
]
NOT_SEPARABLE = [
    hk.Symplectic(Q * P),
    hk.Symplectic(Q + hk.Gaussian()),
    hk.Symplectic(Q * hk.Gaussian() + P),
    hk.Symplectic(lambda x, z: Q(x, z) + P(x, z)),  # true, but not known
    hk.CurlFree(Q + P),
    hk.Symplectic(Q) + hk.Separable(P),
    hk.Symplectic(hk.Invariant(Q + P, [THIRD])),  # a turn mixes q and p
]


def test_is_separable_follows_from_the_kernel():
    field = fitted(hk.Symplectic)

    def of(kernel):
        return eqx.tree_at(lambda f: f.kernel, field, kernel)

    assert not [kernel for kernel in map(of, NOT_SEPARABLE) if kernel.is_separable]
    assert all(of(kernel).is_separable for kernel in SEPARABLE)
    # ∂²H/∂q∂p = 0, which is the diagonal of Df for n = 2.
    Df = jax.jit(lambda x: [jnp.diag(jax.jacfwd(of(kernel))(x)) for kernel in SEPARABLE])
    np.testing.assert_allclose(Df(field.points[0]), 0.0, atol=ROUNDING)
    assert np.abs(jnp.diag(jax.jacfwd(of(NOT_SEPARABLE[0]))(field.points[0]))).max() > 1e-3


# The flow.

TOLERANCE = 1e-10


def flow(field):
    """x(0), time ↦ x(time) and its Jacobian."""

    def at(x0, time):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, x, args: field(x)),
            diffrax.Dopri8(),
            0.0,
            time,
            0.1,
            x0,
            stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            adjoint=diffrax.ForwardMode(),
        )
        assert solution.ys is not None
        return solution.ys[-1], solution.ys[-1]

    jacobian = jax.jit(jax.jacfwd(at, has_aux=True))
    return lambda x0, time: jacobian(x0, time)[::-1]


def henon_heiles(x):
    q1, q2, p1, p2 = x
    return jnp.stack([p1, p2, -q1 - 2 * q1 * q2, -q2 - q1**2 + q2**2])


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("system", "n"), [(pendulum, 2), (henon_heiles, 4)], ids=["pendulum", "henon_heiles"]
)
def test_the_learned_flow_is_symplectic_and_keeps_the_learned_energy(system, n):
    X, x0, J = 0.5 * states(30, n), 0.2 * jnp.ones(n), canonical(n)
    Y = jax.vmap(system)(X) + 0.02 * states(30, n, seed=1)

    def symplecticity_defect(Psi):
        Psi = np.asarray(Psi)
        return np.abs(Psi.T @ J @ Psi - J).max()

    field = hk.fit(hk.Symplectic(hk.Gaussian(1.5)), X, Y, 1e-3)
    learned = flow(field)
    ends, jacobians = zip(*(learned(x0, time) for time in (0.01, 1.0, 3.0)), strict=True)
    # Local errors of 1e-10 over some ten steps, amplified by the flow.
    assert symplecticity_defect(jacobians[-1]) < 1e-7
    energies = [field.hamiltonian(x) for x in ends]
    np.testing.assert_allclose(energies, field.hamiltonian(x0), atol=1e-7)
    assert np.abs(ends[1] - x0).max() > 0.1
    for structure in (hk.Separable, hk.CurlFree):
        wrong = hk.fit(structure(hk.Gaussian(1.5)), X, Y, 1e-3)
        assert symplecticity_defect(flow(wrong)(x0, 3.0)[1]) > 1e-3


def test_a_field_far_from_the_origin_is_the_same_field():
    K, X, far = hk.Symplectic(hk.Gaussian(1.0)), states(), 2.0**20
    near, moved = hk.fit(K, X, states(seed=1), 1e-2), hk.fit(K, X + far, states(seed=1), 1e-2)
    x = X[0] + 0.25
    np.testing.assert_allclose(moved(x + far), near(x), atol=1e-8)
    np.testing.assert_allclose(moved.hamiltonian(x + far), near.hamiltonian(x), atol=1e-8)


def test_a_field_of_matern_is_zero_where_the_distance_overflows():
    field = fitted(hk.Symplectic, "matern2.5")
    for x in (jnp.array([1e9, 0.0]), jnp.array([1e160, -1e160])):
        assert not field(x).any()
        assert not jax.jacfwd(field)(x).any()


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [None, hk.RandomFeatures(20, jax.random.key(0))], ids=str)
def test_a_part_has_its_own_norm_and_no_anchor(solver):
    X, K = states(12), hk.Symplectic(hk.Gaussian(1.0)) + hk.Symplectic(hk.Gaussian(2.0))
    field = hk.fit(K, X, states(12, seed=1), 1e-2, solver=solver).anchored(jnp.zeros(2), 5.0)
    parts = [field.part(0), field.part(1)]
    np.testing.assert_allclose(sum(part.norm**2 for part in parts), field.norm**2, rtol=1e-12)
    if isinstance(field, hk.KernelField):
        G = np.asarray(hk.gram(K.terms[0], X)).reshape(24, 24)
        a = np.asarray(field.coefficients).ravel()
        np.testing.assert_allclose(parts[0].norm ** 2, a @ G @ a, rtol=1e-10)
    x = X[0] + 0.25
    for part in parts:
        np.testing.assert_allclose(part.hamiltonian(x), part.unanchored_potential(x), rtol=1e-12)


def test_a_batch_of_fields_says_how_it_is_called():
    X, Y, x = states(), states(seed=1), jnp.ones(2)
    fields = jax.vmap(lambda ridge: hk.fit(hk.Symplectic(hk.Gaussian()), X, Y, ridge))(
        jnp.array([1e-1, 1e-2])
    )
    with pytest.raises(
        ValueError,
        match=r"a batch of 2 fields, and a method needs one: jax\.vmap\(lambda f: f\(x\)\)",
    ):
        fields(x)
    for ask in (lambda: fields.evaluate(X), lambda: fields.part(0), lambda: fields.anchored(x)):
        with pytest.raises(ValueError, match="a batch of 2 fields"):
            ask()
    velocities = jax.vmap(lambda field: field(x))(fields)
    alone = hk.fit(hk.Symplectic(hk.Gaussian()), X, Y, 1e-2)(x)
    np.testing.assert_allclose(velocities[1], alone, rtol=1e-10)
