"""What the public functions require of their arguments, said before any long computation.

Shapes, dtypes and configuration are known while tracing and raise at once. Values are checked
by NumPy when they are concrete, for it compiles nothing; under `jax.jit` the same check becomes
`equinox.error_if` on the value that is returned, so it must be used by the caller.
"""

# ruff: noqa: F401 - gathered here to be used as `require.floating`

from hamkernel._require.fields import elapsed, other_arguments, times, velocity
from hamkernel._require.numbers import (
    count,
    finite,
    floating,
    key,
    listed,
    positive,
    positive_number,
    positive_scalar,
    ridge,
    single_or_double,
)
from hamkernel._require.states import (
    data,
    measured,
    one_dtype,
    point,
    points,
    same_space,
    warn_of_few_points,
    warn_of_float32,
)
from hamkernel._require.values import is_concrete, not_finite, on_host, traceable, value, warn
