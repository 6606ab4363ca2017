"""The check refuses every kernel known to be unfit, with the right cause, and no sound one."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import check_kernel

ROOT3, ROOT5 = 3**0.5, 5**0.5


def cloud(seed=0, N=24, n=2, scale=1.0):
    return scale * np.random.default_rng(seed).normal(size=(N, n))


def squared(x, z):
    return jnp.sum((x - z) ** 2)


def naive_norm(x, z):
    return jnp.linalg.norm(x - z)


def safe_norm(x, z):
    """The usual 'double where', right for first derivatives only."""
    s = squared(x, z)
    far = s > 0
    return jnp.where(far, jnp.sqrt(jnp.where(far, s, jnp.ones_like(s))), jnp.zeros_like(s))


def matern12(r):
    return jnp.exp(-r)


def matern32(r):
    return (1 + ROOT3 * r) * jnp.exp(-ROOT3 * r)


def matern52(r):
    return (1 + ROOT5 * r + 5 / 3 * r**2) * jnp.exp(-ROOT5 * r)


# Matérn-3/2 of the squared distance with exact derivatives, written here and not in the library:
# φ(s) = (1 + √(3s)) e^(−√(3s)), φ′ = −(3/2) e^(−√(3s)), φ″ = (9/4) e^(−√(3s))/√(3s).
@jax.custom_jvp
def profile32(s):
    return matern32(jnp.sqrt(s))


@jax.custom_jvp
def slope32(s):
    return -1.5 * jnp.exp(-jnp.sqrt(3 * s))


@profile32.defjvp
def _(primals, tangents):
    return profile32(*primals), slope32(*primals) * tangents[0]


@slope32.defjvp
def _(primals, tangents):
    (s,) = primals
    r = jnp.sqrt(jnp.where(s > 0, 3 * s, jnp.ones_like(s)))
    # At s = 0 φ″ is infinite and meets (x − z)(x − z)ᵀ = 0: the product tends to zero.
    curvature = jnp.where(s > 0, 2.25 * jnp.exp(-r) / r, jnp.zeros_like(s))
    return slope32(s), curvature * tangents[0]


def through(profile, distance):
    return lambda x, z: profile(distance(x, z))


def refusal(k, points):
    with pytest.raises(ValueError, match=r".") as caught:
        check_kernel(k, points)
    return str(caught.value)


SOUND = {
    "Gaussian": lambda x, z: jnp.exp(-squared(x, z) / 2),
    "Gaussian by products": lambda x, z: jnp.exp(x @ z - (x @ x + z @ z) / 2),
    "Matern-3/2": lambda x, z: profile32(squared(x, z)),
    "rational quadratic": lambda x, z: 1 / (1 + squared(x, z)),
    "periodic": lambda x, z: jnp.exp(-2 * jnp.sum(jnp.sin(x - z) ** 2)),
    "two scales": lambda x, z: jnp.exp(-squared(x, z) / 2) + 1e-3 * profile32(1e4 * squared(x, z)),
    "large constant": lambda x, z: 100 + profile32(squared(x, z)),
}

NOT_STATIONARY = {
    "polynomial": lambda x, z: (1 + x @ z) ** 4,
    "homogeneous": lambda x, z: (x @ z) ** 2,
    "linear": lambda x, z: x @ z,
    "exponential": lambda x, z: jnp.exp(x @ z / 4),
    "modulated": lambda x, z: (1 + x[0] ** 2) * (1 + z[0] ** 2) * jnp.exp(-squared(x, z) / 2),
    "warped": lambda x, z: jnp.exp(-squared(jnp.sin(x), jnp.sin(z)) / 2),
}


# No false alarm


@pytest.mark.few(2)
@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_sound_kernels_pass_at_every_lengthscale_amplitude_and_dimension(name, dtype):
    # In float32 the product form loses the distance itself beyond a thousand lengthscales.
    seed = 0
    for lengthscale, of_each in (
        (1e-3, ((1e-6, 1), (1e6, 2))),
        (0.1, ((1.0, 4), (1e3, 6))),
        (1e3, ((1e6, 2), (1e-6, 4))),
    ):
        for amplitude, n in of_each:
            seed += 1
            if dtype == np.float32 and lengthscale < 0.01 and "products" in name:
                continue

            def k(x, z, a=amplitude, ell=lengthscale):
                return a * SOUND[name](x / ell, z / ell)

            assert check_kernel(k, cloud(seed, n=n).astype(dtype)) is None


@pytest.mark.few(1)
@pytest.mark.parametrize("name", NOT_STATIONARY)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_kernels_that_are_not_stationary_pass(name, dtype):
    for seed, n in enumerate((1, 2, 4, 6)):
        check_kernel(NOT_STATIONARY[name], cloud(seed, n=n).astype(dtype))


@pytest.mark.slow
def test_no_false_alarm_over_many_clouds_of_points():
    @eqx.filter_jit
    def k(x, z):
        return profile32(squared(x, z)) + (1 + x @ z) ** 2

    for seed in range(25):
        check_kernel(k, cloud(seed, N=16))


@pytest.mark.few(4)
@pytest.mark.parametrize(
    "points",
    [
        cloud(scale=1e3),  # k underflows between any two points
        cloud() + 50,  # far from the origin
        cloud() * np.array([1e-3, 1e3]),  # coordinates of unlike scale
        np.repeat(cloud(N=8), 2, axis=0),  # every point twice
        np.concatenate([np.zeros((1, 2)), 1e-17 * np.ones((1, 2)), cloud(N=6)]),
        cloud(N=1),
        np.zeros((1, 2)),
        np.arange(12).reshape(6, 2),
        cloud(N=500),
    ],
    ids=["far", "offset", "scales", "twice", "origin", "one", "zero", "integers", "many"],
)
def test_sound_kernels_pass_on_awkward_points(points):
    for k in (SOUND["Gaussian"], SOUND["Matern-3/2"], NOT_STATIONARY["homogeneous"]):
        if points.any() or k is not NOT_STATIONARY["homogeneous"]:
            check_kernel(k, points)


class Learned(eqx.Module):
    log_lengthscale: jax.Array

    def __call__(self, x, z):
        return jnp.exp(-squared(x, z) * jnp.exp(-2 * self.log_lengthscale) / 2)


def test_modules_partials_methods_and_jitted_functions_are_accepted():
    def scaled(a, x, z):
        return a * jnp.exp(-squared(x, z) / 2)

    module = Learned(jnp.zeros(()))
    for k in (
        module,
        functools.partial(scaled, 2.0),
        jax.tree_util.Partial(scaled, jnp.asarray(2.0)),
        jax.jit(SOUND["Gaussian"]),
        module.__call__,
    ):
        check_kernel(k, cloud(N=3))
    bad = functools.partial(lambda a, x, z: a * matern52(safe_norm(x, z)), 2.0)
    assert "zero block" in refusal(jax.jit(bad), cloud())


# The block at x = z


@pytest.mark.few(4)
@pytest.mark.parametrize("profile", [matern32, matern52])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_matern_through_a_norm_is_nan(profile, scale, dtype):
    points = cloud(n=3, scale=scale).astype(dtype)
    message = refusal(lambda x, z: profile(naive_norm(x, z) / scale), points)
    assert "NaN" in message
    assert "square root" in message
    assert "squared distance" in message


@pytest.mark.few(2)
@pytest.mark.parametrize("profile", [matern32, matern52])
@pytest.mark.parametrize("ratio", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_matern_through_a_safe_norm_has_a_zero_block(profile, ratio, dtype):
    k = through(lambda r: profile(r / ratio), safe_norm)
    assert refusal(k, cloud(n=2).astype(dtype)).startswith("zero block")
    assert refusal(k, cloud(n=1).astype(dtype)).startswith("zero block")


def test_the_limit_of_the_block_is_given_in_the_units_of_the_points():
    # Matérn-5/2 with ℓ = 10: M(x, x) = 5/(3ℓ²) I = 0.01667 I.
    message = refusal(through(lambda r: matern52(r / 10), safe_norm), cloud(scale=7.0))
    assert "[[0., 0.], [0., 0.]]" in message
    assert "0.0167" in message


def test_a_flat_patch_around_zero_distance_is_a_zero_block():
    def k(x, z):
        s = squared(x, z)
        return jnp.where(s < 1e-12, 1.0, matern52(jnp.sqrt(jnp.maximum(s, 1e-12))))

    assert refusal(k, cloud()).startswith("zero block")


def test_a_fault_in_one_factor_or_term_is_found():
    k = through(matern52, safe_norm)
    assert "block" in refusal(lambda x, z: k(x[:1], z[:1]) * SOUND["Gaussian"](x, z), cloud())
    assert "block" in refusal(lambda x, z: k(x, z) + 0.3 * SOUND["Gaussian"](x, z), cloud())
    scales = cloud() * np.array([1e3, 1.0])
    ell = jnp.array([1e3, 1.0])
    mixed = lambda x, z: k(x[:1] / ell[:1], z[:1] / ell[:1]) + SOUND["Gaussian"](x[1:], z[1:])  # noqa: E731
    assert "block" in refusal(mixed, scales)


def test_too_large_a_block_is_refused_though_the_gram_stays_positive():
    def slope(s):
        return -0.5 * jnp.exp(-s / 2)

    @jax.custom_jvp
    def profile(s):
        return jnp.exp(-s / 2)

    @profile.defjvp
    def _(primals, tangents):
        (s,) = primals
        return profile(s), jnp.where(s == 0, 2.0, 1.0) * slope(s) * tangents[0]

    assert "wrong block" in refusal(lambda x, z: profile(squared(x, z)), cloud())


@pytest.mark.few(3)
@pytest.mark.parametrize("norm", [naive_norm, safe_norm])
@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_kernels_without_a_second_derivative_are_too_rough(norm, n, dtype):
    points = cloud(n=n).astype(dtype)
    for k in (through(matern12, norm), lambda x, z: jnp.exp(-(norm(x, z) ** 1.5))):
        assert "too rough" in refusal(k, points)


# Symmetry, sign, signature


def test_asymmetric_kernels_are_refused():
    for k in (
        lambda x, z: jnp.exp(-squared(x, z) + (x[0] - z[0]) / 10),
        lambda x, z: (1 + x[0] ** 2) * jnp.exp(-squared(x, z)),
        lambda x, z: x @ z + 1e-3 * x[0] * z[1],
    ):
        assert "not symmetric" in refusal(k, cloud())


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_indefinite_kernels_are_refused(dtype):
    for k in (
        lambda x, z: jnp.tanh(x @ z - 1),
        lambda x, z: -squared(x, z),
        lambda x, z: jnp.sin(x @ z),
        lambda x, z: jnp.cos(3 * squared(x, z)),
        lambda x, z: -jnp.exp(-squared(x, z)),
    ):
        assert "not positive definite" in refusal(k, cloud().astype(dtype))


def test_a_result_that_is_not_one_real_number_is_refused():
    assert "(2,)" in refusal(lambda x, z: x * z, cloud())
    assert "(2, 2)" in refusal(lambda x, z: jnp.outer(x, z), cloud())
    assert "(1,)" in refusal(lambda x, z: (x @ z)[None], cloud())
    assert "tuple" in refusal(lambda x, z: (x @ z, x @ z), cloud())
    assert "int" in refusal(lambda x, z: 1, cloud())
    assert "complex" in refusal(lambda x, z: jax.lax.complex(x @ z, x @ z), cloud())


@jax.custom_vjp
def reverse_only(x, z):
    return jnp.exp(x @ z)


reverse_only.defvjp(
    lambda x, z: (reverse_only(x, z), (x, z)),
    lambda xz, g: (g * reverse_only(*xz) * xz[1], g * reverse_only(*xz) * xz[0]),
)


@pytest.mark.few(1)
@pytest.mark.parametrize("jitter", [1e-9, 1e-12, 1e-36, 1e-300])
def test_a_small_number_under_the_root_does_not_make_laplace_smooth(jitter):
    for seed, n in ((0, 2), (1, 4)):
        rough = lambda x, z: jnp.exp(-jnp.sqrt(squared(x, z) + jitter))  # noqa: E731
        product = lambda x, z: jnp.exp(  # noqa: E731
            -jnp.sqrt(jnp.maximum(x @ x + z @ z - 2 * x @ z, 0.0) + jitter)
        )
        for k in (rough, product):
            assert "too rough" in refusal(k, cloud(seed, n=n))


@pytest.mark.slow
def test_a_kernel_with_a_second_smaller_scale_is_sound():
    small = [
        1e-4 * hk.Gaussian(1e-3),
        1e-8 * hk.Gaussian(1e-5),
        1e-6 * hk.Matern(1.5, 1e-4),
        1e-4 * hk.RationalQuadratic(1.0, 1e-4),
    ]
    for second in small:
        check_kernel(hk.Gaussian(1.0) + second, cloud())


def test_single_precision_in_the_kernel_is_no_fault():
    def k(x, z):
        return jnp.exp(-squared(x.astype(jnp.float32), z.astype(jnp.float32)) / 2)

    check_kernel(k, cloud(N=12))


def test_functions_that_jax_cannot_run_or_differentiate_are_refused():
    assert "jax.numpy" in refusal(lambda x, z: np.exp(x @ z), cloud())
    assert "(2,)" in refusal(lambda x, z: x[:, 0] @ z[:, 0], cloud())
    assert "custom_jvp" in refusal(reverse_only, cloud())
    # A callback to the host runs but has no derivative.
    on_host = lambda x, z: jax.pure_callback(np.dot, jax.ShapeDtypeStruct((), x.dtype), x, z)  # noqa: E731
    assert "cannot be differentiated" in refusal(on_host, cloud())


def test_kernels_whose_blocks_all_vanish_are_refused():
    assert "zero at all points" in refusal(lambda x, z: 1.0, cloud())
    assert "zero at all points" in refusal(lambda x, z: jnp.sum(x**2) + jnp.sum(z**2), cloud())


def test_values_outside_the_domain_are_refused():
    assert "k is nan" in refusal(lambda x, z: jnp.log(x[0]) * jnp.log(z[0]), cloud())
    assert "k is inf" in refusal(lambda x, z: jnp.exp(x @ z), cloud(scale=100.0))


def test_bad_points_and_tracers_are_refused():
    k = SOUND["Gaussian"]
    assert "(N, n)" in refusal(k, cloud()[0])
    assert "NaN" in refusal(k, np.array([[0.0, np.nan]]))
    with pytest.raises(TypeError, match="callable"):
        check_kernel(1.0, cloud())  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"jax\.jit"):
        jax.jit(lambda X: check_kernel(k, X))(jnp.asarray(cloud()))


# Kernels of other libraries, as their users get them


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_tinygp_matern_has_a_rank_one_block_and_its_smooth_kernels_pass():
    kernels = pytest.importorskip("tinygp").kernels
    distance = kernels.distance.L2Distance()
    for family in (kernels.Matern32, kernels.Matern52):
        for k in (family(distance=distance), family(distance=distance).evaluate):
            assert refusal(k, cloud()).startswith("rank-one block")
        check_kernel(family(distance=distance), cloud(n=1))  # n = 1: L1 and L2 are the same
        assert "direction" in refusal(family(), cloud())  # the default L1 distance
    assert "too rough" in refusal(kernels.Exp(distance=distance), cloud())
    for k in (kernels.ExpSquared(), kernels.RationalQuadratic(alpha=1.0, distance=distance)):
        check_kernel(k, cloud())


@pytest.mark.filterwarnings("ignore")
def test_gpjax_matern_has_a_zero_block_and_its_smooth_kernels_pass():
    kernels = pytest.importorskip("gpjax").kernels
    for family in (kernels.Matern32, kernels.Matern52):
        assert refusal(family(), cloud()).startswith("zero block")
        # XLA may fuse x/ℓ − z/ℓ: then the blocks are not zero but noise around the truth.
        assert refusal(family(lengthscale=1e-2), cloud(n=4)).startswith("zero block")
        assert refusal(family(), cloud(scale=1e-6)).startswith("zero block")
    assert "too rough" in refusal(kernels.Matern12(), cloud())
    for k in (kernels.RBF(), kernels.RationalQuadratic(), kernels.RBF(lengthscale=1e-3)):
        check_kernel(k, cloud())
