"""Every test runs in float64 with strict promotion: a silent change of dtype is an error."""

import collections
import gc
import os
import pathlib
import warnings
import zlib

# Before NumPy loads. The threads of BLAS in two workers on two cores wait for each other: half of
# the time of test_validation_low_rank.py.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Most programs run once, and compiling them as for a user takes 2.5 times the suite's CPU time:
# LLVM's optimiser is a third of it, and a pipeline of MLIR for each fusion half of the rest
# (test_observations.py: 86 s with that pipeline, 43 without).
# `.ci/run` compiles as for a user for its slow tests and those of rounding, with empty XLA_FLAGS.
os.environ["FAST_XLA_FLAGS"] = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)
os.environ.setdefault("XLA_FLAGS", os.environ["FAST_XLA_FLAGS"])
# JAX hashes each program for a cache on disk, also where no such cache is.
os.environ.setdefault("JAX_ENABLE_COMPILATION_CACHE", "false")

import jax
import numpy as np
import pytest

os.environ.setdefault("MPLBACKEND", "Agg")
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.hookimpl(tryfirst=True)  # before pytest deselects what is slow
def pytest_collection_modifyitems(items):
    """Of the cases of a test that is marked `few(count)`, all but `count` are slow."""
    cases = collections.defaultdict(list)
    for item in items:
        if item.get_closest_marker("few") and not item.get_closest_marker("slow"):
            cases[item.path, item.originalname].append(item)
    for of_test in cases.values():
        # By a hash of the name: as good as at random, and the same in every run.
        of_test.sort(key=lambda item: zlib.crc32(item.name.encode()))
        (count,) = of_test[0].get_closest_marker("few").args
        for item in of_test[count:]:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish():
    """Collect garbage less often: with Python's thresholds that is 6 % of test_linear_operator.py.

    Tracing allocates many small objects that live, so most collections free nothing.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


@pytest.fixture
def fast_compilation() -> dict[str, str]:
    """The environment of a process whose programs run once, also where CI sets no XLA_FLAGS."""
    return os.environ | {"XLA_FLAGS": os.environ["FAST_XLA_FLAGS"]}


@pytest.fixture(scope="module", autouse=True)
def _few_compiled_programs():
    """Each compiled program maps memory, and Linux has a limit of 65,530 maps: drop them in time.

    Dropped after each module, a sixth of the CPU time compiles programs of modules before. Ours
    have 2,000 maps and 300 MB each.
    """
    yield
    maps = pathlib.Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > 12_000:
        jax.clear_caches()


@pytest.fixture
def key() -> jax.Array:
    return jax.random.key(20231217)


@pytest.fixture(scope="session")
def learned():
    """What `learn` finds in two short logs of the angle of a pendulum, q̈ = −sin q, mass 1."""
    import hamkernel as hk  # after the settings above

    rng, ts, positions = np.random.default_rng(0), np.linspace(0.0, 5.7, 20), []
    for q, p in [(1.2, 0.0), (0.4, 1.0)]:
        rows = []
        for i in range(5701):  # leaps of a millisecond
            if i % 300 == 0:
                rows.append(q)
            half = p - 0.0005 * np.sin(q)
            q += 0.001 * half
            p = half - 0.0005 * np.sin(q)
        positions.append(np.array(rows) + 0.01 * rng.normal(size=20))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the log is short
        K = hk.Symplectic(hk.Select(hk.Gaussian(2.0), 0))
        runs = hk.Runs([ts] * 2, positions)
        return hk.learn(K, runs, mass=1.0, iterations=2, progress=False)
