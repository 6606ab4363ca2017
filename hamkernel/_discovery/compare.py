"""`compare`: which physics do the data obey? A ladder of structures, judged by their evidence.

Each candidate is a structured kernel, tuned by the marginal likelihood of the same rows. With P
trained numbers and D rows its score is

    log p(rows) − ½ P log D,

the Bayesian information criterion (Schwarz 1978), whose second term is the price of the
hyperparameters. To answer a question we compare the best candidate with the answer yes and the best
candidate with the answer no. The ladder therefore contains every combination of its steps.
Otherwise a candidate could lose one question because it lacks the answer to another. For friction
we compare the best candidate with friction and the candidate that lacks only the friction.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from hamkernel import _require as require
from hamkernel._discovery.ladder import Rung, ladder
from hamkernel._kernels.built_in import Gaussian
from hamkernel._learned.result import Learned
from hamkernel._machine import full_precision, one_blas_thread
from hamkernel._observations.kinds import AbstractObservations
from hamkernel._observations.measurements import Measurements, observations
from hamkernel._show import Shown
from hamkernel._solvers.problem import make_problem
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.structure import DivergenceFree, Separable
from hamkernel._tuning.objective import criterion_of
from hamkernel._tuning.search import Search, best
from hamkernel._tuning.space import RIDGE, SearchSpace, named_values, velocity_rms
from hamkernel._tuning.tune import SEARCH_COPIES, check_finite_loss, decode, warn_of_constants
from hamkernel._validation import check_memory

# A factor of e⁵ = 148 in the evidence. At 5 no confident answer of the prototype was wrong, at 3 up
# to 5 % (`tests/benchmarks/comparison.py`).
THRESHOLD = 5.0

QUESTIONS = {
    "energy": "an energy?",
    "friction": "friction?",
    "mirror": "mirror symmetry?",
    "reversible": "reversible?",
    "T + U": "T(p) + U(q)?",
}


class Candidate(NamedTuple):
    """One row of the table.

    Attributes:
        name: the name of the candidate.
        claims: the questions to which the answer of its structure is yes.
        score: log p − ½ P log D.
        difference: the score minus the best score, at most 0.
        log_likelihood: log p of the rows at the tuned hyperparameters.
        parameters: P, the number of trained numbers, including λ.
        kernel: the tuned kernel.
        regularization: the tuned λ.
        hyperparameters: the tuned values by name.
    """

    name: str
    claims: frozenset[str]
    score: float
    difference: float
    log_likelihood: float
    parameters: int
    kernel: AbstractMatrixKernel
    regularization: Float[Array, ""]
    hyperparameters: dict[str, Any]


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """The candidates by score, and the answers to the questions, as a report.

    Attributes:
        table: the candidates, the best first.
        answers: "yes", "no", "undecided" or "not tested" for each of the questions "energy",
            "friction", "mirror", "reversible" and "T + U".
        reasons: a sentence for each answer.
        differences: the score of the best yes minus the score of the best no; NaN if not tested.
        rows: D, the number of measured values.
    """

    table: tuple[Candidate, ...]
    answers: dict[str, str]
    reasons: dict[str, str]
    differences: dict[str, float]
    rows: int

    @property
    def best(self) -> Candidate:
        """The candidate with the largest score."""
        return self.table[0]

    def _summary(self) -> tuple[str, list[tuple[str, str]]]:
        findings = [
            (question, f"{self.answers[key]:12s}{self.reasons[key]}")
            for key, question in QUESTIONS.items()
        ]
        findings += [("", ""), ("candidate", "difference  log likelihood  numbers")]
        for row in self.table:
            numbers = f"{row.difference:10.1f}  {row.log_likelihood:14.1f}  {row.parameters:7d}"
            findings.append((row.name, numbers))
        return f"Which physics do these {self.rows} values obey?", findings


@full_precision
def compare(
    X: Num[ArrayLike, "N n"] | AbstractObservations | Learned,
    Y: Num[ArrayLike, "N n"] | None = None,
    candidates: Mapping[str, AbstractMatrixKernel] | None = None,
    *,
    starts: int = 4,
    progress: bool = False,
) -> Comparison:
    """Compare structures by their evidence, and answer which physics the data obey.

    Is there an energy H(q, p)? Is there friction? Is the field odd, f(−x) = −f(x)? Is the motion
    reversible, H(q, −p) = H(q, p)? Is H = T(p) + U(q)? An answer is "yes" or "no" if the scores
    differ by more than 5, a factor of 148 in the evidence; else "undecided". The answer is "not
    tested" in two cases:

    - A symmetry, if less than a tenth of the points have another point within a standard deviation
      of their image.
    - Friction, reversibility and T + U, if there is no energy.

    If the scores do not decide on friction, the answer is "no" if the best friction is within one
    deviation of zero. If there is friction, the answer to reversibility is "no".

    Do not pass velocities from smoothed noisy runs: a third of the confident answers was then
    wrong. Learn once, with the weakest kernel, and compare on the result:

        hk.compare(hk.learn(hk.Separable(k), runs))

    In two dimensions every divergence-free field has an energy, so it is no candidate.

    Args:
        X: states, shape (N, n); observations, without Y; or the result of `learn`.
        Y: velocities, shape (N, n).
        candidates: kernels by name, in place of the ladder of all structures and symmetries with
            Gaussian kernels. Their claims follow from their structure.
        starts: the number of starts of each search, see `tune`. With two, one of 20 data sets of
            runs got a wrong answer: half of its searches ended at lengthscales below the sampling
            interval, where the kernel fits the noise.
        progress: show a progress bar if the standard error is a terminal.

    Returns:
        The table and the answers. The ladder has 15 candidates for n = 2, 17 for larger even n, and
        6 for odd n ≥ 3. The first call for a shape of the data compiles at most three searches.

    Raises:
        TypeError: a candidate is no structured kernel, or takes inputs or parameters; or `learned`
            has inputs or parameters.
        ValueError: a candidate cannot hold for these states, there are fewer than two, `learned`
            has a mean or no observations, or the data are invalid, as in `fit`.

    Warns:
        UserWarning: `learned` has a structure, which biases the answers.

    Source: Schwarz (1978), Annals of Statistics 6, for the score.
    """
    from tqdm import tqdm  # here, so that hamkernel imports faster

    require.no_tracers("hk.compare", "Call it outside.", X, Y, candidates)
    data, ridge = _data(X, Y)
    rows = make_problem(Separable(Gaussian(1.0)), data, None, 1.0).rows
    points, n, D = np.asarray(rows.points), rows.dimension, rows.size
    scale = points.std(axis=0)
    speed = velocity_rms(Separable(Gaussian(jnp.asarray(np.where(scale > 0, scale, 1.0)))), rows)
    steps = ladder(n) if candidates is None else {}
    searched: dict[str, AbstractMatrixKernel] = {k: s.rung(scale, speed) for k, s in steps.items()}
    if candidates is not None:
        searched = _check_candidates(candidates, n, points)
    check_memory(rows, SEARCH_COPIES)
    ridge = jnp.asarray(1e-4 * speed**2 if ridge is None else ridge, rows.targets.dtype)
    candidate_rows = []
    for name, K in tqdm(searched.items(), "candidates", disable=None if progress else True):
        K, regularization, likelihood = _maximise_evidence(K, rows, ridge, starts)
        K = steps[name].kernel(K) if isinstance(K, Rung) else K
        values = named_values(K, points) | {RIDGE: regularization}
        P = sum(np.size(value) for value in values.values())
        score = likelihood - P / 2 * math.log(D)
        claimed = steps[name].claims if name in steps else claims(K, scale)
        tuned = (K, regularization, values)
        candidate_rows.append(Candidate(name, claimed, score, 0.0, likelihood, P, *tuned))
    top = max(row.score for row in candidate_rows)
    table = [row._replace(difference=row.score - top) for row in candidate_rows]
    return _answer(tuple(sorted(table, key=lambda row: -row.score)), points, D)


@one_blas_thread
def _maximise_evidence(
    K: AbstractMatrixKernel, rows: Measurements, ridge: Float[Array, ""], starts: int
) -> tuple[AbstractMatrixKernel, Float[Array, ""], float]:
    """The kernel and λ that maximise the marginal likelihood, and log p at the maximum."""
    rms = velocity_rms(K, rows)
    space = SearchSpace(K, rows.points, rms, ridge, (), {})
    criterion = criterion_of("marginal_likelihood", rows.count, 2)
    # This is the search of `tune`, with 32 instead of up to 256 points in the design, since the
    # first point already has the scale of the data.
    search = Search(
        space,
        criterion,
        rows,
        rms,
        starts,
        max_steps=64,
        optimiser=None,
        progress=False,
        design_size=32,
    )
    run = best(search.runs())
    check_finite_loss(run)
    K, regularization, _ = decode(space, jnp.asarray(run.best.u, rows.targets.dtype))
    return K, regularization, -float(run.best.loss)


def _data(X: Any, Y: Any) -> tuple[AbstractObservations, Any]:
    """The observations, and λ if they come from `learn`."""
    if not isinstance(X, Learned):
        return observations(X, Y), None
    if Y is not None:
        raise TypeError("the result of learn contains the data, so give no Y: hk.compare(learned).")
    if X.observations is None:
        raise ValueError("no run had enough samples to learn a field: add longer runs.")
    if X.mean is not None:
        raise ValueError(
            "a part of this field was known, the mean, and compare would judge the rest alone: "
            "learn without a mean to ask which physics the complete field obeys."
        )
    if X.kernel.takes_inputs:
        raise TypeError(
            f"compare asks about fields of the state alone, and the kernel of this field is a "
            f"{type(X.kernel).__name__}: compare runs of one system, without inputs."
        )
    if not isinstance(X.kernel, Separable) or claims(X.kernel, np.ones(X.runs.dimension)):
        require.warn(
            f"these runs were learned with {type(X.kernel).__name__}, which biases the answers. "
            "Learn them with the weakest kernel, hk.Separable(k), and compare the result."
        )
    return X.observations, X.regularization


def _check_candidates(
    candidates: Any, n: int, points: Float[np.ndarray, "P n"]
) -> dict[str, AbstractMatrixKernel]:
    """The caller's candidates; an error if one cannot hold for these states."""
    if not isinstance(candidates, Mapping) or len(candidates) < 2:
        raise ValueError(
            'candidates must be at least two kernels by name, {"H": hk.Symplectic(k), '
            f'"any": hk.Separable(k)}}; got {candidates!r}.'
        )
    for name, K in candidates.items():
        K = matrix_kernel(K, f"the candidate {name!r}")
        if K.takes_inputs:
            raise TypeError(
                f"the candidate {name!r} is a {type(K).__name__}: compare asks about fields of the "
                "state alone."
            )
        if n == 2 and isinstance(K, DivergenceFree):
            raise ValueError(
                f"the candidate {name!r}: in two dimensions every divergence-free field is J∇H, "
                "and has an energy. Give hk.Symplectic(k) in its place."
            )
        try:
            K.check_points(jnp.asarray(points))
        except ValueError as error:
            raise ValueError(f"the candidate {name!r} cannot hold: {error}") from error
        warn_of_constants(K)
    return dict(candidates)


