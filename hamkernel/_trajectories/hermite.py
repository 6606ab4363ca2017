"""States between those that are known with their velocities."""

import numpy as np
from jaxtyping import Float


def interpolated(
    times: np.ndarray, at: np.ndarray, x: np.ndarray, slopes: np.ndarray
) -> Float[np.ndarray, "T n"]:
    """Hermite's cubic through the states x at the times `at`, with their velocities `slopes`."""
    i = np.clip(np.searchsorted(at, times) - 1, 0, len(at) - 2)
    h = (at[i + 1] - at[i])[:, None]
    s = ((times - at[i])[:, None]) / h
    return (
        (1 + 2 * s) * (1 - s) ** 2 * x[i]
        + s * (1 - s) ** 2 * h * slopes[i]
        + s**2 * (3 - 2 * s) * x[i + 1]
        + s**2 * (s - 1) * h * slopes[i + 1]
    )
