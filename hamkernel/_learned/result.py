"""Results of `learn`: `Learned`, and what it shares with a learned machine."""

from __future__ import annotations

import abc
import warnings
from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from hamkernel import _require as require
from hamkernel._features import is_of_parts
from hamkernel._fields.base import known_part
from hamkernel._learned.score import Score, compute_score
from hamkernel._machine import full_precision
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._posterior import Posterior, condition
from hamkernel._runs.preprocessing import preprocess
from hamkernel._runs.runs import Runs
from hamkernel._runs.table import Diagnostics
from hamkernel._show import Shown, describe, has_arrays, numbers, text
from hamkernel._solvers.nystrom import Nystrom
from hamkernel._structures.base import AbstractMatrixKernel, Sum, matrix_kernel
from hamkernel._structures.friction import Friction, damped_coordinates
from hamkernel._structures.joined import InputMatrix


class Iteration(eqx.Module):
    """One iteration.

    Attributes:
        samples: in the longest segment.
        objective: ‖W(x − x̂)‖² + ‖f‖² after it, over the segments that were kept, shape ().
        gain: by how much it went down at these hyperparameters, shape ().
        step: the share of the step that was taken, 0 where none made it smaller, shape ().
        noise: σ of each coordinate, shape (n,).
        process_noise: q of each coordinate, shape (n,).
        kept: the share of the samples in segments that were kept, shape ().
        loss: −log p of the rows, but for a constant, shape ().
    """

    samples: int = eqx.field(static=True)
    objective: Float[Array, ""]
    gain: Float[Array, ""]
    step: Float[Array, ""]
    noise: Float[Array, " n"]
    process_noise: Float[Array, " n"]
    kept: Float[Array, ""]
    loss: Float[Array, ""]

    def __repr__(self) -> str:
        return describe(self)


class AbstractEvidence(eqx.Module):
    """The evidence of learned runs."""

    @property
    @abc.abstractmethod
    def log_p(self) -> float:
        """The log marginal likelihood of the rows, up to a constant that no kernel changes."""

    @abc.abstractmethod
    def gain(self, part: AbstractMatrixKernel) -> float:
        """The gain in log p from `part` as one more term of the drift."""


