"""Whether, of hyperparameters whose losses cannot be told apart, the smoother field is the better.

    python tests/benchmarks/tuning_ties.py [--seeds 6]

A pendulum at 24 random states, or on three runs of ten, with noise of 0, 1 and 10 %. Over a grid of
the lengthscale and λ that rounding allows, the field error of the point of least five-fold loss is
compared with that of four rules: among the points within one standard error, over folds or of the
paired differences of points, the longest lengthscale or the largest λ. NumPy alone, so that no
search is in the way.
"""

import argparse
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

FOLDS, EPS = 5, np.finfo(float).eps
LENGTHSCALES, RIDGES = np.geomspace(0.3, 30, 22), np.geomspace(100 * EPS, 10, 24)


class Judged(NamedTuple):
    """A point of the grid: folds (FOLDS,) and points (N,) hold mean squares of residuals."""

    lengthscale: float
    ridge: float
    size: float  # of what rounds, as `SearchObjective.rounding_penalty` has it
    folds: np.ndarray
    points: np.ndarray
    error: float


def field(x: np.ndarray) -> np.ndarray:
    return np.stack([x[..., 1], -np.sin(x[..., 0])], axis=-1)


def run(start, length: float, count: int) -> np.ndarray:
    times = np.linspace(0, length, count)
    return solve_ivp(lambda t, x: field(x), (0, length), start, t_eval=times, rtol=1e-9).y.T


def gram(X: np.ndarray, Z: np.ndarray, ell: float) -> np.ndarray:
    """That of a symplectic Gaussian kernel, (2 N, 2 M)."""
    d = X[:, None] - Z[None]
    k = np.exp(-np.sum(d**2, axis=-1) / (2 * ell**2))
    second = np.eye(2) / ell**2 - d[..., :, None] * d[..., None, :] / ell**4
    J = np.array([[0.0, 1.0], [-1.0, 0.0]])
    blocks = np.einsum("ac,ijcd,bd->iajb", J, second * k[..., None, None], J)
    return blocks.reshape(2 * len(X), 2 * len(Z))


def data(kind: str, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States, velocities and the states to test at."""
    rng = np.random.default_rng(seed)
    if kind == "random":
        X = rng.uniform(-2.5, 2.5, (24, 2))
        return X, field(X) + noise * rng.normal(size=X.shape), rng.uniform(-2, 2, (200, 2))
    X = np.concatenate([run(start, 3.0, 10) for start in ((0.8, 0), (1.6, 0.3), (2.2, -0.5))])
    Y = field(X) + noise * rng.normal(size=X.shape)
    new = np.concatenate([run(start, 6.0, 50) for start in ((1.2, 0), (1.9, 0))])
    return X + noise * rng.normal(size=X.shape), Y, new


def judged(X: np.ndarray, Y: np.ndarray, new: np.ndarray, ell: float, share: float) -> Judged:
    """The point with Nλ = share · tr(G)."""
    N, y, G = len(X), Y.ravel(), gram(X, X, ell)
    ridge, labels = share * np.trace(G), np.repeat(np.arange(N) * FOLDS // N, 2)
    inverse = np.linalg.inv(G + (1 - 1 / FOLDS) * ridge * np.eye(2 * N))
    a, residuals = inverse @ y, np.empty(2 * N)
    for fold in range(FOLDS):
        out = labels == fold
        residuals[out] = np.linalg.solve(inverse[np.ix_(out, out)], a[out])
    size = np.linalg.norm(a) * np.trace(G) * EPS**0.5 / np.linalg.norm(y)
    folds = np.array([np.mean(residuals[labels == fold] ** 2) for fold in range(FOLDS)])
    points = np.mean(residuals.reshape(N, 2) ** 2, axis=1)
    f = gram(new, X, ell) @ np.linalg.solve(G + ridge * np.eye(2 * N), y)
    error = np.linalg.norm(f - field(new).ravel()) / np.linalg.norm(field(new))
    return Judged(ell, share, float(size), folds, points, float(error))


def deviation_of_mean(values: np.ndarray) -> float:
    return float(np.std(values, ddof=1) / len(values) ** 0.5)


def chosen(points: list[Judged]) -> dict[str, float]:
    """The field error of each rule, and the least there is."""
    best = min(points, key=lambda p: np.log(p.folds.mean()) + max(float(np.log(p.size)), 0.0) ** 2)
    sound = [p for p in points if p.size <= max(1.0, best.size)]
    most = best.folds.mean() + deviation_of_mean(best.folds)
    near = [p for p in sound if p.folds.mean() <= most]
    paired = [p for p in sound if (d := p.points - best.points).mean() <= deviation_of_mean(d)]

    def longest(p: Judged) -> tuple[float, float]:
        return p.lengthscale, -float(p.folds.mean())

    def largest(p: Judged) -> tuple[float, float]:
        return p.ridge, -float(p.folds.mean())

    return {
        "least loss": best.error,
        "folds, longest": max(near, key=longest).error,
        "folds, largest λ": max(near, key=largest).error,
        "points, longest": max(paired, key=longest).error,
        "points, largest λ": max(paired, key=largest).error,
        "best of the grid": min(p.error for p in points),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    seeds = parser.parse_args().seeds
    for kind in ("random", "runs"):
        for noise in (0.0, 0.01, 0.1):
            answers = []
            for seed in range(seeds):
                X, Y, new = data(kind, noise, seed)
                grid = [(ell, share) for ell in LENGTHSCALES for share in RIDGES]
                answers.append(chosen([judged(X, Y, new, *point) for point in grid]))
            medians = {name: np.median([each[name] for each in answers]) for name in answers[0]}
            shown = "   ".join(f"{name} {value:.3g}" for name, value in medians.items())
            print(f"{kind:6s} noise {noise:4.2f}   {shown}", flush=True)


if __name__ == "__main__":
    main()
