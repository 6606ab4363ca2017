"""Kernels averaged over finite groups: invariant, reversible, odd and even fields."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportOptionalSubscript=false, reportOptionalMemberAccess=false
# pyright: reportOperatorIssue=false
# Wrong types are refused here, and any field is looked into.

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kernels import BY_NAME, canonical, difference_mixed

import hamkernel as hk
from hamkernel import load, save
from hamkernel._features import features as features_of
from hamkernel._kernels.symmetry import symmetry_removed

SYMMETRY = 1e-12
RNG = np.random.default_rng(0)
X, Y = RNG.normal(size=(2, 10, 4))
POINTS = jnp.asarray(RNG.normal(size=(4, 4)))


def block_diagonal(A):
    return np.block([[A, np.zeros((2, 2))], [np.zeros((2, 2)), A]])


def turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return block_diagonal(np.array([[c, -s], [s, c]]))


C3, MIRROR = turn(2 * np.pi / 3), block_diagonal(np.diag([-1.0, 1.0]))
REVERSAL = np.diag([1.0, 1.0, -1.0, -1.0])
TURN4 = turn(np.pi / 2)
BARE = BY_NAME["partial"].make(4)  # no invariance at all
ARD = hk.Gaussian(np.array([0.8, 1.0, 1.3, 1.7]))


def swap(x):
    return jnp.stack([x[1], x[0], x[3], x[2]])


# name: kernel, generators, maps with f(Sx) = S f(x), with f(Sx) = −S f(x), order, one-sided
G, M = hk.Gaussian(1.4), hk.Matern(3.5, 1.5)
GROUPS = {
    "C3": (G, [C3], [C3], [], 3, True),
    "C3v": (G + 2.0 * M, [C3, MIRROR], [C3, MIRROR], [], 6, True),
    "all 12": (G, [C3, MIRROR, REVERSAL], [C3, MIRROR], [REVERSAL], 12, True),
    "a function": (hk.Polynomial(3), [swap], [np.eye(4)[[1, 0, 3, 2]]], [], 2, True),
    "signs, a lengthscale each": (ARD, [REVERSAL], [], [REVERSAL], 2, True),
    "turn, a lengthscale each": (ARD, [TURN4], [TURN4], [], 4, False),
    "no invariance": (BARE, [MIRROR], [MIRROR], [], 2, False),
}
every_group = pytest.mark.parametrize("name", GROUPS)


def off(field, S, sign=1.0):
    """The largest |f(Sx) − sign S f(x)| beside the largest |f|."""
    here = np.asarray(jax.vmap(field)(POINTS))
    there = np.asarray(jax.vmap(field)(POINTS @ jnp.asarray(S).T))
    return np.abs(there - sign * here @ S.T).max() / np.abs(here).max()


@pytest.mark.few(1)
@every_group
def test_fields_have_the_symmetry_to_rounding_and_plain_ones_have_not(name):
    k, maps, same, reversed_, order, one_sided = GROUPS[name]
    invariant = hk.Invariant(k, maps)
    field = hk.fit(hk.Symplectic(invariant), X, Y, 1e-2)
    plain = hk.fit(hk.Symplectic(k), X, Y, 1e-2)
    for S, sign in [(S, 1.0) for S in same] + [(S, -1.0) for S in reversed_]:
        assert off(field, S, sign) < SYMMETRY
        assert off(plain, S, sign) > 1e-2
        H = jax.vmap(field.hamiltonian)
        np.testing.assert_allclose(H(POINTS @ jnp.asarray(S).T), H(POINTS), rtol=1e-10, atol=1e-12)
    found = symmetry_removed(invariant)
    assert len(found.group(4)) == order
    assert found.is_one_sided(4) is one_sided


@pytest.mark.few(3)
@every_group
def test_products_without_the_group_are_those_of_the_gram(name):
    k, maps, *_ = GROUPS[name]
    K = hk.Symplectic(hk.Invariant(k, maps))
    gram = hk.gram(K, X)
    np.testing.assert_allclose(
        hk.gram_operator(K, X).mv(Y), np.einsum("iajb,jb->ia", gram, Y), rtol=1e-11, atol=1e-12
    )
    matrix = np.asarray(gram).reshape(40, 40)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-14)
    assert np.linalg.eigvalsh(matrix).min() > -1e-12


@pytest.mark.few(1)
@pytest.mark.parametrize("structure", [hk.CurlFree, hk.PortHamiltonian, hk.Separable])
def test_other_structures_have_the_same_products(structure):
    K = structure(hk.Invariant(G, [C3, MIRROR]))
    expected = np.einsum("iajb,jb->ia", hk.gram(K, X), Y)
    np.testing.assert_allclose(hk.gram_operator(K, X).mv(Y), expected, rtol=1e-11, atol=1e-12)
    field = hk.fit(K, X, Y, 1e-2)
    if structure is hk.Separable:  # whose components are invariant one by one
        np.testing.assert_allclose(field(jnp.asarray(C3) @ POINTS[0]), field(POINTS[0]), atol=1e-12)
    else:
        assert off(field, C3) < SYMMETRY


@pytest.mark.parametrize("B", [hk.poisson.rigid_body, lambda x: hk.poisson.rigid_body(x**2)])
def test_products_are_those_of_the_gram_where_the_operator_is_odd_or_even(B):
    Z, A = np.random.default_rng(5).normal(size=(2, 7, 3))
    K = hk.Poisson(hk.Invariant(G, [-np.eye(3)]), B)
    expected = np.einsum("iajb,jb->ia", hk.gram(K, Z), A)
    np.testing.assert_allclose(hk.gram_operator(K, Z).mv(A), expected, rtol=1e-11, atol=1e-12)


def test_the_mean_is_over_both_arguments():
    k, maps = BY_NAME["partial"].formula(4), [np.eye(4), MIRROR]

    def mean(x, z):
        return sum(k(g @ x, h @ z) for g in maps for h in maps) / 4

    x, z = np.asarray(POINTS[:2])
    K = hk.CurlFree(hk.Invariant(BARE, [MIRROR]))
    np.testing.assert_allclose(K(x, z), difference_mixed(mean, x, z), atol=1e-8)


SHEAR = np.array([[1.0, 1.0], [0.0, -1.0]])  # its own inverse, and not orthogonal
ALONG = hk.Select(hk.Gaussian(1.4), 0)  # depends on what the shear mixes


@pytest.mark.parametrize(
    ("k", "maps"),
    [
        (hk.Gaussian(1.4), [SHEAR]),
        (ALONG, [SHEAR]),
        (hk.Gaussian(np.array([0.8, 1.7])), [np.diag([1.0, -1.0]), np.eye(2)[::-1]]),
    ],
    ids=["shear", "a part", "one side for one map only"],
)
def test_any_group_of_linear_maps_gives_a_symmetric_kernel_with_the_symmetry(k, maps):
    x, z = np.asarray(POINTS[0, :2]), np.asarray(POINTS[1, :2])
    mean = hk.Invariant(k, maps)
    here = mean(x, z)
    np.testing.assert_allclose(mean(z, x), here, rtol=SYMMETRY)
    for S in maps:
        np.testing.assert_allclose(mean(S @ x, z), here, rtol=SYMMETRY)
    assert abs(k(maps[0] @ x, z) - k(x, z)) > 1e-3


def test_odd_and_even_are_the_group_of_two():
    reflected = hk.Invariant(G, [-np.eye(4)])
    np.testing.assert_allclose(
        hk.gram(hk.Symplectic(reflected), X), hk.gram(hk.Odd(hk.Symplectic(G)), X), atol=1e-15
    )


@pytest.mark.slow
def test_reversible_and_odd_go_together_in_either_order():
    K = hk.Reversible(hk.Odd(hk.Symplectic(G)))
    other = hk.Odd(hk.Reversible(hk.Symplectic(G)))
    np.testing.assert_allclose(hk.gram(K, X), hk.gram(other, X), atol=1e-15)
    field = hk.fit(K, X, Y, 1e-2)
    assert off(field, REVERSAL, -1.0) < SYMMETRY
    assert off(field, -np.eye(4)) < SYMMETRY
    assert off(hk.fit(hk.Symplectic(G), X, Y, 1e-2), REVERSAL, -1.0) > 1e-2
    even = hk.fit(hk.Even(hk.Reversible(hk.Symplectic(G))), X, Y, 1e-2)
    assert off(even, -np.eye(4), -1.0) < SYMMETRY
    assert hk.Reversible(K) == K


def test_a_separable_hamiltonian_stays_one_when_it_is_made_reversible():
    k = hk.Select(G, (0, 1)) + hk.Select(hk.Polynomial(2), (2, 3))
    assert hk.fit(hk.Reversible(hk.Symplectic(k)), X, Y, 1e-2).is_separable
    alone = hk.fit(hk.Reversible(hk.Symplectic(G)), X, Y, 1e-2)
    assert not alone.is_separable
    assert off(alone, REVERSAL, -1.0) < SYMMETRY
    assert off(alone, -REVERSAL, -1.0) > 1e-2


@pytest.mark.slow
def test_symmetry_helps_where_it_is_there():
    """The pendulum is odd and reversible: fewer points say as much."""
    pendulum = hk.systems.Pendulum(1.0, 1.0, 1.0)
    rng = np.random.default_rng(2)
    x, fresh = rng.uniform(-2, 2, size=(12, 2)), rng.uniform(-2, 2, size=(200, 2))
    y, truth = (np.asarray(jax.vmap(pendulum)(each)) for each in (x, fresh))
    K, errors = hk.Symplectic(hk.Gaussian(2.0)), []
    for kernel in (K, hk.Reversible(hk.Odd(K))):
        wrong = hk.fit(kernel, x, y, 1e-8).evaluate(fresh) - truth
        errors.append(np.linalg.norm(wrong) / np.linalg.norm(truth))
    assert errors[1] < 0.2 * errors[0]


@pytest.mark.slow
def test_random_features_know_the_group():
    K = hk.Symplectic(hk.Invariant(hk.Gaussian(2.0), [C3, MIRROR, REVERSAL]))
    solver = hk.RandomFeatures(200, jax.random.key(0))
    field = hk.fit(K, X, Y, 1e-2, solver=solver)
    assert off(field, C3) < SYMMETRY
    assert off(field, REVERSAL, -1.0) < SYMMETRY
    # Σ_r φ_r(x) φ_r(z)ᵀ tends to K(x, z)
    features = field.features
    x, z = POINTS[:2]
    many = features_of(K, 4, 20000, jax.random.key(1), X.dtype)
    for phi, most in ((features, 0.5), (many, 0.05)):
        wrong = np.asarray(phi.rows(x) @ phi.rows(z).T - K(x, z))
        assert np.abs(wrong).max() < most * np.abs(K(x, x)).max()
    x0, slope = POINTS[0], jax.grad(field.hamiltonian)(POINTS[0])
    np.testing.assert_allclose(field(x0), canonical(4) @ slope, atol=1e-12)


@pytest.mark.slow
def test_saved_fields_come_back(tmp_path):
    file = tmp_path / "field.npz"
    fields = [
        hk.fit(hk.Symplectic(hk.Invariant(G, [C3, MIRROR])), X, Y, 1e-2),
        hk.fit(hk.Reversible(hk.Odd(hk.Symplectic(ARD))), X, Y, 1e-2),
        hk.fit(
            hk.Reversible(hk.Symplectic(G)),
            X,
            Y,
            1e-2,
            solver=hk.RandomFeatures(8, jax.random.key(0)),
        ),
    ]
    for field in fields:
        save(file, field)
        np.testing.assert_array_equal(load(file)(X[0]), field(X[0]))
    K = hk.Symplectic(hk.Invariant(G, [swap]))  # the code of the user's
    save(file, hk.fit(K, X, Y, 1e-2))
    with pytest.raises(ValueError, match="code that is not in the file"):
        load(file)
    load(file, kernel=K)


@pytest.mark.slow
def test_works_under_jit_vmap_and_grad():
    def norm(log_lengthscale):
        k = hk.Gaussian(jnp.exp(log_lengthscale))
        return hk.fit(hk.Symplectic(hk.Invariant(k, [C3, REVERSAL])), X, Y, 1e-2).norm

    at, step = jnp.asarray(0.3), 1e-5
    slope = (norm(at + step) - norm(at - step)) / (2 * step)
    np.testing.assert_allclose(jax.jit(jax.grad(norm))(at), slope, rtol=1e-6)


# Bad input.


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: hk.Invariant(G, [turn(1.0)]), "more than 64"),
        (lambda: hk.Invariant(G, [np.diag([1.0, -1.0, 1.0, 1.0])]), "must satisfy SᵀJS = ±J"),
        (lambda: hk.Invariant(G, [np.eye(3)]), "3 by 3 matrix and the states have 4"),
        (lambda: hk.Invariant(G, [lambda x: x + 1.0]), "not linear"),
        (lambda: hk.Invariant(G, [lambda x: x[:2]]), r"to shape \(2,\)"),
    ],
)
def test_what_is_no_symmetry_of_a_symplectic_field_is_refused(make, match):
    with pytest.raises(ValueError, match=match):
        hk.fit(hk.Symplectic(make()), X, Y)


def test_friction_knows_no_time_reversal():
    with pytest.raises(TypeError, match="not with friction"):
        hk.Reversible(hk.PortHamiltonian(G))
    with pytest.raises(ValueError, match="With friction time reversal"):
        hk.fit(hk.PortHamiltonian(hk.Invariant(G, [REVERSAL])), X, Y)
    hk.fit(hk.PortHamiltonian(hk.Invariant(G, [TURN4])), X, Y)
    with pytest.raises(ValueError, match="not one of the fields"):  # frictions are trained apart
        hk.fit(hk.PortHamiltonian(hk.Invariant(G, [TURN4]), [0.1, 0.1]), X, Y)


def test_other_refusals():
    with pytest.raises(TypeError, match="list of linear maps"):
        hk.Invariant(G, 3.0)
    with pytest.raises(ValueError, match="not invertible"):
        hk.Invariant(G, [np.diag([1.0, 0.0, 1.0, 1.0])])
    with pytest.raises(ValueError, match="do not close to a finite group"):
        hk.Invariant(G, [[[1, 1], [0, 1]]])
    with pytest.raises(ValueError, match="finite matrix"):
        hk.Invariant(G, [np.ones((2, 3))])
    with pytest.raises(TypeError, match="Reversible must be a matrix-valued"):
        hk.Reversible(G)
    for make in (
        lambda: hk.DivergenceFree(hk.Invariant(G, [C3])),
        lambda: hk.Invariant(hk.DivergenceFree(G), [C3]),
        lambda: hk.Invariant(hk.DivergenceFree(G) + hk.CurlFree(G), [C3]),
    ):
        with pytest.raises(ValueError, match="takes no symmetry but Odd and Even"):
            make()
    with pytest.raises(ValueError, match="only the zero function"):
        hk.Invariant(hk.Even(hk.Symplectic(G)), [-np.eye(4)])  # H odd and even
