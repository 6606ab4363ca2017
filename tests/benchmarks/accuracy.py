"""Every loss and its gradient against 100 digits, over condition numbers from 1e2 to 1e15.

    python tests/benchmarks/accuracy.py [--quick]

The reference takes the Gram, or the features, in float64 as they are, and refits without each fold
in ball arithmetic (Arb); derivatives move the Gram by 1e-30 of its derivative. An entry is the
largest error of the three losses, relative to the loss; `inf` means that the library said that it
cannot tell. Asked for: at most 100 ε cond + 1e-10 up to a condition of 1e13, and beyond it a factor
of 2 or inf.

Before them stand least squares by the triangle of the columns, of reflections (QR) and of products
(shifted Cholesky QR): the largest error of the weights, the residual and the log determinant. No
bound is asked for; products have to be as good as reflections.
"""

import argparse
import dataclasses
from collections.abc import Callable
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from flint import arb, arb_mat, ctx
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel._closed_forms import Partition
from hamkernel._observations.blocks import Components
from hamkernel._observations.measurements import measurements_of_states
from hamkernel._solvers.landmarks import landmarks_of
from hamkernel._solvers.low_rank import LandmarkBasis
from hamkernel._solvers.triangle import cholesky_triangle, householder_triangle
from hamkernel._validation import (
    generalized_loss,
    log_likelihood,
    partition_loss,
    partition_of_rows,
)

EPS = np.finfo(float).eps
ctx.prec = 400  # bits
STEP = arb(10) ** -30


# The reference: ball arithmetic, which bounds its own rounding.


def exact(array) -> np.ndarray:
    """Numbers of Arb, equal to those of `array`."""
    return np.vectorize(lambda x: arb(float(x)), otypes=[object])(np.asarray(array))


def solved(A: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, arb]:
    """A⁻¹B and log det A."""
    matrix = arb_mat(A.tolist())
    return np.array(matrix.solve(arb_mat(B.tolist())).tolist()), matrix.det().log()


def refitted(G, ridge, y, labels, n):
    """The mean over folds of the mean squared error of refits."""
    rows, names = np.repeat(labels, n), np.unique(labels)
    total = 0
    for name in names:
        out = rows == name
        A = G[np.ix_(~out, ~out)] + ridge * exact(np.eye((~out).sum()))
        error = y[out] - G[np.ix_(out, ~out)] @ solved(A, y[~out, None])[0][:, 0]
        total += (error @ error) / out.sum()
    return total / len(names)


def likelihood(G, ridge, y):
    a, log_det = solved(G + ridge * exact(np.eye(len(y))), y[:, None])
    return -(y @ a[:, 0] + log_det + len(y) * (2 * arb.pi()).log()) / 2


def generalized(G, ridge, y):
    D = len(y)
    C, _ = solved(G + ridge * exact(np.eye(D)), np.column_stack([y, exact(np.eye(D))]))
    a = C[:, 0]
    return D * (a @ a) / np.trace(C[:, 1:]) ** 2


# The problems.


