"""`readout`: a formula of the potential, Σ θ_k φ_k, from a dictionary of functions φ_k.

The whitened rows of the measurements are y_r = L_r f + ε_r with independent noise of one variance.
If f = B∇u with u = Σ θ_k φ_k, they are a linear regression

    y = Φθ + ε,    Φ_rk = L_r [B ∇φ_k],    θ = (ΦᵀΦ)⁻¹ Φᵀ y,    Cov θ = s² (ΦᵀΦ)⁻¹

on the measurements themselves. A regression on the values of a posterior mean would count the prior
twice. It found the terms of a pendulum in at most 10 % of data sets. The regression on measurements
finds them in all 30 data sets of `tests/benchmarks/readout.py`.

Selection. Let S be a subset of k of the D functions, with the residual sum of squares RSS_S in R
rows of unknown noise. The Bayesian information criterion with a uniform prior over the size of the
subset (Chen & Chen 2008) is

    R log RSS_S + k log R + 2 log C(D, k),

and exp(−½ score) is proportional to the posterior probability w_S of S. We compare all subsets,
since backward elimination found the terms in only 10 to 40 % of data sets. The variance of a
coefficient is the average Σ_S w_S (Var_S θ_k + (θ_k,S − θ_k)²) over the subsets (Hoeting et al.
1999), which includes the uncertainty of the selection.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hamkernel import _require as require
from hamkernel._discovery.formula import Formula, operator_of
from hamkernel._fields.joined import fix_inputs, known_of
from hamkernel._gram import gram_of_rows
from hamkernel._kernels.functions import as_pytree
from hamkernel._kernels.symmetry import symmetry_removed
from hamkernel._learned.result import Learned
from hamkernel._machine import full_precision
from hamkernel._posterior import Posterior
from hamkernel._solvers.problem import make_problem
from hamkernel._structures.base import AbstractMatrixKernel
from hamkernel._structures.masses import UnknownMasses
from hamkernel._structures.structure import CurlFree

# The largest relative difference of a function and its image under a symmetry, above rounding
# errors and below a wrong sign.
SYMMETRY_RTOL = 1e-6


@full_precision
def readout(
    learned: Learned | Posterior,
    terms: Mapping[str, Callable[[Float[Array, " n"]], Any]],
    most: int = 4,
) -> Formula:
    """A formula Σ θ_k φ_k of the potential, with a few terms of a dictionary, from the data.

        learned = hk.learn(hk.Symplectic(hk.Gaussian(1.0)), runs)
        terms = {"p**2": lambda x: x[1] ** 2, "cos(q)": lambda x: jnp.cos(x[0]), …}
        formula = hk.readout(learned, terms)    # H = 0.5002(12) p**2 - 0.981(4) cos(q)

    The coefficients are the least-squares solution θ = (ΦᵀΦ)⁻¹Φᵀy of the measurements,
    Φ_rk = L_r[B∇φ_k], with the operator B of the structure. They do not depend on the scalar
    kernel. `readout` compares all subsets of up to `most` terms by the Bayesian information
    criterion, and returns the best.

    The parameters of the structure and the prior mean count as known, such as the friction of
    `PortHamiltonian` and the masses of `UnknownMasses`. For a field with inputs, G(x)u stays a
    Gaussian process, and the formula describes the drift. With a symmetric kernel (`Odd`,
    `Reversible`, `Invariant`) all terms must have the symmetry.

    Args:
        learned: the result of `hk.learn`, or a posterior of `hk.condition`. Learn or tune with a
            kernel as flexible as the data need: the formula uses its noise and its paths.
        terms: names and functions φ: x (n,) -> (), written with jax.numpy. A constant is no term,
            since velocities do not depend on it.
        most: the largest number of terms in the formula.

    Returns:
        A `Formula`, with `.terms`, `.coefficients`, `.deviations`, `.misfit`, and `.latex()`. D
        terms need C(D, 1) + … + C(D, most) small least-squares solves: 17 terms take 0.1 s.

    Warns:
        UserWarning: the residuals of the formula are more than twice the noise.

    Raises:
        TypeError: `learned` is neither a posterior nor a result of `learn`, `terms` is no
            dictionary of functions, or a function is not traceable.
        AttributeError: the structure has no scalar potential (with the reason).
        ValueError: a function does not map one state to one number, is not finite on the data, has
            a zero field B∇φ, or lacks the symmetry of the kernel. ValueError also if functions are
            linearly dependent on the data, or there are as many terms as rows, or too many subsets.

    Source: Brunton, Proctor & Kutz (2016) for the dictionary; Chen & Chen (2008), Biometrika 95,
        for the criterion; Hoeting et al. (1999), Statistical Science 14, for the deviations.
    """
    require.no_tracers("hk.readout", "Call it outside, on what was learned.", learned)
    kernel, rows, ridge, mean = _data_of(learned)
    limit = require.count(most, "most")
    if kernel.no_potential:
        raise AttributeError(f"there is no potential to read a formula of: {kernel.no_potential}")
    names, functions = _check_terms(terms, rows)
    _check_symmetry(kernel, names, functions, rows)
    y, columns, typical = _regression(kernel, rows, ridge, functions)
    _check_columns(names, columns, typical, y, float(jnp.finfo(rows.targets.dtype).eps))
    selection = _select(columns, y, min(limit, len(names)))
    misfit = math.sqrt(selection.variance / float(ridge))
    if misfit > 2.0:  # three quarters of the residuals are then not noise
        require.warn(
            f"the formula leaves {misfit:.3g} times the noise of the fit. Likely causes: a term is "
            f"missing from the dictionary; more than {limit} terms are needed (most=…); λ was not "
            "tuned and is too small, since Nλ is the variance of the noise."
        )
    dtype = rows.targets.dtype
    return Formula(
        terms=tuple(names[i] for i in selection.subset),
        coefficients=jnp.asarray(selection.coefficients, dtype),
        deviations=jnp.asarray(selection.deviations, dtype),
        misfit=jnp.asarray(misfit, dtype),
        probability=jnp.asarray(selection.probability, dtype),
        rows=len(y),
        functions=tuple(functions[i] for i in selection.subset),
        kernel=kernel,
        mean=mean,
    )


def _data_of(learned: Any) -> tuple[AbstractMatrixKernel, Any, Float[Array, ""], Any]:
    """The kernel, the rows minus the known part, the variance Nλ of their noise, and the mean."""
    if isinstance(learned, Posterior):
        conditional = learned.conditional
        kernel, rows = conditional.field.kernel, conditional.rows
        ridge = conditional.ridge
        mean = known_of(learned.field)
    elif isinstance(learned, Learned):
        if learned.observations is None:
            raise ValueError(
                "no run had enough samples for `learn`, so there are no rows for a formula: add "
                "longer runs."
            )
        asked = make_problem(
            learned.kernel, learned.observations, None, learned.regularization, learned.mean
        )
        kernel, rows, ridge, mean = asked.kernel, asked.rows, asked.ridge, asked.known
    else:
        raise TypeError(
            "readout takes the result of hk.learn or hk.condition, which contains the "
            f"measurements; got a {type(learned).__name__}. Use hk.condition(K, X, Y, λ)."
        )
    if kernel.input_name == "parameters":
        raise TypeError(
            "readout takes one system and this is a family: condition on the data of one member, "
            "without parameters."
        )
    if kernel.takes_inputs and mean is not None:
        mean = fix_inputs(mean, 0, None)  # the mean of the drift
    return kernel, rows, ridge, mean


def _check_terms(terms: Any, rows: Any) -> tuple[list[str], list[Callable[..., Any]]]:
    """The names and functions; errors unless each function maps one state to one real number."""
    if not isinstance(terms, Mapping) or not terms:
        raise TypeError(
            'terms must be a dictionary of functions, {"p**2": lambda x: x[1] ** 2, …}, with at '
            f"least one; got {terms!r}."
        )
    state = jax.ShapeDtypeStruct((rows.dimension,), rows.targets.dtype)
    for name, fn in terms.items():
        if not isinstance(name, str) or not callable(fn):
            raise TypeError(
                f"the term {name!r} is a {type(fn).__name__}; a name and a function x (n,) -> () "
                "are needed."
            )
        with require.traceable(f"the term {name!r}"):
            out = eqx.filter_eval_shape(fn, state)
        if getattr(out, "shape", None) != () or not jnp.issubdtype(out.dtype, jnp.floating):
            was = f"{out.dtype} of shape {out.shape}" if hasattr(out, "shape") else type(out)
            raise ValueError(
                f"the term {name!r} maps a state of shape {state.shape} to {was}; one real number, "
                "shape (), is needed, such as lambda x: x[0] ** 2."
            )
    return list(terms), [as_pytree(fn) for fn in terms.values()]


def _check_symmetry(K: Any, names: list[str], functions: list[Any], rows: Any) -> None:
    """ValueError if the symmetry of the kernel forbids a term."""
    K = K.state_kernel
    symmetry_means = [symmetry_removed(k) for k in K.scalar_kernels]
    n = rows.dimension
    if any(mean is None for mean in symmetry_means) or isinstance(K, UnknownMasses):
        return
    groups = [mean.group(n) for mean in symmetry_means if mean is not None]

    def contains(group, g):
        same = [h for h in group if h.character == g.character]
        return any(np.abs(h.matrix - g.matrix).max() < SYMMETRY_RTOL for h in same)

    shared = [g for g in groups[0] if all(contains(group, g) for group in groups)]
    X = rows.points[:, :n]
    bad = []
    for name, fn in zip(names, functions, strict=True):
        values = np.asarray(jax.vmap(fn)(X))
        for g in shared:
            change = np.asarray(jax.vmap(fn)(jax.vmap(g)(X))) - g.character * values
            # H is known up to a constant, so an odd potential may have a constant too.
            constant = change.mean() if g.character < 0 else 0.0
            if not np.abs(change - constant).max() <= SYMMETRY_RTOL * np.abs(values).max():
                bad.append(name)
                break
    if bad:
        do, them = ("does", "it") if len(bad) == 1 else ("do", "them")
        raise ValueError(
            "the kernel has a symmetry of the potential that "
            f"{_join_names(bad)} {do} not have: leave {them} out, or learn without the symmetry."
        )


def _regression(
    K: Any, rows: Any, ridge: Float[Array, ""], functions: list[Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The targets y, the columns Φ, and the size of the terms in the entries of each column.

    The noise of all rows has the variance `ridge`. If the input matrix is unknown, the rows of
    G(x)u have the covariance C. We then multiply y and Φ by L⁻¹ with LLᵀ = I + C/ridge, which is
    generalised least squares with G integrated out.
    """
    fields, potentials = _dictionary_functions(operator_of(K), tuple(functions), rows.dimension)
    columns, typical = [], []
    for block in rows.blocks:
        values = (potentials if block.of_values else fields)(block.points)
        columns.append(block.rows(values[0]))
        typical.append(np.broadcast_to(np.asarray(values[1]), (block.size, len(functions))))
    columns = rows.contrast(jnp.concatenate(columns))
    y, columns = np.asarray(rows.y, float), np.asarray(columns, float)
    if K.takes_inputs and K.known_matrix is None:
        nothing = CurlFree(lambda x, z: jnp.zeros((), x.dtype))
        input_kernel = K.with_states(nothing)
        C = np.asarray(eqx.filter_jit(gram_of_rows)(input_kernel, rows), float) / float(ridge)
        R = np.linalg.cholesky(np.eye(len(C)) + C)
        y, columns = np.linalg.solve(R, y), np.linalg.solve(R, columns)
    return y, columns, np.concatenate(typical).max(axis=0)


