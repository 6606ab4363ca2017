"""Fits to data in chunks: one pass, in memory that does not depend on the number of points.

A low-rank solver with r columns compresses all rows into r² sums, in a basis that `start` chose.
The sums of two parts of the data add up to the sums of all the data, and the field for any λ
follows from the sums.

Plain sums are exact to rounding, but nearly dependent landmarks amplify rounding errors in the
coefficients: 600 points on 160 landmarks at λ = 1e-13, added in another order, changed the field by
6e-7. Each sum therefore carries its rounding error (Knuth's two-sum). The result then does not
depend on the order in which a distributed engine adds the chunks.
"""

import abc
import contextlib
import dataclasses
import itertools
import reprlib
from collections.abc import Iterable, Iterator
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from hamkernel import _require as require
from hamkernel._fields.base import known_part
from hamkernel._fields.joined import learned_field
from hamkernel._gram import components
from hamkernel._machine import (
    RowSharding,
    entry_point,
    follow_data,
    full_precision,
    precise_jit,
    row_sharding,
    shard,
)
from hamkernel._observations.kinds import (
    AbstractObservations,
    Equilibria,
    inputs_or_parameters,
)
from hamkernel._observations.measurements import (
    Measurements,
    measurements_of,
    observations,
    place,
)
from hamkernel._show import call, text
from hamkernel._solvers.least_squares import Sums, first_sums, solve_sums
from hamkernel._solvers.low_rank import AbstractFunctions
from hamkernel._solvers.problem import AbstractSolver, LearnedField, subtract_known
from hamkernel._structures.base import AbstractMatrixKernel, matrix_kernel
from hamkernel._structures.completed import complete

Fit = TypeVar("Fit", bound="AbstractStreamingFit")


_START_ONCE = (
    "Start once, model = solver.start(K, sample, regularization), and let each worker add its data "
    "to a copy of that model."
)


