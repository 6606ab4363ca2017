"""Families of systems: one model of eight members beside a model of each, and beside one of all.

    python tests/benchmarks/families.py [--seeds 5] [--only points runs …]

Errors are root mean square over fresh states, as a share of the field, medians over seeds. The
family is asked for members it has not seen, halfway between two that it has; the model of each for
the member it was fitted to; the model of all, which ignores θ, for the same unseen members. All
hyperparameters come from `tune(..., objective="marginal_likelihood")`.

Medians of five seeds, family / of each / of all: points .0138/.0262/.24, and .34 outside; even
.0051/.0068/.25; apart .0039/.0068/.25; linear .0042/.14/.81; symmetric .0061/.0067/.25, and .29
outside; driven .0057, and .0039 with inputs.
"""

# pyright: reportArgumentType=false, reportOptionalOperand=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false

import argparse
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hamkernel as hk

OPTIONS: dict[str, Any] = {"objective": "marginal_likelihood", "starts": 4}
LENGTHS = np.linspace(0.5, 1.5, 8)
INSIDE, OUTSIDE = (LENGTHS[:-1] + LENGTHS[1:]) / 2, np.array([0.3, 1.7, 2.0])
NOISE = 0.01


def pendulum(X, length):
    """H = p²/2l² + 9.81 l (1 − cos q), a mass of 1."""
    return np.stack([X[:, 1] / length**2, -9.81 * length * np.sin(X[:, 0])], axis=1)


def two_masses(X, stiffness):
    """Unit masses on springs of this stiffness, coupled by a hardening one."""
    d = X[:, 0] - X[:, 1]
    force = d + 0.5 * d**3
    acting = -stiffness * X[:, :2] + np.stack([-force, force], axis=1)
    return np.concatenate([X[:, 2:], acting], axis=1)


def noisy(Y, rng):
    return Y + NOISE * np.sqrt(np.mean(Y**2, axis=0)) * rng.normal(size=Y.shape)


def states(rng, count, length):
    """With p of the size of that of an orbit of q up to 2.3."""
    return rng.uniform(-1, 1, (count, 2)) * [2.3, 4.0 * length**1.5]


def run(rng, length):
    """12 points on 1.2 s of one orbit."""
    start, ts = [rng.uniform(1.2, 2.3), 0.0], np.linspace(0, 1.2, 12)
    return solve_ivp(lambda t, x: pendulum(x[None], length)[0], (0, 1.2), start, t_eval=ts).y.T


def error(fields, members, fresh, truth):
    """The median over members of the error at fresh states."""
    errors = []
    for member in members:
        X = fresh(member)
        Y = truth(X, member)
        errors.append(np.linalg.norm(fields(member)(X) - Y) / np.linalg.norm(Y))
    return float(np.median(errors))


def compared(K, alike, sampled, truth, members, inside, rng, fresh, outside=()):
    """Errors of the family, of a model of each member, of one of all, and of the family outside."""
    data = [(X, noisy(truth(X, m), rng)) for m in members for X in (sampled(rng, m),)]
    X, Y = (np.concatenate(each) for each in zip(*data, strict=True))
    theta = np.repeat(members, [len(x) for x, _ in data])[:, None]
    family = hk.tune(alike(K), X, Y, parameters=theta, **OPTIONS)
    own = {m: hk.tune(K, *d, **OPTIONS).field for m, d in zip(members, data, strict=True)}
    ignoring = hk.tune(K, X, Y, **OPTIONS).field
    found = [
        error(lambda m: family.field.at([m]).evaluate, inside, fresh, truth),
        error(lambda m: own[m].evaluate, members, fresh, truth),
        error(lambda m: ignoring.evaluate, inside, fresh, truth),
    ]
    if len(outside):
        found.append(error(lambda m: family.field.at([m]).evaluate, outside, fresh, truth))
    return found


def gaussian(n):
    return 1.0 * hk.Gaussian(jnp.full(n, 2.0))


def apart(n):
    """T(p) + U(q)."""
    m = n // 2
    halves = [tuple(range(m, n)), tuple(range(m))]
    return [1.0 * hk.Select(hk.Gaussian(jnp.full(m, 2.0)), half) for half in halves]


def alike(K):
    return hk.Family(K, hk.Gaussian(1.0))


def of_pendulum(K, sampled):
    def measured(seed):
        rng = np.random.default_rng(seed)
        fresh = {m: states(rng, 200, m) for m in (*LENGTHS, *INSIDE, *OUTSIDE)}
        args = (pendulum, LENGTHS, INSIDE, rng, fresh.__getitem__, OUTSIDE)
        return compared(K, alike, sampled, *args)

    return measured