class AbstractLearned(Shown, eqx.Module):
    """A result of `learn`.

    Attributes:
        noise: the standard deviation of the sensor noise of each coordinate.
        states: the fitted path of each run at its times, shape (T, n).
        converged: whether the field may be used.
        diagnostics: a table with one row for each question.
        runs: the runs of the caller.
        again: a function of runs that calls `learn` with the same other arguments.
    """

    noise: eqx.AbstractVar[Float[Array, " k"]]
    states: eqx.AbstractVar[tuple[Float[Array, "T n"], ...]]
    converged: eqx.AbstractVar[bool]
    diagnostics: eqx.AbstractVar[Diagnostics]
    runs: eqx.AbstractVar[Runs]
    again: eqx.AbstractVar[Callable[[Runs], Self]]

    @property
    def _headline(self) -> str:
        """The size of the data, and whether to use the field."""
        count, is_known = len(self.states), has_arrays(self.states)
        samples = sum(len(x) for x in self.states) if is_known else "unknown"
        of = f"{type(self).__name__} from {count} run{'s' * (count != 1)}, {samples} samples"
        return f"{of}: {'usable' if self.converged else 'do not use this field'}"

    @property
    def _shortfalls(self) -> list[tuple[str, str]]:
        """The rows of diagnostics that fall short, as printed."""
        short = [f"{name}: {self.diagnostics[name].meaning}" for name in self.diagnostics.failing]
        return [("falls short", line) for line in short or ["nothing"]]

    @abc.abstractmethod
    def plot(self, run: int = 0) -> Any:
        """One figure of one run, as a Matplotlib figure."""

    @full_precision
    def score(self, runs: Runs | None = None, *, first: int = 10, draws: int = 64) -> Score:
        """Compare free runs of the field with runs, beside a linear model and the last value.

            print(learned.score(hk.Runs(times, states)))

        Each free run begins at the state that fits the first few samples of its run best, and uses
        no later sample.

        Args:
            runs: runs that were not used to learn, positions alone if need be. If None, `score`
                holds out the last fifth of each run, learns again from the rest, in the time that
                learning took, and scores the new field.
            first: the number of samples that a free run knows; half of the run if it is shorter
                than 2 `first`.
            draws: the number of fields drawn from the posterior for `coverage`; 0 for no bands.

        Returns:
            A `Score`.

        Raises:
            TypeError: `runs` are no `Runs`, or have inputs or parameters where the learned ones
                have none, or the other way round. ValueError: their dimension is another; no run
                has ten samples, of which a fifth could be held out.
        """
        first, draws = require.count(first, "first"), require.count(draws, "draws", least=0)
        if runs is None:
            lengths = [len(t) for t in self.runs.times]
            if max(lengths) < 10:
                raise ValueError(
                    "no run has ten samples, of which the last fifth could be held out: pass runs "
                    "that were not learned from, learned.score(runs)."
                )
            cuts = [T - T // 5 if T >= 10 else T for T in lengths]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # learning from all samples gave the same warnings
                rest = self.again(self.runs.part([slice(0, cut) for cut in cuts]))
            last = self.runs.part([slice(cut, None) for cut in cuts])
            return rest.score(last, first=first, draws=draws)
        if not isinstance(runs, Runs):
            raise TypeError(f"score takes hk.Runs(times, states); got a {type(runs).__name__}.")
        for name in ("inputs", "parameters"):
            if (getattr(runs, name) is None) != (getattr(self.runs, name) is None):
                has, lacks = (
                    ("the learned", "these")
                    if getattr(runs, name) is None
                    else ("these", "the learned")
                )
                raise TypeError(f"{has} runs have {name} and {lacks} have none; both need them.")
        n = self.states[0].shape[1]
        if 2 * runs.dimension == n:
            runs = runs.with_momenta()
        if (runs.dimension, runs.input_count) != (n, self.runs.input_count):
            raise ValueError(
                f"the runs have {runs.dimension} coordinates and {runs.input_count} inputs; the "
                f"learned ones have {n} and {self.runs.input_count}."
            )
        return self._score(runs, first, draws)

    @abc.abstractmethod
    def _score(self, runs: Runs, first: int, draws: int) -> Score:
        """The score on runs with the coordinates and inputs of the learned ones."""


class Learned(AbstractLearned):
    """The field that `learn` found, with the paths, the noise and the diagnostics.

    Attributes:
        field: the learned field, the mean included.
        kernel: the kernel with its hyperparameters, and an amplitude.
        regularization: λ with Nλ = 1, N the number of `observations`, which are divided by their
            noise; the amplitude of the field is in `kernel`.
        noise: the standard deviation of the sensor noise of each coordinate, shape (n,); NaN where
            nothing was measured.
        process_noise: the intensity q of the process noise w in ẋ = f + w, for each coordinate, in
            units of the states over √time, shape (n,); 0 if there is none.
        states: the fitted path of each run at its times, missing coordinates filled in, (T, n).
        kept: the share of the samples of each run from which the field is learned, shape (R,).
        dropped: the parts of the runs from which the field is not learned, each as (run, first
            sample, last sample + 1).
        pushed: the parts of the runs, in the same form, in which something pushed the system that
            is neither in the log nor in the field. These parts have little weight.
        misfit: for each run and coordinate the root mean square of (measured − fitted)/σ, shape
            (R, n). It is about 1 if the structure explains the run, NaN where nothing was measured.
        chi_squared: the sum of all squares of (measured − fitted)/σ over the degrees of freedom
            that the fit leaves, shape (). It carries no information if σ was estimated from the
            same residuals. If process noise was found, `chi_squared` belongs to the field without
            process noise; if it was given, to the innovations.
        innovations: the error of predicting each sample from all earlier samples, in standard
            deviations, for each run, (T, n); NaN where nothing was measured or the sample was
            dropped. If model and noise are right, innovations are independent and N(0, 1). In fast
            logs `learn` averages samples, and each mean has one innovation.
        whiteness: the probability that independent innovations are as correlated as these, by the
            test of Ljung and Box over ten lags, shape (). Below .05 the structure, or the timing
            of inputs, leaves residuals that persist from sample to sample. `converged` is then
            False if bands are more than 1.2 times too narrow. Coordinates with a noise of less than
            a millionth of the states are taken for exact and not judged.
        widening: the factor on the variance of the noise in `posterior`, shape (): the peak of the
            spectrum of the innovations over ten lags, 1 if they are white.
        disturbance: the mean of w from each sample to the next, given all samples, for each run,
            (T, n); 0 without process noise.
        history: the iterations, one entry for each.
        converged: whether the field may be used: True unless a row of `diagnostics` that decides
            falls short. Runs that never cross, such as one orbit, cannot refute a structure; test
            the field on a run between them, with `score`.
        diagnostics: a table with one row for each question: do the iterations settle, does noise
            explain most of the motion, are residuals white, is friction missing, and others;
            `.failing` has the names of the rows that fall short.
        runs: the runs of the caller.
        observations: linear functionals of the field with independent noise of variance one, which
            contain all information of the runs near the fitted paths; unknown starts are projected
            out. `hk.fit(kernel, observations, regularization=regularization)` is the exact fit, and
            `field` its approximation on landmarks. None if there were too few samples.
        mean: the known part of the field, if one was given.
        evidence: the rows along the paths with their likeliest model; see `log_evidence`, `gain`.
        again: a function of the runs that calls `learn` with the same other arguments.
    """

    field: Any
    kernel: AbstractMatrixKernel
    regularization: Float[Array, ""]
    noise: Float[Array, " n"]
    process_noise: Float[Array, " n"]
    states: tuple[Float[Array, "T n"], ...]
    kept: Float[Array, " R"]
    dropped: tuple[tuple[int, int, int], ...] = eqx.field(static=True)
    pushed: tuple[tuple[int, int, int], ...] = eqx.field(static=True)
    misfit: Float[Array, "R n"]
    chi_squared: Float[Array, ""]
    innovations: tuple[Float[Array, "T n"], ...]
    whiteness: Float[Array, ""]
    widening: Float[Array, ""]
    disturbance: tuple[Float[Array, "T n"], ...]
    history: tuple[Iteration, ...]
    converged: bool = eqx.field(static=True)
    diagnostics: Diagnostics = eqx.field(static=True)
    runs: Runs
    observations: AbstractObservations | None
    mean: Any
    evidence: AbstractEvidence
    again: Callable[..., Learned]

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        noisy = bool(np.any(np.asarray(self.process_noise)))
        table = {row.name: row for row in self.diagnostics}
        is_known = has_arrays((self.noise, self.runs.states)) and require.is_concrete(self.field)
        rows = [
            ("kernel", text(self.kernel)),
            *(_coefficients(self.field, self.runs.coordinate_names) if is_known else ()),
            ("noise", numbers(self.noise)),
            ("process noise", numbers(self.process_noise) if noisy else "none"),
        ]
        rows += [(name, table[name].value) for name in ("iterations", "free run") if name in table]
        rows += self._shortfalls
        rows.append(("next", ".plot(), .score(), .diagnostics, hk.simulate(learned.field, x0, ts)"))
        return self._headline, rows

    def _repr_html_(self) -> str:
        import hamkernel  # the door to pictures, which load Matplotlib

        return super()._repr_html_() + hamkernel.plot.thumbnail(self)

    @property
    @full_precision
    def posterior(self) -> Posterior:
        """The Gaussian process of the field given the runs: bands, samples, updates.

        The posterior is `hk.condition` on the observations: exact up to 3000 rows, and on the
        landmarks of the field above. Starts are integrated out, hyperparameters plugged in. If
        innovations are correlated, the variance of the noise is multiplied by `widening`, and the
        mean is somewhat smoother than `field`. Each call makes a new posterior: keep it.

        Bands assume that the true field is a field of `kernel`. They do not include forces that
        no such field has, such as a force that repeats within less than a lengthscale, or a gain
        that a flexible part changes with the frequency. If you know of one, condition a kernel that
        has it on `observations`, at the cost of a solve: `hk.condition(more, learned.observations,
        regularization=learned.regularization * learned.widening, mean=learned.mean)`.

        Raises:
            ValueError: the runs had too few samples to learn from.
        """
        if self.observations is None:
            raise ValueError("no run had enough samples to say anything of the field.")
        rows = sum(len(targets) for _, targets in self.observations.parts())
        return self._posterior(on_landmarks=rows > 3000)

    def _posterior(self, on_landmarks: bool) -> Posterior:
        # With inputs, the field as a function of the points (x, u). A posterior in the features of
        # laws has few unknowns.
        points = getattr(getattr(self.field, "whole", self.field), "points", None)
        is_exact = points is None or not on_landmarks or is_of_parts(self.kernel)
        solver = None if is_exact else Nystrom(points=points)
        assert self.observations is not None
        return condition(
            self.kernel,
            self.observations,
            regularization=self.regularization * self.widening,
            solver=solver,
            mean=self.mean,
        )

    @full_precision
    def sample_disturbance(
        self, key: Key[Array, ""], ts: Float[ArrayLike, " T"]
    ) -> Float[Array, "T n"]:
        """Draw the process noise w: normal, with standard deviation q/√h, constant over a step h.

        Simulations with w have bands that include the model error as well as that of the field:

            fields = learned.posterior.sample(key, 64, region)
            w = jax.vmap(lambda k: learned.sample_disturbance(k, ts))(jax.random.split(key, 64))
            runs = jax.vmap(
                lambda f, w: hk.simulate(lambda x, w: f(x) + w, x0, ts, inputs=w).ys
            )(fields, w)

        With inputs u (T, m) join both: `lambda x, s: f(x, s[:m]) + s[m:]` and
        `inputs=jnp.concatenate([u, w], axis=1)`.

        Args:
            key: the random key.
            ts: times, shape (T,), increasing.

        Returns:
            w, shape (T, n); zero without process noise.
        """
        h = jnp.diff(jnp.asarray(ts, self.noise.dtype))
        h = jnp.append(h, h[-1:])[:, None]
        draws = jax.random.normal(key, (len(h), len(self.noise)), self.noise.dtype)
        return self.process_noise[None] * draws / jnp.sqrt(h)

    @property
    def log_evidence(self) -> float:
        """The log marginal likelihood of the runs along the fitted paths, up to a constant.

        Compare results from the same samples: the constant is the same for every kernel, mean,
        `between=` and `delay=`, and the largest value explains the samples best. A model with r
        more hyperparameters needs an advantage of more than r/2 · log N, for N samples.
        """
        return self.evidence.log_p

    @full_precision
    def gain(self, part: AbstractMatrixKernel) -> float:
        """The rise of `log_evidence` if `part` is added to the drift, at least 0.

            learned.gain(hk.Friction())              # is there friction?
            learned.gain(hk.Symplectic(hk.Gaussian()))  # forces that depend on velocities?

        `gain` searches the hyperparameters of all parts again, along the same paths, in about the
        time of one iteration of `learn`. A gain below ½ log N for each hyperparameter of `part`,
        N the number of samples, means that the runs do not need the part.

        Args:
            part: a matrix-valued kernel for states with the same number of coordinates. In a field
                with inputs the part is added to the drift.

        Raises:
            TypeError: `part` is no matrix-valued kernel. ValueError: its dimension is another, or
                the field is that of a family, each term of which has a kernel of its own.
        """
        return self.evidence.gain(matrix_kernel(part))

    def _score(self, runs: Runs, first: int, draws: int) -> Score:
        mean = known_part(self.kernel, self.mean, runs.dimension, jnp.float64)
        field = getattr(self.field, "whole", self.field)  # of the points (x, u) with inputs
        sample = None
        if draws and self.observations is not None:
            with warnings.catch_warnings():
                # Whether the landmarks are enough is a row of `diagnostics`.
                warnings.simplefilter("ignore")
                sample = self._posterior(on_landmarks=True).sample
        data = preprocess(self.runs, mean)
        noise, process = np.asarray(self.noise), np.asarray(self.process_noise)
        return compute_score(field, mean, data, runs, first, noise, process, sample, draws)

    def plot(self, run: int = 0, held_out: Runs | None = None) -> Any:
        """Draw one figure: fit, residuals in units of the noise, force with its band, free run.

        The figure is the result of `hk.plot.result`.

        Args:
            run: the run in the upper half, counted from 0, or from the end if negative.
            held_out: runs that were not used to learn; the figure shows a free run of the first.

        Returns:
            The Matplotlib figure.
        """
        import hamkernel  # the door to pictures, which load Matplotlib

        return hamkernel.plot.result(self, run, held_out)

    @property
    def residuals(self) -> tuple[Float[Array, "T n"], ...]:
        """(measured − fitted)/σ for each run, NaN where nothing was measured."""
        pairs = zip(self.runs.states, self.states, strict=True)
        return tuple((jnp.asarray(x) - fit) / self.noise[None] for x, fit in pairs)


def _coefficients(field: Any, names: tuple[str, ...]) -> list[tuple[str, str]]:
    """The friction and the constant input matrix that were found.

    The numbers of the kernel are prior standard deviations and variances, not coefficients.
    """
    drift, rows = getattr(field, "drift", field), []
    x = jnp.ones(len(names))
    for i, term in enumerate(drift.kernel.terms if isinstance(drift.kernel, Sum) else ()):
        if isinstance(term, Friction):
            damped = list(damped_coordinates(term.damped, len(x)))
            share = (-drift.part(i)(x) / term.curve(x))[np.array(damped)]
            scales = {"viscous": term.viscous, "dry": term.coulomb, "Stribeck": term.stribeck}
            said = [f"{k} {text(share * c)}" for k, c in scales.items() if c is not None]
            places = ", ".join(names[c] for c in damped)
            rows.append(("friction", f"{', '.join(said)} on coordinate {places}"))
    G = getattr(getattr(field, "kernel", None), "inputs", None)
    if isinstance(G, InputMatrix) and not frozenset().union(*G.kernel.supports(len(x))):
        lines = zip(np.asarray(field.input_matrix(x)), names, strict=True)
        said = [f"{text(line)} on coordinate {name}" for line, name in lines if line.any()]
        rows.append(("input matrix", ", ".join(said)))
    return rows


def misfits(runs: Runs, states: list[np.ndarray], noise: np.ndarray) -> np.ndarray:
    """Root mean squares of the normalised residuals, by run and coordinate."""
    out = []
    for x, fit in zip(runs.host_arrays()[1], states, strict=True):
        squares = ((x - fit) / noise[None]) ** 2
        measured = np.isfinite(squares)
        total, count = np.where(measured, squares, 0.0).sum(axis=0), measured.sum(axis=0)
        out.append(np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan))
    return np.array(out)


def empty(n: int) -> Float[Array, "0 n"]:
    """No residuals: an empty array."""
    return jnp.zeros((0, n))