def claims(K: AbstractMatrixKernel, scale: Float[np.ndarray, " n"]) -> frozenset[str]:
    """The questions to which the answer is yes for every field of K."""
    n, m = len(scale), len(scale) // 2
    x, z = jnp.asarray(np.random.default_rng(0).normal(size=(2, n)) * scale)
    block = K(x, z)

    def is_unchanged(signs: np.ndarray, character: float) -> bool:
        """Whether f(Sx) = ± S f(x) for S = diag(signs)."""
        S = jnp.asarray(signs, block.dtype)
        wrong = jnp.linalg.norm(K(S * x, z) - character * S[:, None] * block)
        return bool(wrong < 1e-4 * jnp.linalg.norm(block))  # above the rounding of float32

    answers = set()
    if is_unchanged(-np.ones(n), 1.0):
        answers.add("mirror")
    if n % 2 or not K.has_hamiltonian:
        return frozenset(answers)
    answers.add("energy")
    if not K.conserves:
        answers.add("friction")
    elif is_unchanged(_reversal(n), -1.0):
        answers.add("reversible")
    q, p = frozenset(range(m)), frozenset(range(m, n))
    if all(part <= q or part <= p for k in K.scalar_kernels for part in k.supports(n)):
        answers.add("T + U")
    return frozenset(answers)