def _dictionary_functions(operator: Any, functions: tuple[Any, ...], n: int) -> tuple[Any, Any]:
    """Functions of points: the fields (P, n, D) or potentials (P, D), and the sizes of their terms.

    The sizes (D,) are the maxima of Σ_b |B_ab| |∂_b φ|. A field B∇φ that consists only of rounding
    errors, as for a Casimir φ, is small compared to its size.
    """

    def slopes(x):
        pairs = [jax.value_and_grad(lambda x, fn=fn: fn(x).astype(x.dtype))(x) for fn in functions]
        return jnp.stack([slope + 0 * value for value, slope in pairs])  # NaN where φ is NaN

    def field(x):
        v = slopes(x)
        B = jax.vmap(operator, in_axes=(None, 0), out_axes=1)(x, jnp.eye(n, dtype=x.dtype))
        return jax.vmap(operator, in_axes=(None, 0), out_axes=1)(x, v), (abs(B) @ abs(v).T).max(0)

    def value(x):
        values = jnp.stack([fn(x).astype(x.dtype) for fn in functions])
        return values, abs(values)

    def evaluate_at_points(fn):
        def values_and_sizes(points):
            values, typical = jax.vmap(fn)(points[:, :n])
            return values, typical.max(axis=0)

        return eqx.filter_jit(values_and_sizes)

    return evaluate_at_points(field), evaluate_at_points(value)


