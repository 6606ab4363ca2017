"""What `tune` and the closed form of cross-validation cost, against refits and grids.

    python tests/benchmarks/tuning_speed.py [--quick]

All times are warm, in one process: the minimum and the median over repeats. What is compared is
first checked to agree. `--quick` leaves out the loops of minutes.

1. `tune` against a grid of 30 × 25 values of (σ, λ) with a refit for every fold, N = 24 and 300,
   n = 2, 5 folds, in four forms: (a) public `fit` for every fold and a compiled evaluation, as a
   user would write it; (b) one compiled function for both, called for every fold; (c) one for all
   folds, called for every grid point; (d) the whole grid in one compiled call. All but (d) are
   timed on a sample of points and scaled.
2. The leave-one-out loss with its gradient, N = 1000, n = 2, against one Cholesky factorisation
   of the same matrix by SciPy, and against refits of the same loss (a sample, scaled).
3. `tune` of a kernel with 10 hyperparameters against one with 2.
4. `tune` of 1128 points with n = 2, warm, and of 600 points with n = 8, the first call, and the
   error of that field at 1000 new states.
"""

import argparse
import time
from collections.abc import Callable

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from dynamics import TWO_BODIES, near_circular
from timing import Timed, environment, in_turn, timed

import hamkernel as hk
from hamkernel._closed_forms import Partition
from hamkernel._gram import assemble, plus_ridge
from hamkernel._solvers.factors import solution
from hamkernel.paper._experiments import grid_losses

FOLDS = 5
SIGMAS, RIDGES = np.geomspace(0.3, 30, 30), np.geomspace(1e-8, 1, 25)


def show(name: str, seconds: Timed, of: Timed | None = None) -> None:
    ratio = "" if of is None else f"   {seconds.least / of.least:9.3g} x"
    least, median = 1e3 * seconds.least, 1e3 * seconds.median
    print(f"  {name:58s} {least:10.3f} {median:10.3f} ms{ratio}", flush=True)


def data(N: int) -> tuple[jax.Array, jax.Array]:
    """The pendulum's field at random points, with noise 0.05."""
    rng = np.random.default_rng(0)
    X = rng.uniform(-2.5, 2.5, size=(N, 2))
    Y = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.05 * rng.normal(size=(N, 2))
    return jnp.asarray(X), jnp.asarray(Y)


def kernel(sigma) -> hk.Symplectic:
    return hk.Symplectic(hk.Gaussian(sigma))


@jax.jit
def evaluate(field, X):
    return jax.vmap(field)(X)


def refit(sigma, ridge, X, Y, rest, out) -> jax.Array:
    """(a) The loss of one fold by the public functions."""
    field = hk.fit(kernel(sigma), X[rest], Y[rest], ridge)
    return jnp.mean((Y[out] - evaluate(field, X[out])) ** 2)


compiled_refit = eqx.filter_jit(refit)  # (b)


def by_folds(one_fold: Callable, sigma, ridge, X, Y, points) -> float:
    """The loss by one call for every fold, with the ridge (N − N/F) λ."""
    losses = []
    for out in points:
        rest = np.setdiff1d(np.arange(len(X)), out)
        scale = (len(X) - len(X) / len(points)) / len(rest)
        arguments = jnp.asarray(sigma), jnp.asarray(scale * ridge), X, Y, rest, out
        losses.append(float(one_fold(*arguments)))
    return float(np.mean(losses))


@eqx.filter_jit
def compiled_loss(sigma, ridge, X, Y, partition) -> jax.Array:
    """(c) All refits of one grid point."""
    return grid_losses(kernel_of, sigma[None], ridge[None], X, Y, partition)[0, 0]


def kernel_of(k):
    return hk.Symplectic(k)