def _reversal(n: int) -> Float[np.ndarray, " n"]:
    return np.repeat([1.0, -1.0], n // 2)


def _answer(table: tuple[Candidate, ...], points: Float[np.ndarray, "P n"], D: int) -> Comparison:
    """The answers to all questions, from the table of candidates in descending order."""
    n = points.shape[1]
    answers = dict.fromkeys(QUESTIONS, "")  # in this order
    reasons, differences = {}, {}

    def say(key: str, answer: str, reason: str, difference: float = math.nan) -> None:
        answers[key], reasons[key], differences[key] = answer, reason, difference

    def ask(key: str, among: list[Candidate]) -> None:
        yes = next((row for row in among if key in row.claims), None)  # the best row is first
        no = next((row for row in among if key not in row.claims), None)
        if key == "friction" and yes is not None:
            no = _frictionless_rival(yes, among) or no
        if yes is None or no is None:
            return say(key, "not tested", "no candidate for the other answer")
        change = yes.score - no.score
        verdict = "yes" if change > THRESHOLD else "no" if change < -THRESHOLD else "undecided"
        reason = f"{yes.name} against {no.name}: {change:+.1f}"
        if key == "friction" and verdict == "undecided":
            gain = yes.log_likelihood - no.log_likelihood
            # Half a unit of log likelihood is one standard deviation of a hyperparameter.
            if gain < 0.5:
                verdict = "no"
                reason += ", and the best friction is within one deviation of zero"
        return say(key, verdict, reason, change)

    everything = list(table)
    ask("energy", everything)
    if _is_seen(points, -np.ones(n)):
        ask("mirror", everything)
    else:
        say("mirror", "not tested", "no data near the mirror image of the data")
    if answers["energy"] != "yes":
        for key in ("friction", "reversible", "T + U"):
            say(key, "not tested", "it asks about an energy, and none was established")
        return Comparison(table, answers, reasons, differences, D)
    having = [row for row in table if "energy" in row.claims]
    ask("friction", having)
    ask("T + U", having)
    if answers["friction"] == "yes":
        say("reversible", "no", "there is friction")
    elif _is_seen(points, _reversal(n)):
        ask("reversible", [row for row in having if "friction" not in row.claims])
    else:
        say("reversible", "not tested", "no data near those of backward motion")
    return Comparison(table, answers, reasons, differences, D)


def _frictionless_rival(damped: Candidate, among: list[Candidate]) -> Candidate | None:
    """The candidate that lacks only the friction; None if there is none.

    No candidate with friction has an H that is even in p. A candidate without friction may
    therefore be better only because it is reversible, so we take the one with the fewest claims.
    """
    same = [row for row in among if row.claims - {"reversible"} == damped.claims - {"friction"}]
    return min(same, key=lambda row: len(row.claims), default=None)


def _is_seen(points: Float[np.ndarray, "P n"], signs: Float[np.ndarray, " n"]) -> bool:
    """Whether a tenth of the images of the points have a point within a standard deviation.

    The states of Lotka-Volterra are positive and contain no information about −x. Without this test
    `compare` called the field odd for 9 of 10 data sets.
    """
    Z = points / np.where(points.std(axis=0) > 0, points.std(axis=0), 1.0)
    near = [np.linalg.norm(Z - image, axis=1).min() < 1.0 for image in Z * signs]
    return float(np.mean(near)) >= 0.1
