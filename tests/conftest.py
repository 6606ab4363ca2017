"""Every test runs in float64 with strict promotion: a silent change of dtype is an error."""

import os

# Before NumPy loads. The threads of BLAS in two workers on two cores wait for each other: half of
# the time of test_validation_low_rank.py.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(scope="module", autouse=True)
def _few_compiled_programs():
    """Each module compiles thousands of programs, and each program maps memory: drop them."""
    yield
    jax.clear_caches()


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(20231217)
