"""The whiteness of innovations, and the factor on the noise that makes up for correlation."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Bands are wider below p = .05, which one good log in twenty has. One in a thousand may be refused.
FALSE_ALARMS = 1e-3


class Whiteness(NamedTuple):
    """The correlation of innovations from sample to sample.

    Attributes:
        probability: the probability that white innovations are as correlated, by the test of Ljung
            and Box; 1 if there are too few innovations.
        peak: the largest value of the spectra 1 + 2 Σ_k (1 − k/11) r_k cos(kω) of the coordinates,
            k = 1 to 10; 1 if the innovations are white.
        neighbours: the correlation of innovations at lag one, by coordinate, shape (n,).
    """

    probability: float
    peak: float
    neighbours: Float[np.ndarray, " n"]

    @property
    def is_enough(self) -> bool:
        """Whether the innovations are as good as white.

        The test of Ljung and Box has 5 % false alarms. With many innovations the test is too strict
        (a correlation of .01 is significant for 2e5), so a spectrum below 1.44 passes as well. If a
        part of the motion has one frequency, the spectrum there multiplies the variance of its
        noise. A variance of 1.44 is a standard deviation of 1.2: two of the stated standard
        deviations then still hold 90 % instead of 95 %.
        """
        return self.probability >= 0.05 or self.peak < 1.44

    @property
    def is_refuted(self) -> bool:
        """Whether next to no white innovations are as correlated."""
        return not self.is_enough and self.probability <= FALSE_ALARMS

    @property
    def widening(self) -> float:
        """The factor on the variance of noise in the posterior, the peak of the spectrum.

        A field that varies along the runs with one frequency is disturbed by the noise at that
        frequency. We compared the peak with an Ornstein-Uhlenbeck disturbance, which whitens the
        innovations and needs one more state. On the log of a drive with friction, cogging and late
        inputs the root of the peak is 3.0, 2.4 and 2.5 for three models. The disturbance enlarges
        the standard deviation of the gain by factors of 2.8, 2.6 and 3.0, and leaves the error of
        the gain as it is (`tests/benchmarks/disturbances.py`).

        The factor does not account for forces that repeat with the state, since these do not
        scatter: for a drive with cogging 23 % of the drift is inside two standard deviations
        (`tests/benchmarks/machines.py`). The sandwich covariance of Liang and Zeger would not
        account for them either, since it belongs to the best field within the kernel. With a term
        for the cogging in the kernel, of known force and length, the share is 92 %.
        """
        return 1.0 if self.is_enough else self.peak


def whiteness(z: Float[np.ndarray, "S L+1 n"], counts: Float[np.ndarray, "S L+1 n"]) -> Whiteness:
    """The whiteness of the innovations z, by segment, sample and coordinate.

    The first n measured entries of a segment determine its start and are left out.
    """
    S, n = len(z), z.shape[2]
    measured = counts > 0
    order = np.cumsum(measured.reshape(S, -1), axis=1).reshape(z.shape)
    used = measured & (order > n)
    statistic, lags, peak, neighbours = 0.0, 0, 1.0, np.zeros(n)
    k = np.arange(1, 11)
    waves = np.cos(np.linspace(0, np.pi, 45)[:, None] * k[None]) * (1 - k / 11)[None]
    for c in range(n):
        r, pairs = autocorrelations([z[s, used[s, :, c], c] for s in range(S)])
        neighbours[c] = r[0]
        # From 20 pairs on a correlation is nearly normal.
        r, pairs = r[pairs >= 20], pairs[pairs >= 20]
        statistic += ljung_box(int(used[:, :, c].sum()), r, pairs)
        lags += len(r)
        peak = max(peak, float((1 + 2 * waves[:, : len(r)] @ r).max()))
    from scipy.special import chdtrc  # so that importing the package does not load it

    probability = float(chdtrc(lags, statistic)) if lags else 1.0
    return Whiteness(probability, peak, neighbours)


def autocorrelations(
    series: list[Float[np.ndarray, " T"]],
) -> tuple[Float[np.ndarray, " 10"], Float[np.ndarray, " 10"]]:
    """The autocorrelations of series of mean zero at lags 1 to 10, and the pairs at each lag.

    Both values of a pair belong to one series. If all series are zero there are no pairs.
    """
    total = sum(float(z @ z) for z in series)
    if total == 0:
        return np.zeros(10), np.zeros(10)
    pairs = [[(z[k:], z[:-k]) for z in series if len(z) > k] for k in range(1, 11)]
    counts = np.array([sum(len(a) for a, _ in lagged) for lagged in pairs], float)
    sums = np.array([sum(float(a @ b) for a, b in lagged) for lagged in pairs])
    return sums / total, counts


def ljung_box(N: int, r: Float[np.ndarray, " K"], counts: Float[np.ndarray, " K"]) -> float:
    """Ljung and Box's statistic of N values, N (N + 2) Σ_k r_k²/N_k.

    N_k is the number of pairs at lag k within one series, N − k for a single series.
    """
    return float(N * (N + 2) * (r**2 / counts).sum())
