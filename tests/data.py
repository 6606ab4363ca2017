"""Data that several files of tests fit."""

import numpy as np


def swings(N, n=2, seed=0, noise=0.01):
    """Velocities of n/2 pendulums of a strength that grows with q², at random states."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, size=(N, n))
    q, p = X[:, : n // 2], X[:, n // 2 :]
    velocity = np.concatenate([p, -np.sin(q) * (1 + q**2 / 4)], axis=1)
    return X, velocity + noise * rng.normal(size=X.shape)