def _check_columns(
    names: list[str], columns: np.ndarray, typical: np.ndarray, y: np.ndarray, eps: float
) -> None:
    """ValueError if the functions are not linearly independent on these rows."""
    bad = [names[i] for i in np.flatnonzero(~np.isfinite(columns).all(axis=0))]
    if bad:
        raise ValueError(
            f"{_join_names(bad)} is not finite at some of the states, or has no derivative there: "
            "leave it out, or write it so that both exist there."
        )
    R, D = columns.shape
    if D >= R:
        raise ValueError(
            f"there are {D} terms and {R} rows: more rows than terms are needed. Leave terms out, "
            "or measure more."
        )
    sizes = np.linalg.norm(columns, axis=0)
    rounding = R * eps
    bad = [name for name, a, b in zip(names, sizes, typical, strict=True) if a <= rounding * b]
    if bad:
        raise ValueError(
            f"{_join_names(bad)} has no effect on the data: the field B∇φ is zero, as for a "
            "constant or a Casimir φ. Leave it out."
        )
    _, singular, V = np.linalg.svd(np.linalg.qr(columns / sizes, mode="r"))
    if singular[-1] <= rounding * singular[0]:
        shares = np.abs(V[-1])
        bad = [name for name, share in zip(names, shares, strict=True) if share > 1e-3]
        raise ValueError(
            f"{_join_names(bad)} are linearly dependent on the data: a combination has a zero "
            "field, so such data do not determine the coefficients. Leave one of them out."
        )
    if not np.abs(y).max() > 0:
        raise ValueError(
            "all targets are zero after the mean is subtracted, so there is nothing to explain: "
            "check the data and the mean."
        )