def oscillators(n: int, N: int, seed: int = 0):
    """Noise-free states and velocities of n/2 coupled pendulums."""
    rng = np.random.default_rng(seed)
    q, p = rng.uniform(-1.5, 1.5, size=(2, N, n // 2))
    return np.hstack([q, p]), np.hstack([p, -np.sin(q) - 0.1 * q.sum(axis=1, keepdims=True)])


def orbit(count: int):
    """Points of one Kepler orbit, which lie on a curve."""

    def velocity(_, x):
        return np.concatenate([x[2:], -x[:2] / np.linalg.norm(x[:2]) ** 3])

    times = np.linspace(0, 3, count)
    start = [0.8, 0.0, 0.0, 1.2]
    X = solve_ivp(velocity, (0, 3), start, t_eval=times, rtol=1e-11, atol=1e-12).y.T
    return X, np.stack([velocity(0, x) for x in X])


class Own(eqx.Module):
    """A user's kernel with a hyperparameter."""

    log_scale: Any

    def __call__(self, x, z):
        square = jnp.sum((x - z) ** 2) * jnp.exp(-2 * self.log_scale)
        return jnp.exp(-square / 8) * (1 + x @ z / 9) ** 2


@dataclasses.dataclass(frozen=True)
class Problem:
    """A kernel with one hyperparameter, on data without noise."""

    name: str
    make: Callable[[Any], Any]  # log of a hyperparameter -> K
    data: tuple[np.ndarray, np.ndarray]
    folds: Any


def problems() -> list[Problem]:
    unequal = np.array([0, 0, 0, 0, 0, 0, 1, 1, 2, 2, 2, 3])

    def gaussian(t):
        return hk.Symplectic(hk.Gaussian(3 * jnp.exp(t)))

    def matern(t):
        return hk.Symplectic(hk.Matern(4.5, 30 * jnp.exp(t)))

    def polynomial(t):
        return hk.CurlFree(hk.Polynomial(3, jnp.exp(t)))

    def odd(t):
        return hk.Odd(hk.Symplectic(hk.Gaussian(2 * jnp.exp(t))))

    def own(t):
        return hk.Symplectic(Own(t))

    return [
        Problem("Gaussian", gaussian, oscillators(2, 16), 4),
        Problem("Gaussian, loo", gaussian, oscillators(2, 14), "loo"),
        Problem("Gaussian, labels", gaussian, oscillators(4, 12), unequal),
        Problem("Gaussian, an orbit", gaussian, orbit(15), 5),
        Problem("Gaussian, n = 8", gaussian, oscillators(8, 7), 3),
        Problem("Matern", matern, oscillators(2, 16), 5),
        Problem("polynomial", polynomial, oscillators(4, 12), 4),
        Problem("odd", odd, oscillators(4, 10), unequal[:10]),
        Problem("user's", own, oscillators(2, 14), 4),
    ]


def bases(problem: Problem, K) -> dict[str, Any]:
    X = jnp.asarray(problem.data[0])
    n = X.shape[1]
    found: dict[str, Any] = {"dense": None}
    found["landmarks"] = LandmarkBasis(landmarks_of(Components(X[:: max(1, 2 * len(X) // 8)])))
    if problem.name.startswith(("Gaussian", "Matern", "odd")):
        found["waves"] = hk.RandomFeatures(2 * n, jax.random.key(0))
    return found


def gram_of(basis, make, X):
    """The Gram that the loss stands for, as a function of the hyperparameter."""
    if basis is None:
        return lambda t: hk.gram(make(t), X).reshape(X.size, X.size)

    def low_rank(t):
        K = make(t)
        return basis.span(K, X.shape[1], X.dtype).rows_of(Components(X))

    return low_rank


def compiled(problem: Problem, basis) -> dict[str, Any]:
    """Each loss with its gradient, as functions of the hyperparameter and λ."""
    rows = measurements_of_states(*map(jnp.asarray, problem.data))
    partition = partition_of_rows(rows, problem.folds)

    def with_gradient(loss, *extra):
        def value(t, regularization):
            return loss(problem.make(t), rows, regularization, *extra, basis=basis)

        return jax.jit(jax.value_and_grad(value, argnums=(0, 1)))

    return {
        "folds": with_gradient(partition_loss, partition),
        "likelihood": with_gradient(log_likelihood),
        "generalized": with_gradient(generalized_loss),
    }


def errors(problem: Problem, basis, losses, condition: float) -> dict[str, float]:
    """The relative error of each loss and of its gradient; inf where the library says so."""
    X, Y = map(jnp.asarray, problem.data)
    N, n = X.shape
    partition, zero = Partition(N, problem.folds), jnp.zeros(())
    made = gram_of(basis, problem.make, X)
    rows, slope = jax.jvp(made, (zero,), (jnp.ones(()),))
    rows, slope, y = exact(rows), exact(slope), exact(Y).reshape(-1)
    moved = rows + STEP * slope
    G, G_moved = (rows, moved) if basis is None else (rows @ rows.T, moved @ moved.T)
    largest = np.linalg.eigvalsh(G.astype(float))[-1]
    share = 1 - 1 / len(partition.folds)
    found = {}
    for name, reference, points in (
        ("folds", lambda G, r: refitted(G, r, y, partition.labels, n), N * share),
        ("likelihood", lambda G, r: likelihood(G, r, y), N),
        ("generalized", lambda G, r: generalized(G, r, y), N),
    ):
        regularization = largest / condition / points
        value, (by_t, by_ridge) = losses[name](zero, jnp.asarray(regularization))
        ridge = arb(float(points)) * arb(float(regularization))
        truth = reference(G, ridge)
        truth_t = (reference(G_moved, ridge) - truth) / STEP
        truth_ridge = (reference(G, ridge * (1 + STEP)) - truth) / STEP
        if not np.isfinite(value):
            found[name] = found[f"{name}'"] = np.inf
            continue
        # Derivatives with respect to logarithms, relative to the larger of them and the loss.
        scale = max(abs(float(each)) for each in (truth, truth_t, truth_ridge))
        slopes = (by_t, truth_t), (by_ridge * regularization, truth_ridge)
        found[name] = abs(float(arb(float(value)) - truth)) / abs(float(truth))
        found[f"{name}'"] = max(abs(float(arb(float(a)) - b)) for a, b in slopes) / scale
    return found


def allowed(condition: float) -> float:
    return 100 * EPS * condition + 1e-10 if condition <= 1.01e13 else 1.0


def triangle_error(S: np.ndarray, method: Callable[..., Any]) -> float:
    """The largest relative error of what least squares in the columns of S = (Φ, y) needs."""
    features, y = exact(S[:, :-1]), exact(S[:, -1])
    w, log_det = solved(features.T @ features, (features.T @ y)[:, None])
    misfit = y - features @ w[:, 0]
    R = np.asarray(jax.jit(method)(jnp.asarray(S)))
    made = np.linalg.solve(R[:-1, :-1], R[:-1, -1]), R[-1, -1] ** 2
    w, square = w[:, 0].astype(float), float(misfit @ misfit)
    log_det_error = abs(2 * np.log(np.abs(np.diagonal(R)[:-1])).sum() - float(log_det))
    of_weights = np.linalg.norm(made[0] - w) / np.linalg.norm(w)
    return max(of_weights, abs(made[1] / square - 1), log_det_error)


def print_triangles(conditions: tuple[float, ...]) -> None:
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.normal(size=(rows, 11)))[0] for rows in (60, 11))
    stacks = []
    for condition in conditions:
        features = U * np.logspace(0, -np.log10(condition), 11) @ V.T
        y = features @ rng.normal(size=11) + 1e-3 * rng.normal(size=60)
        stacks.append(np.column_stack([features, y]))
    for name, method in (("reflections", householder_triangle), ("products", cholesky_triangle)):
        line = "".join(f"{triangle_error(S, method):>10.1e}" for S in stacks)
        print(f"{'triangle of ' + name:<32}{line}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="three conditions only")
    quick = parser.parse_args().quick
    conditions = (1e4, 1e10, 1e13) if quick else (1e2, 1e4, 1e6, 1e8, 1e10, 1e12, 1e13, 1e14, 1e15)
    print(f"{'condition':<32}" + "".join(f"{c:>10.0e}" for c in conditions))
    print(f"{'allowed':<32}" + "".join(f"{allowed(c):>10.1e}" for c in conditions))
    print_triangles(conditions)
    missed = 0
    for problem in problems():
        for kind, basis in bases(problem, problem.make(jnp.zeros(()))).items():
            losses = compiled(problem, basis)
            table = [errors(problem, basis, losses, c) for c in conditions]
            for what, names in (("value", 0), ("gradient", 1)):
                line = [max(list(each.values())[names::2]) for each in table]
                flags = [
                    e > allowed(c) and e != np.inf for e, c in zip(line, conditions, strict=True)
                ]
                missed += sum(flags)
                cells = "".join(
                    f"{e:>9.1e}{'*' if flag else ' '}" for e, flag in zip(line, flags, strict=True)
                )
                print(f"{problem.name + ', ' + kind + ', ' + what:<36}{cells}", flush=True)
    print(f"{missed} entries (*) are worse than allowed.")


if __name__ == "__main__":
    main()