class AbstractStreamingFit(eqx.Module, Generic[LearnedField]):
    """A fit to the data added so far, made by `solver.start`.

    The fit has a fixed size. `add` returns a new fit, and `field` solves for any λ:

        model = solver.start(K, X, 1e-4).add(X, Y)
        field = model.field()
        better = model.add(X_new, Y_new).field()

    Fits to parts of the data add up to the fit to all the data, `a + b` or `sum(parts)`, if all
    parts begin with copies of one `start`. `hk.save` and `hk.load` store a fit.
    """

    kernel: AbstractMatrixKernel
    sums: Sums
    compensation: tuple[Any, ...]
    count: Int[Array, ""]
    regularization: Float[Array, ""]
    dimension: int = eqx.field(static=True)

    def __repr__(self) -> str:
        name, size, _ = self._columns()
        numbers = [f"{name}={text(size)}", f"added={text(self.count)}"]
        return call(type(self).__name__, [f"kernel={text(self.kernel)}", *numbers])

    def __getstate__(self) -> dict[str, Any]:
        # Arrays of JAX would lose digits, in silence, in a process that has not enabled float64.
        arrays, rest = eqx.partition(self, eqx.is_array)
        return vars(eqx.combine(jax.tree.map(np.asarray, arrays), rest))

    def __setstate__(self, state: dict[str, Any]) -> None:
        dtype = state["regularization"].dtype
        if jnp.result_type(float) != jnp.float64 == dtype:
            raise TypeError(
                "the fit is in float64 and this process, which receives it, computes in float32: "
                "set JAX_ENABLE_X64=1 in the environment of every worker."
            )
        arrays, rest = eqx.partition(state, lambda leaf: isinstance(leaf, np.ndarray))
        for name, value in eqx.combine(jax.tree.map(jnp.asarray, arrays), rest).items():
            object.__setattr__(self, name, value)

    @property
    def dtype(self) -> jnp.dtype:
        """The dtype of the fit, and of its fields."""
        return self.regularization.dtype

    @property
    def _totals(self) -> tuple[Any, ...]:
        """The accumulated sums. `add` changes these leaves and `count`, nothing else."""
        return (self.sums.normal_equations,)

    @abc.abstractmethod
    def _columns(self) -> tuple[str, Any, Any]:
        """The word "landmarks" or "features", their number, and the arrays."""

    def _from_start(self) -> dict[str, Any]:
        """The arrays, by name, that must agree bit by bit in two fits that are added.

        Functions in kernels cannot be compared. The basis depends on the kernel and on the sample,
        so two fits with different functions also differ in their basis.
        """
        name, _, columns = self._columns()
        return {
            "numbers of coordinates": self.dimension,
            "kernels": self.kernel,
            "regularizations": self.regularization,
            name: columns,
            "samples, or functions in their kernels": (self.sums.triangle, self.sums.basis),
        }

    @property
    @abc.abstractmethod
    def _functions(self) -> AbstractFunctions:
        """The functions that, times `sums.basis`, make the rows of the sums."""

    def _totals_of(self, rows: Measurements, spread: RowSharding | None) -> tuple[Any, ...]:
        """The totals of new rows; velocities may be sharded over devices."""
        return (self._functions.normal_equations(rows, self.sums.basis, spread),)

    @abc.abstractmethod
    def _field(
        self,
        w: Float[Array, " r"],
        norm: Float[Array, ""],
        residual: Float[Array, "0 n"],
        residual_norm: Float[Array, ""],
        regularization: Float[Array, ""],
        ridge: Float[Array, ""],
    ) -> LearnedField:
        """The field with the weights w of the functions."""

    @abc.abstractmethod
    def _check_field(self, field: Any) -> LearnedField:
        """The field; RuntimeError if the solve failed."""

    @follow_data
    @full_precision
    def add(
        self: Fit,
        X: Num[ArrayLike, "N n"] | AbstractObservations,
        Y: Num[ArrayLike, "N n"] | None = None,
        inputs: Num[ArrayLike, "N m"] | None = None,
        parameters: Num[ArrayLike, "N p"] | None = None,
    ) -> Fit:
        """The fit with more data.

        Args:
            X: states, shape (N, n); or observations, and then there is no Y. The D rows of
                observations take O(D r) memory; velocities are read in tiles and take less.
            Y: measured velocities, shape (N, n).
            inputs: u at each state, for a `Controlled` kernel, shape (N, m).
            parameters: θ at each state, for a `Family`, shape (N, p).

        Raises:
            ValueError: a shape does not fit, the data are not finite, or there are energies, whose
                constant all chunks would share: give differences of H as `hk.Functionals`, or fit
                all data at once. TypeError: the data hold no real numbers, or have more digits than
                the fit. After an error the fit has not changed.
        """
        rows = self._checked_rows(
            observations(X, Y, inputs_or_parameters(inputs, parameters), part=True)
        )
        spread = None if rows.states is None else row_sharding(rows.points)
        arrays, rest = eqx.partition(rows, eqx.is_inexact_array)
        arrays = jax.tree.map(lambda a: shard(spread, a.astype(self.dtype)), arrays)
        return _with_rows(self, eqx.combine(arrays, rest), spread)

    def __add__(self: Fit, other: Any) -> Fit:
        """The fit to the data of both fits, bit by bit the same in any order of the parts.

        Both fits must come from one `start`, so that their sums are in one basis: start once and
        give every worker a copy. `sum(parts)` works, too.

        Raises:
            TypeError: the other object is no such fit, or has another dtype. ValueError: it has
                another kernel, other landmarks or features, another λ, or another sample in
                `start`.
        """
        if isinstance(other, int) and other == 0:  # the start of `sum`
            return self
        if not isinstance(other, AbstractStreamingFit):
            return NotImplemented
        if type(self) is not type(other) or self.dtype != other.dtype:
            one, two = (f"a {type(fit).__name__} in {fit.dtype}" for fit in (self, other))
            raise TypeError(f"{one} and {two} do not add. {_START_ONCE}")
        totals = other._totals
        for name, at_start in self._from_start().items():
            cause = f"the two fits have different {name}, and do not add. {_START_ONCE}"
            totals = require.value(totals, _differ(at_start, other._from_start()[name]), cause)
        return _plus(self, totals, other.compensation, other.count)

    __radd__ = __add__

    def _checked_rows(self, data: AbstractObservations) -> Measurements:
        nothing = Measurements((), jnp.zeros(0, self.dtype))
        self._check(None, data.dimension)
        _, rows = measurements_of(self.kernel, data, previous=nothing)
        self._check(rows.targets.dtype, rows.dimension)
        _refuse_energies(rows)
        return subtract_known(self.kernel, rows, self._known_part)

    def _check(self, dtype: jnp.dtype | None, dimension: int) -> None:
        """ValueError for another number of coordinates, TypeError for a dtype of more digits."""
        require.one_system("the data have", dimension, "the fit", self.dimension)
        if dtype is not None and np.promote_types(dtype, self.dtype) != self.dtype:
            raise TypeError(
                f"the data are {dtype} and the fit {self.dtype}, the dtype of the sample of "
                f"`start`: start with a sample in {dtype}, or cast the data."
            )

    @property
    def _known_part(self) -> Any:
        """The known part of the field: G u for a known input matrix G."""
        return known_part(self.kernel, None, self.dimension, self.dtype)

    def sum_of_columns(self) -> Any:
        """The field with all weights equal to 1.

        `save` stores one of its velocities, and `load` compares it to detect a wrong kernel.
        """
        nothing = jax.tree.map(jnp.zeros_like, self._totals)
        fit = eqx.tree_at(lambda f: f._totals, self, nothing)
        fit = eqx.tree_at(lambda f: f.sums.normal_equations.moment, fit, replace_fn=jnp.ones_like)
        one = jnp.ones((), self.dtype)
        field = fit._check_field(_solve(fit, jnp.ones_like(self.count), one))
        return learned_field(field, self._known_part)

    @entry_point
    def field(self, regularization: ArrayLike | None = None) -> Any:
        """The field learned from all data added so far, in O(r³) time without the data.

        Args:
            regularization: λ > 0, as in `hk.fit`, with N the number of points added so far; the λ
                of `start` if None.

        Raises:
            ValueError: λ is not positive, or no data were added.
        """
        if regularization is None:
            regularization = self.regularization
        regularization = require.ridge(regularization, self.dtype)
        none = require.host_array(self.count) == 0
        count = require.value(
            self.count, none, "no data yet: add(X, Y) before asking for the field."
        )
        field = self._check_field(_solve(self, count, regularization))
        return learned_field(field, self._known_part)