def against_grids(N: int, quick: bool) -> None:
    X, Y = data(N)
    partition = Partition(N, FOLDS)
    points = partition.folds
    sample = np.random.default_rng(1).permutation(len(SIGMAS) * len(RIDGES))[: 3 if quick else 12]
    pairs = [(SIGMAS[i // len(RIDGES)], RIDGES[i % len(RIDGES)]) for i in sample]
    # Grid points that float64 cannot carry are left out of the check, not of the time.
    sound = [(s, r) for s, r in pairs if r > 1e-10 * 2 / s**2][:3]
    for sigma, ridge in sound:
        exact = float(hk.cross_validation_loss(kernel(sigma), X, Y, ridge, FOLDS))
        for loss in (
            by_folds(refit, sigma, ridge, X, Y, points),
            by_folds(compiled_refit, sigma, ridge, X, Y, points),
            float(compiled_loss(jnp.asarray(sigma), jnp.asarray(ridge), X, Y, partition)),
        ):
            np.testing.assert_allclose(loss, exact, rtol=1e-5)
    print(f"N = {N}, n = 2, {FOLDS} folds; {len(sound)} grid points agree to 1e-5", flush=True)
    tuned = timed(lambda: hk.tune(kernel(1.0), X, Y, 1e-3, FOLDS), 5 if N > 100 else 20)
    show("tune", tuned)

    def users() -> None:
        for sigma, ridge in sound:
            by_folds(refit, sigma, ridge, X, Y, points)

    size = len(SIGMAS) * len(RIDGES)
    each = timed(users, 2)
    show(
        f"(a) public fit per fold, {len(sound)} of {size} points, scaled",
        each.scaled(size / len(sound)),
        tuned,
    )

    def folds() -> None:
        for sigma, ridge in pairs:
            by_folds(compiled_refit, sigma, ridge, X, Y, points)

    each = timed(folds, 3)
    show(
        f"(b) one compiled function per fold, {len(pairs)} of {size} points, scaled",
        each.scaled(size / len(pairs)),
        tuned,
    )

    def loop() -> list:
        return [
            compiled_loss(jnp.asarray(s), jnp.asarray(r), X, Y, partition).block_until_ready()
            for s, r in pairs
        ]

    each = timed(loop, 3)
    show(
        f"(c) one compiled function, {len(pairs)} of {size} points, scaled",
        each.scaled(size / len(pairs)),
        tuned,
    )
    if N > 100 and quick:
        return
    sigmas, ridges = jnp.asarray(SIGMAS), jnp.asarray(RIDGES)
    whole = timed(
        lambda: grid_losses(kernel_of, sigmas, ridges, X, Y, partition), 1 if N > 100 else 5
    )
    show("(d) the whole grid in one compiled call", whole, tuned)
    best = float(np.nanmin(grid_losses(kernel_of, sigmas, ridges, X, Y, partition)))
    loss = float(hk.tune(kernel(1.0), X, Y, 1e-3, FOLDS).loss)
    print(f"  loss of tune {loss:.6g}, best of the grid {best:.6g}, ratio {loss / best:.4f}")


@eqx.filter_jit
def one_refit(K, X, Y, ridge, out):
    """The squared residual of point `out` under a fit to the others."""
    N, n = X.shape
    rest = jnp.where(jnp.arange(N - 1) < out, jnp.arange(N - 1), jnp.arange(1, N))
    G = assemble(K, X[rest], X[rest]).reshape((N - 1) * n, (N - 1) * n)
    _, a = solution(plus_ridge(G, ridge), Y[rest].reshape(-1))
    value = assemble(K, X[out][None], X[rest]).reshape(n, -1) @ a
    return jnp.mean((Y[out] - value) ** 2)


def leave_one_out(N: int) -> None:
    X, Y = data(N)
    K, ridge = kernel(1.0), jnp.asarray(1e-4)

    def loss(K, ridge):
        return hk.cross_validation_loss(K, X, Y, ridge, "loo")

    residuals = hk.cross_validation_residuals(K, X, Y, ridge, "loo")
    refit = float(one_refit(K, X, Y, (N - 1) * ridge, jnp.asarray(N // 3)))
    np.testing.assert_allclose(refit, np.mean(residuals[N // 3] ** 2), rtol=1e-6)
    print(f"leave-one-out, N = {N}, n = 2; a refit agrees to 1e-6", flush=True)
    A = np.asarray(hk.gram(K, X)).reshape(2 * N, 2 * N) + (N - 1) * 1e-4 * np.eye(2 * N)
    compiled, with_slope = jax.jit(loss), jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    runs = {
        "factor": lambda: scipy.linalg.cho_factor(A),
        "loss": lambda: compiled(K, ridge),
        "both": lambda: with_slope(K, ridge),
    }
    factor, value, both = in_turn(15, runs).values()
    slope = jax.jit(jax.value_and_grad(lambda ridge: one_refit(K, X, Y, ridge, jnp.asarray(7))))
    refits = timed(lambda: slope((N - 1) * ridge), 2).scaled(N)
    show("SciPy's cho_factor of the same matrix", factor)
    show("loss; times cho_factor", value, factor)
    show("loss and gradient; times cho_factor", both, factor)
    show("refits with the gradient over λ alone, scaled; times ours", refits, both)


def many_hyperparameters() -> None:
    X, Y = data(24)
    two = hk.Symplectic(hk.Gaussian(1.0))
    many = hk.Symplectic(
        sum(
            scale * hk.Gaussian(np.full(2, ell))
            for scale, ell in ((1.0, 0.7), (0.5, 1.5), (0.2, 4))
        )
    )
    count = sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(many, eqx.is_inexact_array))) + 1
    runs = {"two": lambda: hk.tune(two, X, Y), "many": lambda: hk.tune(many, X, Y)}
    of_two, of_many = in_turn(10, runs).values()
    print("hyperparameters, λ among them, N = 24, n = 2")
    show("tune of 2", of_two)
    show(f"tune of {count}", of_many, of_two)


def many_points() -> None:
    """All data far beyond the first part: runs of a pendulum, and two bodies in the plane."""
    rng = np.random.default_rng(0)
    starts = jnp.asarray(rng.uniform([-2.5, -3], [2.5, 3], size=(141, 2)))
    X, Y = hk.systems.sample(
        hk.systems.Pendulum(mass=1.0),
        starts,
        jnp.linspace(0, 1, 8),
        0.02,
        0.02,
        key=jax.random.key(0),
    )
    X, Y, folds = X.reshape(-1, 2), Y.reshape(-1, 2), np.repeat(np.arange(141), 8)
    print("many points")
    warm = timed(lambda: hk.tune(kernel(1.0), X, Y, 1e-4, folds), 3)
    show("tune of 1128 points, n = 2, 141 folds", warm)
    X, new = near_circular(rng, 600), near_circular(rng, 1000)
    Y, true = jax.vmap(TWO_BODIES)(X), jax.vmap(TWO_BODIES)(new)
    begin = time.perf_counter()
    field = hk.tune(kernel(2.0), X, Y, 1e-4).field
    error = float(jnp.linalg.norm(field.evaluate(new) - true) / jnp.linalg.norm(true))
    print(f"  tune of 600 points, n = 8, first call: {time.perf_counter() - begin:.1f} s")
    print(f"  error of that field {error:.2e}")


def main() -> None:
    parser = argparse.ArgumentParser(description="What tuning costs, beside grids.")
    parser.add_argument("--quick", action="store_true", help="smaller samples")
    quick = parser.parse_args().quick
    print(environment())
    print(f"  {'':58s} {'min':>10s} {'median':>10s}")
    for N in (24, 300):
        against_grids(N, quick)
    leave_one_out(1000)
    many_hyperparameters()
    many_points()


if __name__ == "__main__":
    main()
