"""White or Ornstein-Uhlenbeck disturbances on the log of a drive: what widening stands for.

    python tests/benchmarks/disturbances.py [--seeds 1] [--first 0]

The drive of `machines.py`, whose cogging and late inputs no kernel says. Its acceleration is a
linear combination of regressors along a smoothed path, with a disturbance w: white of intensity q,
or with one state more, τ ẇ = −w + q times white noise. A Kalman filter in NumPy whitens positions
and regressors, least squares finds the coefficients, and Nelder and Mead σ, q and τ by the marginal
likelihood. Nothing here is of this library. Regressors besides the input and a constant:

- `potential`: six Gaussians of the position;
- `friction`: −v and −tanh(v/.002);
- `smooth friction`: eight Gaussians of the velocity.

Printed: −log p, the gain relative to the true one with its standard deviation, the correlation of
neighbouring innovations, the root of the peak of the spectrum of white w's innovations (as
`Learned.widening` has it), and by how much OU makes the deviation of the gain larger.

Seed 0, potential, friction, smooth friction: gains .32, .95, .88 and with OU .36, .97, .87;
neighbours .96, .80, .86 and .04, −.02, −.00; white w widened by 3.0, 2.4, 2.5 and OU with 2.8, 2.6,
3.0 times the deviation of the gain. OU is likelier by 1586, 601, 833.
"""

import argparse
from typing import Any

import numpy as np
from machines import DRIVE, drive_log
from scipy.linalg import expm
from scipy.optimize import minimize
from scipy.signal import savgol_filter

DT, STEP = 0.02, 1e-6


def regressors(kind, q, v, u) -> np.ndarray:
    columns = [u, np.ones_like(q)]
    if kind == "potential":
        columns += [np.exp(-0.5 * ((q - c) / 0.06) ** 2) for c in np.linspace(q.min(), q.max(), 6)]
    if kind == "friction":
        columns += [-v, -np.tanh(v / 0.002)]
    if kind == "smooth friction":
        columns += [-np.exp(-0.5 * ((v - c) / 0.06) ** 2) for c in np.linspace(v.min(), v.max(), 8)]
    return np.stack(columns, axis=1)


def discretised(log_q, log_tau) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The transition over a sample, the covariance of what w adds (Van Loan), the prior of w."""
    q = np.exp(log_q)
    if log_tau is None:
        A, B, prior = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([0.0, q]), []
    else:
        tau = np.exp(log_tau)
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1 / tau]])
        B, prior = np.array([0.0, 0.0, q / tau]), [q**2 / (2 * tau)]
    n = len(A)
    both = expm(DT * np.block([[-A, np.outer(B, B)], [np.zeros((n, n)), A.T]]))
    F = both[n:, n:].T
    return F, F @ both[:n, n:], np.diag([1e-2, 1.0, *prior])


def whitened(h, data) -> tuple[np.ndarray, float]:
    """Rows of independent noise of variance one, the positions last, and ½ log det of it."""
    F, Q, prior = discretised(h[1], h[2] if len(h) == 3 else None)
    push = np.zeros(len(F))
    push[:2] = DT**2 / 2, DT
    rows, constant = [], 0.0
    for q, R in data:
        P: np.ndarray = prior
        E: np.ndarray = np.zeros((len(F), R.shape[1] + 1))
        E[0, -1] = -q[0]
        for i in range(len(q)):
            e = E[0].copy()
            e[-1] += q[i]
            s = P[0, 0] + np.exp(2 * h[0])
            rows.append(e / np.sqrt(s))
            constant += 0.5 * np.log(s)
            k = P[:, 0] / s
            E, P = E - np.outer(k, e), P - np.outer(k, P[0])
            if i + 1 < len(q):
                E, P = F @ E, F @ P @ F.T + Q
                E[:, :-1] += np.outer(push, R[i])
    return np.array(rows), constant


def solved(h, data) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    rows, constant = whitened(h, data)
    M, r = rows[:, :-1], rows[:, -1]
    system = np.vstack([M, 1e-3 * np.eye(M.shape[1])])
    w = np.linalg.lstsq(system, np.append(r, np.zeros(M.shape[1])), rcond=None)[0]
    return M, r - M @ w, w, float(constant + 0.5 * np.sum((r - M @ w) ** 2))


def learned(data, coloured) -> tuple[float, float, float, float, float]:
    def loss(h):
        return 1e9 if h[0] < np.log(STEP / 12**0.5) else solved(h, data)[3]

    start = np.log([2e-6, 0.01] + [0.1] * coloured)
    options = {"maxfev": 60, "xatol": 0.05, "fatol": 0.1}
    found = minimize(loss, start, method="Nelder-Mead", options=options)
    M, z, w, _ = solved(found.x, data)
    r = np.array([z[k:] @ z[:-k] / (z @ z) for k in range(1, 11)])
    k, omega = np.arange(1, 11), np.linspace(0, np.pi, 45)[:, None]
    peak = (1 + 2 * (np.cos(omega * k) * (1 - k / 11)) @ r).max()
    deviation = np.sqrt(np.linalg.inv(M.T @ M + 1e-6 * np.eye(M.shape[1]))[0, 0])
    return found.fun, w[0] / DRIVE["gain"], deviation / DRIVE["gain"], r[0], np.sqrt(peak)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0)
    asked = parser.parse_args()
    for seed in range(asked.first, asked.first + asked.seeds):
        logs = [drive_log(10 * seed + s) for s in (0, 1)]
        for kind in ("potential", "friction", "smooth friction"):
            data = []
            for _, _, u, log in logs:
                q = log[:, 0]
                path: Any = savgol_filter(q, 7, 3)
                v: Any = savgol_filter(q, 7, 3, deriv=1, delta=DT)
                middle, speed = (path[1:] + path[:-1]) / 2, (v[1:] + v[:-1]) / 2
                data.append((q, regressors(kind, middle, speed, u[:-1, 0])))
            found = {name: learned(data, name == "OU") for name in ("white", "OU")}
            for name, (loss, gain, deviation, neighbours, widening) in found.items():
                print(
                    f"{kind:16} {name:5} -log p {loss:8.0f}  gain {gain:5.3f} ± {deviation:.3f}  "
                    f"neighbours {neighbours:5.2f}  widened by {widening:4.2f}"
                )
            ratio = found["OU"][2] / found["white"][2]
            print(f"{kind:16} OU has {ratio:.2f} times the deviation of the gain", flush=True)


if __name__ == "__main__":
    main()