@precise_jit
def start_fit(
    kind: type[Fit],
    functions: AbstractFunctions,
    W: Float[Array, "r r"],
    sample: Measurements,
    regularization: Float[Array, ""],
    **fields: Any,
) -> Fit:
    """The fit to no data yet, whose sums are in the basis that a sample and W define.

    Args:
        kind: the class of the fit.
        functions: the functions that, times W, make the rows.
        W: a matrix, shape (r, r).
        sample: representative rows.
        regularization: λ.
        fields: the fields that this class has besides those of the base class.
    """
    sums = first_sums(functions.normal_equations(sample, W), W, sample.count, regularization)
    none, n = jnp.zeros((), int), sample.dimension
    fit = kind(functions.kernel, sums, (), none, regularization, n, **fields)
    return dataclasses.replace(fit, compensation=fit._totals)


@precise_jit
def _solve(fit: Any, count: Int[Array, ""], regularization: Float[Array, ""]) -> Any:
    """The field for a positive number of points and λ, not yet checked."""
    ridge = count.astype(regularization.dtype) * regularization
    w, norm, residual_norm = solve_sums(fit.sums, ridge)
    unknown = jnp.zeros((0, fit.dimension), w.dtype)
    return fit._field(w, norm, unknown, residual_norm, regularization, ridge)


@precise_jit
def _with_rows(fit, rows, spread):
    return _plus(fit, fit._totals_of(rows, spread), None, rows.count)


def _differ(first: Any, second: Any) -> Bool[ArrayLike, ""]:
    """Whether two PyTrees print differently or hold different arrays."""
    pairs = [jax.tree.leaves(eqx.filter(tree, eqx.is_array)) for tree in (first, second)]
    shapes, second_shapes = ([leaf.shape for leaf in leaves] for leaves in pairs)
    if text(first) != text(second) or shapes != second_shapes:
        return np.asarray(True)
    xp = np if require.is_concrete(pairs) else jnp
    same = [xp.array_equal(a, b, equal_nan=True) for a, b in zip(*pairs, strict=True)]
    return ~xp.asarray(same, bool).all()


