"""Every test runs in float64 with strict promotion, and with the annotations executed.

Strict promotion makes a silent change of dtype an error, and the import hook checks the shapes in
every signature of the package at every call.
"""

import os

import jax
import jaxtyping
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Every module that is imported from here on, also later and by itself.
jaxtyping.install_import_hook("hamkernel", "beartype.beartype").__enter__()


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(20231217)
