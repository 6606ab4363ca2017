"""The sizes of the pieces in which data are computed, for a CPU and for a GPU.

A CPU needs pieces that stay in its cache, a GPU needs pieces that fill it. JAX chooses the device
when it lowers a program, after Python has cut the data into pieces. So `sizes` asks for the default
device, of the process or of `with jax.default_device(…)` around the call. Public functions make the
device of their data the default device (`_machine.follow_data`).
"""

from typing import NamedTuple

import jax


def platform() -> str:
    """The platform of the default device, such as "cpu" or "gpu"."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    if device is None:
        return jax.default_backend()
    return device if isinstance(device, str) else device.platform


class Sizes(NamedTuple):
    """The numbers by which data are cut into pieces.

    Attributes:
        tile: rows and columns of a tile of a product with the Gram.
        states: states at which a field is evaluated at once.
        trace_points: points whose diagonal blocks of the Gram are computed at once.
        design_entries: entries of a tile of features whose normal equations are added up.
        strip_entries: entries of a strip of rows of the Gram.
        rows_in_place: the number of rows from which the Gram is factored in its own memory; None
            to do so only if a separate factor would not fit in memory.
    """

    tile: int
    states: int
    trace_points: int
    design_entries: int
    strip_entries: int
    rows_in_place: int | None


# Measured on two cores, or derived:
# - tile: 1000 × 1000 doubles are 8 MB. Tiles half and twice as large cost up to 15 % more, between
#   125 × 4000 and 2000 × 1000, n = 4 and 20.
# - states: with 1000 random features the waves of 1024 states take 8 MB.
# - trace_points: the blocks of 1024 points of a Gaussian stay in the cache. A million points take
#   16 ms, and 90 ms with 4096 points at once.
# - design_entries: 2²⁰ numbers, 8 MB, stay in the cache.
# - strip_entries: some kernels hold 40 numbers for each entry, 160 MB.
# - rows_in_place: the Gram of 6000 rows takes 288 MB.
_CPU = Sizes(
    tile=1000,
    states=1024,
    trace_points=1024,
    design_entries=2**20,
    strip_entries=500_000,
    rows_in_place=6000,
)

# Measured on an NVIDIA H200, jax 0.11:
# - tile: a product of 100 000 states with n = 4 in float64 took 337 ms with tiles of 1000, 184 ms
#   with 4000 and 175 ms with 10 000.
# - states: evaluating a field of 24 points at a million states took 14.1 ms in batches of 1024, and
#   .92 ms with 2¹⁷ at once; 2²⁰ at once are no faster.
# - strip_entries: a fit of 8000 rows took 15.5 ms with 500 000, 13.8 ms with 2²² and 12.8 ms with
#   2²⁴; with 40 numbers for each entry, 2²⁴ entries would take 5 GB.
# - rows_in_place: 16 000 rows took 107 ms in place and 54 ms otherwise, so only memory decides.
# Derived: trace_points as states; design_entries are 134 MB, products of 33 GFLOP with 1000
# features, .6 ms at 57 TFLOP/s, against 5 µs to start a kernel.
_GPU = Sizes(
    tile=4000,
    states=2**17,
    trace_points=2**17,
    design_entries=2**24,
    strip_entries=2**22,
    rows_in_place=None,
)


def sizes() -> Sizes:
    """The sizes for the default device."""
    return _CPU if platform() == "cpu" else _GPU