@precise_jit
def _plus(fit: Fit, more: Any, more_compensation: Any, count: Int[ArrayLike, ""]) -> Fit:
    def add_compensated(a, b, a_error, b_error):
        s, error = _two_sum(a, b)
        t, error_of_errors = _two_sum(a_error, b_error)
        s, error = _two_sum(s, error + t)
        return _two_sum(s, error + error_of_errors)

    if more_compensation is None:
        more_compensation = jax.tree.map(jnp.zeros_like, more)
    pairs = jax.tree.map(add_compensated, fit._totals, more, fit.compensation, more_compensation)
    totals, compensation = jax.tree.transpose(
        jax.tree.structure(more), jax.tree.structure((0, 0)), pairs
    )
    new = (*totals, compensation, fit.count + count)
    return eqx.tree_at(lambda f: (*f._totals, f.compensation, f.count), fit, new)


def _two_sum(a: Array, b: Array) -> tuple[Array, Array]:
    """(s, e) with s = fl(a + b) and s + e = a + b exactly.

    Source: Knuth, The Art of Computer Programming, volume 2, section 4.2.2, theorem B.
    """
    s = a + b
    c = s - a
    return s, (a - (s - c)) + (b - c)


class AbstractStreamingSolver(AbstractSolver[LearnedField], Generic[LearnedField, Fit]):
    """A solver that can fit to data in chunks."""

    @abc.abstractmethod
    def _start_fit(
        self, K: AbstractMatrixKernel, sample: Measurements, regularization: Float[Array, ""]
    ) -> Fit:
        """`start` for checked arguments."""

    @follow_data
    @full_precision
    def start(
        self,
        K: AbstractMatrixKernel,
        sample: Num[ArrayLike, "N n"] | AbstractObservations,
        regularization: ArrayLike = 1e-4,
        inputs: Num[ArrayLike, "N m"] | None = None,
        parameters: Num[ArrayLike, "N p"] | None = None,
    ) -> Fit:
        """A fit without data, to which chunks are added: a `LandmarkFit` or a `FeatureFit`.

        Args:
            K: a matrix-valued kernel.
            sample: states that represent all the data, shape (N, n); if the data are not
                velocities, representative observations. The sample is not added to the fit.
                `Nystrom` chooses its landmarks from the sample, and later data do not change them.
                The first chunk is enough if all chunks look alike; one trajectory out of many is
                not. For `RandomFeatures` only the rounding of the sums depends on the sample.
            regularization: the smallest λ that `field` will need. The tolerance of `Nystrom` is
                relative to this λ; fields for a smaller λ lose digits.
            inputs: u at each point of the sample, for a `Controlled` kernel, shape (N, m).
            parameters: θ at each point of the sample, for a `Family`, shape (N, p).

        If `field.info.truncation` exceeds the tolerance of `Nystrom`, start again with a sample
        that represents the data so far.

        Raises:
            ValueError: a shape does not fit, the structure does not allow this n, the sample is not
                finite, or λ is not positive. TypeError: K is not matrix-valued, or, for
                `RandomFeatures`, has no known spectral density.
        """
        K = matrix_kernel(K)
        data_inputs = inputs_or_parameters(inputs, parameters)
        if isinstance(sample, AbstractObservations):
            data = observations(sample, None, data_inputs)
        else:
            data = Equilibria(require.points(sample, "sample"), data_inputs)
        K, rows = measurements_of(K, place(data))
        _refuse_energies(rows)
        K.check_dimension(rows.points.shape[1])
        K = complete(K, rows.points, rows.dimension)
        require.warn_of_float32(rows.targets)
        return self._start_fit(K, rows, require.ridge(regularization, rows.targets.dtype))

    @entry_point
    def fit_chunks(
        self,
        K: AbstractMatrixKernel,
        chunks: Iterable[tuple[Num[ArrayLike, "N _"], ...]],
        regularization: ArrayLike = 1e-4,
        sample: Num[ArrayLike, "S n"] | None = None,
        progress: bool = False,
        inputs: Num[ArrayLike, "S m"] | None = None,
        parameters: Num[ArrayLike, "S p"] | None = None,
    ) -> Any:
        """The field of `hk.fit`, from chunks of data, in one pass and with memory for two chunks.

        The result equals one fit to all the data: to rounding for `RandomFeatures`, and for
        `Nystrom` if the landmarks are the same (`sample=X`, or `points`), else within the
        tolerance. The sums of a stream need a larger λ than one fit, above all in float32; a λ that
        is too small raises a RuntimeError. If `Nystrom` warns of the truncation, pass a `sample`
        that represents all the data. To add data later, or to keep the data so far if a later chunk
        is refused, add to the fit of `start` instead.

        Args:
            K: a matrix-valued kernel.
            chunks: pairs (X, Y) of states and velocities, shape (Nᵢ, n) each: a generator, or
                slices of memory-mapped files. Every new Nᵢ compiles a program, so use equal sizes.
                For a `Controlled` kernel triples (X, Y, U) with inputs of shape (Nᵢ, m), for a
                `Family` (X, Y, Θ).
            regularization: λ > 0, as in `hk.fit`, with N the number of all points.
            sample: states that represent all the data, for `start`; the first chunk if None.
            progress: show a progress bar if the standard error is a terminal.
            inputs: u at each point of the sample, for a `Controlled` kernel, shape (S, m).
            parameters: θ at each point of the sample, for a `Family`, shape (S, p).

        Raises:
            ValueError: there is no chunk, or a chunk is refused as in `hk.fit`. TypeError: as in
                `hk.fit`. Errors while a chunk is read propagate, with a note of its number.
        """
        from tqdm import tqdm  # so that importing the package does not load it

        if not isinstance(chunks, Iterable):
            raise TypeError(
                f"chunks must be an iterable of pairs (X, Y), got {chunks!r}. Call a generator "
                "function: fit_chunks(K, read(), ...)."
            )
        model, no_more = None, object()  # no `None`, which may be a chunk of the wrong type
        remaining = iter(tqdm(chunks, "chunks", disable=None if progress else True))
        for i in itertools.count():
            with _naming(i):
                chunk = next(remaining, no_more)
                if chunk is no_more:
                    break
                if not isinstance(chunk, tuple | list) or len(chunk) not in (2, 3):
                    raise TypeError(
                        f"a pair (X, Y) is needed, or (X, Y, U) with inputs or parameters; got "
                        f"{reprlib.repr(chunk)}. All of the data in one chunk is [(X, Y)]."
                    )
                X, Y = require.data(*chunk[:2], part=True)
            U = chunk[2] if len(chunk) == 3 else None
            if model is None:
                first, first_inputs = (
                    (X, U) if sample is None else (sample, inputs_or_parameters(inputs, parameters))
                )
                model = self.start(K, first, regularization, first_inputs)
            # The next chunk is read while this one is added, and no further ones pile up.
            jax.block_until_ready(model)
            with _naming(i):
                model = model.add(X, Y, U)
        if model is None:
            raise ValueError("fit_chunks needs at least one chunk (X, Y); the iterator was empty.")
        return model.field()


