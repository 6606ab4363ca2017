"""Whether innovations are white, and what their correlation costs."""

from typing import NamedTuple

import numpy as np
from jax.scipy.special import gammaincc
from jaxtyping import Float


class Whiteness(NamedTuple):
    """The correlation of innovations from sample to sample, and what it costs.

    Attributes:
        probability: the probability that white innovations are as correlated, by the test of Ljung
            and Box; 1 where there are too few.
        peak: the largest value of their spectra 1 + 2 Σ_k (1 − k/11) r_k cos(kω), k = 1 to 10; 1
            where they are white.
        neighbours: the correlation of innovations at lag one, by coordinate, shape (n,).
    """

    probability: float
    peak: float
    neighbours: Float[np.ndarray, " n"]

    @property
    def is_enough(self) -> bool:
        """Whether the innovations are as good as white.

        False alarms are 5 % of logs. The noise of a part of the motion that is in one frequency is
        as much larger as the spectrum there; up to 1.44, a deviation of 1.2, at least 90 % lies
        inside of two of the deviations that are said, for 95 %. Of 2e5 innovations a correlation of
        .01 would be significant.
        """
        return self.probability >= 0.05 or self.peak < 1.44

    @property
    def widening(self) -> float:
        """The factor on the variance of noise in the posterior, the peak of the spectrum.

        A field that varies along the runs with one frequency meets the noise at that frequency. On
        the log of a drive with friction, cogging and late inputs the root of the peak is 3.0, 2.4
        and 2.5 for three models. With an Ornstein-Uhlenbeck disturbance, which whitens the
        innovations and needs a state more, the deviation of the gain is 2.8, 2.6 and 3.0 times as
        large, and the gain as wrong (`tests/benchmarks/disturbances.py`).

        It does not stand for forces that repeat with the state, which are no scatter: of a drive
        with cogging .23 of the drift are inside two deviations (`tests/benchmarks/machines.py`). A
        covariance from the scores of blocks of the runs, the sandwich of Liang and Zeger, would not
        either: it is about the field that the kernel comes nearest to. With a term of the kernel
        for them, whose force and length were given, it is .92.
        """
        return 1.0 if self.is_enough else self.peak


def whiteness(z: Float[np.ndarray, "S L+1 n"], counts: Float[np.ndarray, "S L+1 n"]) -> Whiteness:
    """How white the innovations z are, by segment, sample and coordinate.

    The first n measured entries of a segment know its start, and say nothing here.
    """
    S, n = len(z), z.shape[2]
    seen = counts > 0
    used = seen & (np.cumsum(seen.reshape(S, -1), axis=1).reshape(z.shape) > n)
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
    probability = float(gammaincc(lags / 2, statistic / 2)) if lags else 1.0
    return Whiteness(probability, peak, neighbours)


def autocorrelations(
    series: list[Float[np.ndarray, " T"]],
) -> tuple[Float[np.ndarray, " 10"], Float[np.ndarray, " 10"]]:
    """The autocorrelations of series of mean zero at lags 1 to 10, and the pairs at each lag.

    Both values of a pair are of one series. Where nothing varies there are no pairs.
    """
    total = sum(float(z @ z) for z in series)
    if total == 0:
        return np.zeros(10), np.zeros(10)
    pairs = [[(z[k:], z[:-k]) for z in series if len(z) > k] for k in range(1, 11)]
    counts = np.array([sum(len(a) for a, _ in each) for each in pairs], float)
    sums = np.array([sum(float(a @ b) for a, b in each) for each in pairs])
    return sums / total, counts


def ljung_box(N: int, r: Float[np.ndarray, " K"], counts: Float[np.ndarray, " K"]) -> float:
    """Ljung and Box's statistic of N values, N (N + 2) Σ_k r_k²/N_k.

    N_k are the pairs at lag k, none of them of two series: N − k for a single one.
    """
    return float(N * (N + 2) * (r**2 / counts).sum())