def on_orbits(K, alike=alike):
    """One short run of each, judged where such runs go: |q| and |p| that an orbit reaches."""

    def measured(seed):
        rng = np.random.default_rng(seed)
        fresh = {m: np.concatenate([run(rng, m) for _ in range(8)]) for m in (*LENGTHS, *INSIDE)}
        args = (pendulum, LENGTHS, INSIDE, rng, fresh.__getitem__)
        return compared(K, alike, run, *args)

    return measured


def of_two_masses(K, alike):
    members = np.linspace(0.5, 2.0, 8)

    def measured(seed):
        rng = np.random.default_rng(seed)
        box = np.array([1.5, 1.5, 2.0, 2.0])
        fresh = rng.uniform(-1, 1, (300, 4)) * box
        args = (two_masses, members, (members[1:] + members[:-1]) / 2, rng, lambda m: fresh)
        return compared(K, alike, lambda rng, m: rng.uniform(-1, 1, (12, 4)) * box, *args)

    return measured


def driven(seed):
    """q̈ = q − q³ + 0.4 cos ωt: inputs (cos ωt, sin ωt) beside a family with `Periodic`."""
    rng, omega = np.random.default_rng(seed), 1.3

    def truth(X, t):
        return np.stack([X[:, 1], X[:, 0] - X[:, 0] ** 3 + 0.4 * np.cos(omega * t)], axis=1)

    def drawn(count):
        return rng.uniform(-1.6, 1.6, (count, 2)), rng.uniform(0, 20, count)

    (X, t), (Z, s) = drawn(80), drawn(300)
    Y, Q = noisy(truth(X, t), rng), truth(Z, s)
    K = hk.Symplectic(gaussian(2))
    wave = hk.tune(
        hk.Controlled(K, hk.InputMatrix(1.0, acts_on=(1,))),
        X,
        Y,
        inputs=np.stack([np.cos(omega * t), np.sin(omega * t)], axis=1),
        **OPTIONS,
    ).field
    family = hk.tune(
        hk.Family(K, hk.Periodic(2 * np.pi / omega, 1.0)),
        X,
        Y,
        parameters=t[:, None],
        frozen="period",
        **OPTIONS,
    ).field
    waves = np.stack([np.cos(omega * s), np.sin(omega * s)], axis=1)
    size = np.linalg.norm(Q)
    return [
        np.linalg.norm(family.evaluate(Z, s[:, None]) - Q) / size,
        np.linalg.norm(wave.evaluate(Z, waves) - Q) / size,
    ]


def each_apart(K):
    """T(p; θ) + U(q; θ), with a lengthscale of θ for each."""
    return sum(hk.Family(hk.Odd(hk.Symplectic(k)), hk.Gaussian(1.0)) for k in apart(2))


def linear(K):
    """T(p), shared by all members, and U(q; θ), affine in θ."""
    T, U = apart(4)
    return hk.Family(hk.Symplectic(T)) + hk.Family(hk.Symplectic(U), hk.Polynomial(1))


PLAIN, EVEN = hk.Symplectic(gaussian(2)), hk.Odd(hk.Symplectic(sum(apart(2))))
CASES = {
    "points": ("12 points of each pendulum", of_pendulum(PLAIN, lambda r, m: states(r, 12, m))),
    "symmetric": (
        "the same, odd and reversible",
        of_pendulum(
            hk.Reversible(hk.Odd(hk.Symplectic(gaussian(2)))), lambda r, m: states(r, 12, m)
        ),
    ),
    "few": ("4 points of each pendulum", of_pendulum(PLAIN, lambda r, m: states(r, 4, m))),
    "runs": ("one short run of each pendulum", on_orbits(PLAIN)),
    "even": ("the same, T + U even", on_orbits(EVEN)),
    "apart": ("the same, T and U with a dependence each", on_orbits(EVEN, each_apart)),
    "masses": ("12 points of two masses", of_two_masses(hk.Symplectic(gaussian(4)), alike)),
    "linear": (
        "the same, T(p) + U(q; θ), affine in θ",
        of_two_masses(hk.Symplectic(sum(apart(4))), linear),
    ),
    "driven": ("Duffing with a drive: family, inputs", driven),
}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=list(CASES))
    options = parser.parse_args()
    print(f"{'':42s} family   of each  of all   outside  CPU s a seed")
    for name in options.only:
        title, measured = CASES[name]
        began = time.process_time()
        found = np.median([measured(seed) for seed in range(options.seeds)], axis=0)
        seconds = (time.process_time() - began) / options.seeds
        columns = "".join(f"{value:<9.4f}" for value in found).ljust(36)
        print(f"{title:42s} {columns} {seconds:.1f}", flush=True)


if __name__ == "__main__":
    main()
