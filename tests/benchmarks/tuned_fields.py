"""Whether tuned fields can be integrated, with the bound that `tune` puts on λ and without it.

    python tests/benchmarks/tuned_fields.py [--points 40 200]

Random states of three systems, noise of 0, 1 and 10 % of the velocities. For each: λ, the root of
the cross-validation loss, the jitter of the field when a state moves by 1e-14, and whether the
default `simulate` and `GaussLegendre4` reach 20 units of time. "without" asks for a λ as small as
the system can be solved with.
"""

import argparse

import jax

jax.config.update("jax_enable_x64", True)

import diffrax
import jax.numpy as jnp
import numpy as np

import hamkernel as hk

# name: system, half the box that the states are drawn from, where the simulation starts
SYSTEMS = {
    "duffing": (hk.systems.Duffing(), [1.6, 1.6], [1.2, 0.0]),
    "pendulum": (hk.systems.Pendulum(mass=1.0), [2.5, 5.0], [1.0, 0.0]),
    "oscillator": (hk.systems.HarmonicOscillator(), [3.0, 3.0], [1.5, 0.0]),
}
BOUNDS = {"with": None, "without": {"regularization": (1e-30, 1e3)}}
SOLVERS = {"Dopri8": {"max_steps": 5000}, "GL4": {"solver": hk.GaussLegendre4(), "dt": 0.05}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, nargs="+", default=[40, 200])
    failures: dict[str, list[bool]] = {name: [] for name in BOUNDS}
    for name, (system, box, start) in SYSTEMS.items():
        for N in parser.parse_args().points:
            for noise in (0.0, 0.01, 0.1):
                rng = np.random.default_rng(0)
                X = rng.uniform(-1, 1, size=(N, 2)) * box
                Y = np.asarray(jax.vmap(system)(jnp.asarray(X)))
                Y = Y + noise * Y.std() * rng.normal(size=Y.shape)
                for bound, bounds in BOUNDS.items():
                    tuned = hk.tune(hk.Symplectic(hk.Gaussian(1.0)), X, Y, bounds=bounds)
                    near = jnp.asarray(start) + 1e-14 * jnp.asarray(rng.normal(size=(20, 2)))
                    jitter = float(jax.vmap(tuned.field)(near).std(axis=0).max())
                    reached = {}
                    for solver, options in SOLVERS.items():
                        ts = np.linspace(0, 20, 41)
                        options = {**options, "throw": False}
                        run = hk.simulate(tuned.field, jnp.asarray(start), ts, **options)
                        reached[solver] = bool(run.result == diffrax.RESULTS.successful)
                    failures[bound].append(not all(reached.values()))
                    said = ", ".join(f"{s} {'ok' if ok else 'FAILED'}" for s, ok in reached.items())
                    print(
                        f"{name:10s} N = {N:3d} noise {noise:4.2f} {bound:7s} "
                        f"lambda {float(tuned.regularization):8.1e} root loss "
                        f"{float(tuned.loss) ** 0.5:8.2e} jitter {jitter:7.1e}  {said}",
                        flush=True,
                    )
    for bound, failed in failures.items():
        print(f"{bound} the bound: {sum(failed)} of {len(failed)} cannot be integrated")


if __name__ == "__main__":
    main()
