"""A learned field is a pure function: compiled, exported, and called where hamkernel is not."""

import subprocess
import sys

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk

pytest.importorskip("flatbuffers", reason="jax.export needs it to write programs")

RNG = np.random.default_rng(8)
X = RNG.normal(size=(24, 2))
Y = RNG.normal(size=(24, 2))
STATES = RNG.normal(size=(7, 2))

KERNELS = {
    "odd symplectic": hk.Odd(hk.Symplectic(hk.Gaussian(1.3))),
    "matern": hk.CurlFree(hk.Matern(2.5)),
    "sum": hk.Symplectic(hk.Polynomial(3)) + hk.Separable(hk.Gaussian()),
}
# The exported program is compiled again: fused otherwise, its sums round otherwise.
ROUNDING = 1e-12

ELSEWHERE = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("hamkernel", "equinox", "lineax", "diffrax", "optimistix"):
            raise ImportError(name)
sys.meta_path.insert(0, Block())
import jax
jax.config.update("jax_enable_x64", True)
import jax.export
import numpy as np
folder = sys.argv[1]
exported = jax.export.deserialize(bytearray(open(folder + "/field.bin", "rb").read()))
states = np.load(folder + "/states.npy")
np.save(folder + "/values.npy", np.stack([exported.call(x) for x in states]))
try:
    import hamkernel
except ImportError:
    print("blocked")
"""


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=ROUNDING * np.abs(expected).max())


@pytest.mark.few(1)
@pytest.mark.parametrize("name", KERNELS)
def test_a_field_is_jitted_as_it_is(name):
    field = hk.fit(KERNELS[name], X, Y, 1e-2)
    close(jax.jit(field)(jnp.asarray(STATES[0])), field(jnp.asarray(STATES[0])))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", KERNELS)
def test_an_exported_field_is_called_without_hamkernel(name, tmp_path):
    field = hk.fit(KERNELS[name], X, Y, 1e-2)
    exported = jax.export.export(jax.jit(field))(jax.ShapeDtypeStruct((2,), float))
    (tmp_path / "field.bin").write_bytes(exported.serialize())
    np.save(tmp_path / "states.npy", STATES)
    done = subprocess.run(
        [sys.executable, "-c", ELSEWHERE, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert done.stdout.strip() == "blocked"
    close(np.load(tmp_path / "values.npy"), jax.vmap(field)(jnp.asarray(STATES)))


def test_any_number_of_states_is_exported_at_once():
    field = hk.fit(KERNELS["odd symplectic"], X, Y, 1e-2)
    (batch,) = jax.export.symbolic_shape("batch")
    states = jax.ShapeDtypeStruct((batch, 2), float)
    exported = jax.export.export(jax.jit(jax.vmap(field)))(states)
    again = jax.export.deserialize(bytearray(exported.serialize()))
    for count in (1, 5):
        close(again.call(STATES[:count]), jax.vmap(field)(jnp.asarray(STATES[:count])))


def test_the_hamiltonian_is_exported_too():
    field = hk.fit(KERNELS["odd symplectic"], X, Y, 1e-2)
    exported = jax.export.export(jax.jit(field.hamiltonian))(jax.ShapeDtypeStruct((2,), float))
    again = jax.export.deserialize(bytearray(exported.serialize()))
    expected = jax.vmap(field.hamiltonian)(jnp.asarray(STATES))
    close(np.stack([again.call(x) for x in STATES]), expected)


def test_a_state_of_another_shape_is_refused_by_the_exported_field():
    field = hk.fit(KERNELS["odd symplectic"], X, Y, 1e-2)
    exported = jax.export.export(jax.jit(field))(jax.ShapeDtypeStruct((2,), float))
    with pytest.raises(ValueError, match="shape"):
        exported.call(np.zeros(3))