def _join_names(names: list[str]) -> str:
    quoted = [repr(name) for name in names]
    return " and ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)


class _Selection(NamedTuple):
    """The best subset, with coefficients, standard deviations, s², and posterior probability."""

    subset: tuple[int, ...]
    coefficients: np.ndarray
    deviations: np.ndarray
    variance: float
    probability: float


def _select(columns: np.ndarray, y: np.ndarray, limit: int) -> _Selection:
    """The best of all subsets of up to `limit` columns.

    We compute [Φ, y] = QT once, and for each subset a QR of the D + 1 rows of T, whose last
    diagonal entry is the norm of the residual. We avoid normal equations, so nearly dependent
    columns lose digits like their condition number and not like its square.
    """
    R, D = columns.shape
    limit = min(limit, R - 1)
    count = sum(math.comb(D, k) for k in range(1, limit + 1))
    if count > 1_000_000:  # one million take 4 s of CPU time and 150 MB
        raise ValueError(
            f"{D} terms have {count} subsets of up to {limit}, and all are compared: give fewer "
            f"terms or a smaller `most`, for at most 1000000 subsets."
        )
    sizes = np.linalg.norm(columns, axis=0)
    T = np.asarray(np.linalg.qr(np.column_stack([columns / sizes, y]), mode="r"))
    # We cannot compare residuals below the rounding of y.
    floor = (np.finfo(float).eps * np.linalg.norm(y)) ** 2 * R
    scores, batches = [], []
    for k in range(1, limit + 1):
        prior = k * math.log(R) + 2 * math.log(math.comb(D, k))
        subsets = itertools.combinations(range(D), k)
        # 20 000 subsets in one stack of QR factorisations.
        while len(batch := np.array(list(itertools.islice(subsets, 20_000)), int)):
            theta, inverse, squares = _least_squares(T, batch)
            squares = np.maximum(squares, floor)
            scores.append(R * np.log(squares) + prior)
            variances = squares[:, None] / (R - k) * inverse
            batches.append((batch, theta, variances, squares))
    total = np.concatenate(scores)
    weights = np.exp(-0.5 * (total - total.min()))
    weights /= weights.sum()
    best = int(total.argmin())
    starts = np.cumsum([0, *map(len, scores)])
    part = int(np.searchsorted(starts, best, side="right") - 1)
    batch, theta, _, squares = (array[best - starts[part]] for array in batches[part])
    square = np.zeros(len(batch))  # Σ_S w_S (Var_S θ_k + (θ_k,S − θ_k)²)
    for (subsets, values, variances, _), start in zip(batches, starts[:-1], strict=True):
        w = weights[start : start + len(subsets)]
        for i, term in enumerate(batch):
            has = subsets == term
            present = has.any(axis=1)
            change = variances[has] + (values[has] - theta[i]) ** 2
            square[i] += w[present] @ change + w[~present].sum() * theta[i] ** 2
    return _Selection(
        subset=tuple(batch.tolist()),
        coefficients=theta / sizes[batch],
        deviations=np.sqrt(square) / sizes[batch],
        variance=float(squares) / (R - len(batch)),
        probability=float(weights[best]),
    )


def _least_squares(T: np.ndarray, subsets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The coefficients (c, k), the diagonals of (ΦᵀΦ)⁻¹ (c, k), and residual squares (c,).

    For each subset the triangle of a QR of [Φ_S, y] is [[R, Qᵀy], [0, ρ]]. Then θ = R⁻¹Qᵀy,
    (ΦᵀΦ)⁻¹ = R⁻¹R⁻ᵀ, and the residual sum of squares is ρ².
    """
    c, k = subsets.shape
    y = np.broadcast_to(T[:, -1:], (c, len(T), 1))
    stack = np.concatenate([np.moveaxis(T[:, subsets], 0, 1), y], axis=2)
    triangle = np.asarray(np.linalg.qr(stack, mode="r"))
    R = triangle[:, :k, :k]
    inverse = np.linalg.inv(R)
    theta = (inverse @ triangle[:, :k, k:])[..., 0]
    return theta, (inverse**2).sum(axis=2), triangle[:, k, k] ** 2