@contextlib.contextmanager
def _naming(chunk: int) -> Iterator[None]:
    """Add the number of the chunk to the message of an error."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = TypeError if isinstance(error, TypeError) else ValueError
        raise kind(f"chunk {chunk}, counted from 0: {error}") from error
    except BaseException as error:  # whatever reading the chunk raises, and Ctrl-C
        error.add_note(f"in chunk {chunk}, counted from 0")
        raise


def _refuse_energies(rows: Measurements) -> None:
    if len(rows.energies):
        raise ValueError(
            "a stream takes no energies: they are known up to a constant that all chunks would "
            "share. Give differences of H as hk.Functionals, or fit all of the data at once."
        )


def rows_at(K: AbstractMatrixKernel, points: Float[Array, "N d"]) -> Measurements:
    """The rows of velocities at points, with targets of zero."""
    block = components(K, points)
    return Measurements((block,), jnp.zeros(block.size, points.dtype))


def thin(K: AbstractMatrixKernel, sample: Measurements, count: int) -> Measurements:
    """Every k-th point, at most `count` points, replicated; all rows if not all are velocities."""
    if sample.states is None:
        return sample
    points = sample.points
    spread = row_sharding(points)
    subset = shard(spread, points)[:: -(-len(points) // count)]
    return rows_at(K, subset if spread is None else spread.replicate(subset))
