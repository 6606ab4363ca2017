"""What `save` writes, `load` reads bit by bit; what is not such a file is refused and not run."""

import copy
import io
import itertools
import json
import os
import pickle
import re
import subprocess
import sys
import warnings
import zipfile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hamkernel as hk
from hamkernel import RandomFeatures, load, save
from hamkernel._kernels.symmetry import Symmetrised, identity
from hamkernel._save import _ours, description, seal, skeleton

RNG = np.random.default_rng(5)
X = RNG.normal(size=(6, 2))
Y = RNG.normal(size=(6, 2))


def on_cylinder(x):
    return jnp.stack([jnp.cos(x[0]), jnp.sin(x[0]), x[1]])


class Turned(eqx.Module):
    """A user's kernel with arrays of its own."""

    log_scale: jax.Array
    angle: jax.Array

    def __call__(self, x, z):
        return jnp.exp(jnp.cos(self.angle) * (x @ z) / jnp.exp(2 * self.log_scale))


class TurnedBack(Turned):
    """Another kernel with the same arrays."""

    def __call__(self, x, z):
        return super().__call__(x, -z)


def turned(scale=0.7, angle=0.2):
    return Turned(jnp.log(jnp.asarray(scale)), jnp.asarray(angle))


def cosine(x, z):
    return jnp.exp(jnp.cos(x[0] - z[0]) + x[1] * z[1])


BUILT_IN = {
    "gaussian": hk.Symplectic(hk.Gaussian(1.3)),
    "one lengthscale each": hk.Symplectic(hk.Gaussian(np.array([1.3, 0.4]))),
    "matern": hk.CurlFree(hk.Matern(3.5, 2.0)),
    "rational quadratic": hk.DivergenceFree(hk.RationalQuadratic(0.5, 2.0)),
    "polynomial": hk.Symplectic(hk.Polynomial(3, 0.5) + hk.Gaussian()),
    "periodic times scaled": hk.Separable(hk.Periodic(2.0, 1.1) * (3.0 * hk.Gaussian())),
    "select": hk.Symplectic(hk.Select(hk.Gaussian(), 0) + 0.1 * hk.Select(hk.Matern(), [1])),
    "odd": hk.Odd(hk.Symplectic(hk.Gaussian(2.0))),
    "even of a polynomial": hk.Even(hk.Symplectic(hk.Polynomial(3))),
    "sum with names": hk.Sum(
        hk.Separable(hk.Gaussian()),
        energy=hk.Odd(hk.Symplectic(hk.Gaussian())),
        rest=hk.CurlFree(hk.Matern()),
    ),
}
USERS = {  # as saved, and as given to load with other values
    "function": (hk.Symplectic(cosine), hk.Symplectic(cosine)),
    "module": (hk.Symplectic(turned()), hk.Symplectic(turned(2.0, 1.0))),
    "warp": (
        hk.Symplectic(hk.Warp(hk.Gaussian(0.6), on_cylinder)),
        hk.Symplectic(hk.Warp(hk.Gaussian(), on_cylinder)),
    ),
    "odd of a warp": (
        hk.Odd(hk.Symplectic(hk.Warp(hk.Gaussian(0.6), on_cylinder))),
        hk.Odd(hk.Symplectic(hk.Warp(hk.Gaussian(), on_cylinder))),
    ),
    "sum with a built-in": (
        hk.Sum(mine=hk.Symplectic(turned()), theirs=hk.CurlFree(hk.Gaussian(2.0))),
        hk.Sum(mine=hk.Symplectic(turned(1.0)), theirs=hk.CurlFree(hk.Gaussian())),
    ),
}


def fitted(K=None, regularization=1e-2):
    return hk.fit(K or hk.Symplectic(hk.Gaussian(1.3)), X, Y, regularization)


def same(a, b):
    """Every array equal bit by bit, in a tree of the same classes and static fields."""
    first, first_tree = jax.tree.flatten(a)
    second, second_tree = jax.tree.flatten(b)
    arrays = all(
        np.asarray(x).dtype == np.asarray(y).dtype
        and np.asarray(x).tobytes() == np.asarray(y).tobytes()
        for x, y in zip(first, second, strict=True)
    )
    return arrays and first_tree == second_tree


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "field.npz"
    save(path, fitted())
    return path


@pytest.mark.few(2)
@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_kernels_restore_by_themselves(name, tmp_path):
    field = fitted(BUILT_IN[name])
    save(tmp_path / "f", field)
    loaded = load(tmp_path / "f")
    assert type(loaded) is type(field)
    assert same(field, loaded)
    x = jnp.array([0.3, -0.7])
    np.testing.assert_array_equal(jax.jit(field)(x), jax.jit(loaded)(x))


@pytest.mark.few(4)
@pytest.mark.parametrize("name", BUILT_IN)
def test_the_kernel_may_be_given_for_a_built_in_one_too(name, tmp_path):
    field = fitted(BUILT_IN[name])
    save(tmp_path / "f", field)
    other = jax.tree.map(lambda leaf: leaf + 1, BUILT_IN[name])
    assert same(field, load(tmp_path / "f", kernel=other))


SCALAR = {
    "one": hk.Gaussian(1.1),
    "a sum": hk.Gaussian(1.1) + hk.Matern(2.5, 0.9),
    "a product": hk.Gaussian(1.1) * hk.Polynomial(2),
    "scaled": 2.0 * (hk.Gaussian(1.1) + 3.0 * hk.Matern(2.5)),
    "selected": hk.Select(hk.Gaussian(), 0) + hk.Select(hk.Matern(), 1),
    "warped": hk.Warp(hk.Gaussian() + hk.Matern(), on_cylinder),
    "the user's": hk.Gaussian() + turned(),
}
STRUCTURES = {
    "Symplectic": hk.Symplectic,
    "CurlFree": hk.CurlFree,
    "DivergenceFree": hk.DivergenceFree,
    "Separable": hk.Separable,
    "PortHamiltonian": hk.PortHamiltonian,
    "Poisson": lambda k: hk.Poisson(k, hk.poisson.lotka_volterra),
    "UnknownMasses": lambda k: hk.UnknownMasses(hk.Symplectic(k), np.array([1.0, 2.0])),
    "Sum": lambda k: hk.Sum(hk.Symplectic(k), rest=hk.CurlFree(k)),
}
SYMMETRIES = {
    "no symmetry": lambda K: K,
    "Odd": hk.Odd,
    "Even": hk.Even,
    "Reversible": hk.Reversible,
    "Odd and Reversible": lambda K: hk.Reversible(hk.Odd(K)),
    "Invariant": lambda K: hk.Invariant(K, [np.diag([1.0, -1.0])]),
}
NOT_SYMMETRIC = {"Poisson", "UnknownMasses", "Sum", "CurlFree", "DivergenceFree", "Separable"}


def combined(structure, symmetry, scalar):
    """The kernel, and as the drift of one with inputs; nothing where there is no such kernel."""
    try:
        K = SYMMETRIES[symmetry](STRUCTURES[structure](SCALAR[scalar]))
    except (TypeError, ValueError):
        assert structure in (*NOT_SYMMETRIC, "PortHamiltonian")
        assert symmetry != "no symmetry"
        return []
    return [K, hk.Controlled(K, hk.InputMatrix(SCALAR[scalar]), count=1)]


@pytest.mark.parametrize("structure", STRUCTURES)
def test_every_symmetry_of_every_scalar_kernel_is_stored_hashed_and_added(structure):
    for symmetry, scalar in itertools.product(SYMMETRIES, SCALAR):
        for K in combined(structure, symmetry, scalar):
            codes = []  # what `save` writes, without a field to evaluate
            node = json.loads(json.dumps(description(K, codes, "field")))
            like = skeleton(node, codes, "field", {})
            again = jax.tree.map(lambda _, array: array, like, K)
            assert same(again, K)
            assert hash(again) == hash(K)
            for k in K.scalar_kernels:
                assert hash(k) == hash(sum([k]))
                more = k + hk.Matern()
                assert repr(more)
                assert more.terms[-1] == hk.Matern()


@pytest.mark.slow
def test_a_symmetry_over_a_sum_of_scalar_kernels_is_saved(tmp_path):
    K = hk.Odd(hk.Symplectic(hk.Gaussian(1.0) + hk.Matern(2.5, 1.0)))
    for field in (fitted(K), hk.tune(K, X, Y, starts=1, max_steps=1, solver=hk.Cholesky()).field):
        save(tmp_path / "f", field)
        assert same(field, load(tmp_path / "f"))
        assert hash(field.kernel.scalar_kernels[0])
        assert repr(field.kernel.scalar_kernels[0] + hk.Gaussian())


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "K",
    [
        hk.Odd(hk.Symplectic(hk.Gaussian(1.3) + hk.Matern(2.5, 0.9))),
        hk.DivergenceFree(hk.Gaussian()) + hk.Separable(hk.Matern()),
    ],
    ids=["odd of a sum", "sum"],
)
def test_fields_in_random_features_restore(K, tmp_path):
    field = hk.fit(K, X, Y, 1e-2, solver=RandomFeatures(20, jax.random.key(0)))
    save(tmp_path / "f", field)
    assert same(field, load(tmp_path / "f"))


def test_features_of_an_operator_of_the_user_restore(tmp_path):
    def operator(x):
        return jnp.array([[0.0, 1.0], [-1.0, -0.1]])

    K = hk.Structured(hk.Gaussian(), operator)
    field = hk.fit(K, X, Y, 1e-2, solver=RandomFeatures(20, jax.random.key(0)))
    save(tmp_path / "f", field)
    with pytest.raises(ValueError, match=r"code that is not in the file.*kernel=\.\.\."):
        load(tmp_path / "f")
    assert same(field, load(tmp_path / "f", kernel=K))


def test_a_field_without_stored_residuals_restores(tmp_path):
    K = hk.Symplectic(hk.Gaussian(1.3))
    field = RandomFeatures(20, jax.random.key(0)).fit_chunks(K, [(X, Y)], 1e-2)
    save(tmp_path / "f", field)
    assert same(field, load(tmp_path / "f"))


@pytest.mark.few(1)
@pytest.mark.parametrize("name", USERS)
def test_a_kernel_of_the_user_is_given_and_gets_the_saved_arrays(name, tmp_path):
    kernel, given = USERS[name]
    field = fitted(kernel)
    save(tmp_path / "f", field)
    assert same(field, load(tmp_path / "f", kernel=given))


def test_a_learned_mean_of_the_user_s_kernel_is_given_beside_the_kernel(tmp_path):
    K, mean = hk.Symplectic(turned()), fitted(hk.Symplectic(cosine))
    field = hk.fit(K, X, Y, 1e-2, mean=mean)
    save(tmp_path / "f", field)
    with pytest.raises(ValueError, match=r"cosine.*mean=\.\.\."):
        load(tmp_path / "f", kernel=K)
    assert same(field, load(tmp_path / "f", kernel=K, mean=mean))


@pytest.mark.parametrize("name", USERS)
def test_a_kernel_of_the_user_is_asked_for(name, tmp_path):
    save(tmp_path / "f", fitted(USERS[name][0]))
    with pytest.raises(ValueError, match=r"code that is not in the file.*kernel=\.\.\."):
        load(tmp_path / "f")


@pytest.mark.parametrize(
    ("kernel", "given", "message"),
    [
        (hk.Symplectic(turned()), hk.CurlFree(turned()), "Symplectic in the file and CurlFree"),
        (hk.Symplectic(turned()), hk.Symplectic(cosine), "array"),
        (hk.Symplectic(turned()), hk.Symplectic(hk.Gaussian()), "UserKernel in the file"),
        (
            hk.Symplectic(turned()),
            hk.Symplectic(Turned(jnp.zeros(2), jnp.asarray(0.0))),
            r'"shape": \[2\]',
        ),
        (hk.CurlFree(hk.Matern(2.5)), hk.CurlFree(hk.Matern(1.5)), "2.5 in the file and 1.5"),
        (
            hk.Symplectic(hk.Gaussian() + turned()),
            hk.Symplectic(hk.Gaussian() + turned() + turned()),
            "2 terms in the file and 3",
        ),
    ],
)
def test_another_kernel_than_the_saved_one_is_refused(kernel, given, message, tmp_path):
    save(tmp_path / "f", fitted(kernel))
    with pytest.raises(ValueError, match=message):
        load(tmp_path / "f", kernel=given)


def test_kernel_must_be_matrix_valued(saved):
    with pytest.raises(TypeError, match="matrix-valued"):
        load(saved, kernel=hk.Gaussian())  # type: ignore[arg-type]


def test_float32_stays_float32(tmp_path):
    with pytest.warns(UserWarning, match="float32"):
        field = hk.fit(
            hk.Symplectic(hk.Gaussian(1.3)), X.astype("float32"), Y.astype("float32"), 1e-2
        )
    save(tmp_path / "f", field)
    loaded = load(tmp_path / "f")
    assert same(field, loaded)
    assert loaded(jnp.zeros(2, "float32")).dtype == jnp.float32


def test_what_the_field_was_anchored_to_and_fitted_with_is_kept(tmp_path):
    field = fitted().anchored(jnp.zeros(2), 3.0)
    save(tmp_path / "f", field)
    loaded = load(tmp_path / "f")
    assert isinstance(loaded, hk.KernelField)
    np.testing.assert_allclose(loaded.hamiltonian(jnp.zeros(2)), 3.0, rtol=1e-14)
    np.testing.assert_array_equal(loaded.points, X)
    assert loaded.regularization == 1e-2


def test_numpy_reads_the_file_without_pickle(saved):
    with saved.open("rb") as file:
        first, header = file.readline(), json.loads(file.readline())
        stored = []
        while file.peek(1):
            stored.append(np.load(file, allow_pickle=False))
    assert first.startswith(b"hamkernel field, version 2, sha256 ")
    assert header["hamkernel"]
    assert header["field"]["kernel"]["kernel"]["class"] == "Gaussian"
    assert any(array.shape == X.shape and (array == X).all() for array in stored)


def test_another_process_evaluates_the_same_field(saved):
    code = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "import sys, jax.numpy as jnp\n"
        "from hamkernel._save import load\n"
        "print(bytes(memoryview(jax.jit(load(sys.argv[1]))(jnp.array([0.3, -0.7])))).hex())"
    )
    command = [sys.executable, "-c", code, str(saved)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    here = jax.jit(fitted())(jnp.array([0.3, -0.7]))
    assert bytes.fromhex(done.stdout) == np.asarray(here).tobytes()


def test_float64_is_refused_where_jax_would_cut_it(saved):
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(ValueError, match="jax_enable_x64"):
            load(saved)
    finally:
        jax.config.update("jax_enable_x64", True)


# Writing.


def test_a_folder_is_no_file_to_write(tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder; save needs the name of a file"):
        save(tmp_path, fitted(hk.CurlFree(hk.Gaussian())))
    assert not list(tmp_path.iterdir())


def test_a_write_that_fails_leaves_the_old_file_and_no_other(saved, monkeypatch):
    before = saved.read_bytes()
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save(saved, fitted(hk.CurlFree(hk.Gaussian())))
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_saving_replaces_the_file_and_leaves_no_other(saved):
    field = fitted(hk.CurlFree(hk.Gaussian()))
    save(str(saved), field)
    assert same(field, load(str(saved)))
    assert list(saved.parent.iterdir()) == [saved]


def test_only_fields_are_saved(tmp_path):
    with pytest.raises(TypeError, match=r"KernelField.*Learned.*got Symplectic"):
        save(tmp_path / "f", hk.Symplectic(hk.Gaussian()))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_stored_is_named(tmp_path):
    field = eqx.tree_at(lambda f: f.norm, fitted(), jnp.asarray(1j))
    with pytest.raises(TypeError, match=r"field\.norm has dtype complex128"):
        save(tmp_path / "f", field)


def test_another_function_than_the_saved_one_is_refused(tmp_path):
    X, Y = jnp.asarray(RNG.normal(size=(6, 2))), jnp.ones((6, 2))

    def kernel(function):
        return hk.Symplectic(hk.Warp(hk.Gaussian(), function))

    def circle(x):
        return jnp.array([jnp.cos(x[0]), jnp.sin(x[0]), x[1]])

    field = hk.fit(kernel(circle), X, Y, 1e-3)
    hk.save(tmp_path / "f", field)
    again = hk.load(tmp_path / "f", kernel=kernel(lambda x: circle(x)))
    np.testing.assert_array_equal(again(X[1]), field(X[1]))
    with pytest.raises(ValueError, match=r"a function in the kernel is not the one"):
        hk.load(tmp_path / "f", kernel=kernel(lambda x: jnp.array([x[0], x[1], 0.0])))


def test_another_function_is_refused_where_the_first_state_is_an_equilibrium(tmp_path):
    def first(x, z):
        return jnp.exp(-0.5 * (x @ x + z @ z - 2 * (x @ z)))

    def second(x, z):
        return 1 / (1 + (x @ x + z @ z - 2 * (x @ z)))

    def odd(k):
        return hk.Odd(hk.Symplectic(k))

    X = np.array([[0.0, 0.0], [1.0, 0.5], [-0.5, 1.0]])
    hk.save(tmp_path / "f.npz", hk.fit(odd(first), X, X[:, ::-1] * [1, -1], 1e-3))
    assert isinstance(hk.load(tmp_path / "f.npz", kernel=odd(first)), hk.KernelField)
    with pytest.raises(ValueError, match=r"a function in the kernel is not the one"):
        hk.load(tmp_path / "f.npz", kernel=odd(second))


def test_a_batch_of_fields_is_refused_before_it_is_lost(tmp_path):
    X, Y = jnp.eye(4), jnp.ones((3, 4, 4))
    K = hk.Symplectic(hk.Gaussian())
    batch = jax.vmap(lambda Y: hk.fit(K, X, Y, 1e-3))(Y)
    with pytest.raises(ValueError, match=r"save each field.*one axis more"):
        hk.save(tmp_path / "batch", batch)
    assert not (tmp_path / "batch").exists()


def test_saving_under_jit_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"under jax\.jit"):
        eqx.filter_jit(lambda field: save(tmp_path / "f", field))(fitted())


# Damaged, foreign and forged files. None of these may end in anything but a ValueError.


def places(content):
    """Where one part of a file ends and the next begins, and some inside of every part."""
    ends = [found.start() for found in re.finditer(b"\n|\x93NUMPY", content)]
    around = {end + step for end in [*ends, len(content)] for step in (-2, -1, 0, 1)}
    return sorted({*around, *range(0, len(content), 101)} & set(range(len(content))))


def test_a_file_cut_at_any_length_is_refused(saved):
    content = saved.read_bytes()
    for length in places(content):
        saved.write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"hamkernel\.save"):
            load(saved)


def test_a_file_with_anything_appended_is_refused(saved):
    saved.write_bytes(saved.read_bytes() + b"\n")
    with pytest.raises(ValueError, match="cut off or was changed"):
        load(saved)


def test_any_changed_byte_is_found(saved):
    content = saved.read_bytes()
    for place in places(content):
        changed = bytearray(content)
        changed[place] ^= 1 << RNG.integers(8)
        saved.write_bytes(changed)
        with pytest.raises(ValueError, match=r"hamkernel\.save"):
            load(saved)


@pytest.mark.parametrize("kind", ["empty", "text", "npy", "npz", "zip", "pickle", "objects"])
def test_a_foreign_file_is_refused(kind, tmp_path):
    path, buffer = tmp_path / "f", io.BytesIO()
    if kind == "npy":
        np.save(buffer, X)
    elif kind == "npz":
        np.savez(buffer, header=X, array_0=Y)
    elif kind == "objects":
        np.savez(buffer, header=np.array([Bomb(path)], object))
    elif kind == "zip":
        with zipfile.ZipFile(buffer, "w") as archive:
            archive.writestr("../../etc/header.npy", "text")
    elif kind == "pickle":
        buffer.write(pickle.dumps(Bomb(path)))
    elif kind == "text":
        buffer.write(b"q,p\n0.0,1.0\n" * 20)
    path.write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match=r"hamkernel\.save"):
        load(path)
    assert not (tmp_path / "exploded").exists()


def test_a_missing_file_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nothing")


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path.parent / "exploded"

    def __reduce__(self):
        return (self.path.touch, ())


def parts(content):
    """The header and the leaves of a file of `save`."""
    _, header, leaves = content.split(b"\n", 2)
    return json.loads(header), leaves


def forge(path, header, leaves):
    """Write a file with a right checksum, as a forger would who has read the source."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(seal(text + b"\n" + leaves))


def test_a_forged_file_without_a_change_is_read(saved):
    forge(saved, *parts(saved.read_bytes()))
    assert same(fitted(), load(saved))


def scalar(header):
    return header["field"]["kernel"]["kernel"]


FORGERIES = {
    "no field": (lambda h: h.pop("field"), "not a valid file"),
    "an unknown class": (lambda h: scalar(h).update({"class": "os.system"}), "unknown class"),
    "a class that is no name": (lambda h: scalar(h).update({"class": ["Gaussian"]}), "no part"),
    "a class of another room": (
        lambda h: scalar(h).update({"class": "SearchSpace"}),
        "unknown class",
    ),
    "a carrier of code": (lambda h: scalar(h).update({"class": "Bound"}), "unknown class"),
    "a kernel for a field": (lambda h: h.update(field=scalar(h)), "no learned field"),
    "a field that is no node": (lambda h: h.update(field=[1]), "not a valid file"),
    "a field in a field": (
        lambda h: scalar(h).update(copy.deepcopy(h["field"])),
        "does not have the fields",
    ),
    "an unknown function": (
        lambda h: scalar(h).update(log_lengthscale={"function": "eval"}),
        "no part of a field",
    ),
    "a missing field": (lambda h: scalar(h).pop("log_lengthscale"), "does not have the fields"),
    "an unknown node": (lambda h: scalar(h).update(log_lengthscale={}), "no part of a field"),
    "an array of another shape": (
        lambda h: h["field"]["points"].update(shape=[5, 2]),
        "has changed shape",
    ),
    "an array of another type": (
        lambda h: h["field"]["points"].update(array="float32"),
        "has changed dtype",
    ),
    "an array of objects": (lambda h: h["field"]["points"].update(array="O"), "not a valid file"),
    "a shape that is none": (lambda h: h["field"]["points"].update(shape=["x"]), "not a valid"),
    "code of a caller": (
        lambda h: scalar(h).update(log_lengthscale={"code": "f", "leaves": []}),
        "code that is not in the file",
    ),
}


@pytest.mark.few(6)
@pytest.mark.parametrize("name", FORGERIES)
def test_a_forged_header_is_refused(name, saved):
    header, leaves = parts(saved.read_bytes())
    change, message = FORGERIES[name]
    change(header)
    forge(saved, header, leaves)
    with pytest.raises(ValueError, match=message):
        load(saved)


def npy(array, **options):
    buffer = io.BytesIO()
    np.save(buffer, array, **options)
    return buffer.getvalue()


def huge():
    buffer = io.BytesIO()
    claim = {"shape": (2**40, 2), "fortran_order": False, "descr": "<f8"}
    np.lib.format.write_array_header_1_0(buffer, claim)
    return buffer.getvalue()


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "content",
    [
        npy(np.array([{}], object), allow_pickle=True),
        npy(np.array([1j])),
        npy(np.array(["text"])),
        npy(np.zeros((6, 2)))[:-8],
        npy(np.zeros((5, 2))),
        npy(X) + npy(X),
        b"\x93NUMPY\x01\x00\x10\x00{'shape': (-1,)}",
        b"not an array",
        b"",
        huge(),
    ],
    ids="objects complex text short shape more keys none empty huge".split(),
)
def test_a_forged_array_is_refused(content, saved):
    header, leaves = parts(saved.read_bytes())
    assert leaves.count(npy(X)) == 1
    forge(saved, header, leaves.replace(npy(X), content))
    with pytest.raises(ValueError, match="not a valid file"):
        load(saved)


def test_files_of_other_versions_say_what_to_do(saved, tmp_path):
    saved.write_bytes(saved.read_bytes().replace(b"version 2", b"version 3", 1))
    with pytest.raises(ValueError, match=r"version 3 of the format.*the hamkernel that wrote it"):
        load(saved)
    np.savez(tmp_path / "old.npz", header=X, array_0=Y)  # as before the first release
    with pytest.raises(ValueError, match=r"before 0\.1\.0: fit again"):
        load(tmp_path / "old.npz")


def swapped(x):
    return x[::-1]


def test_another_group_of_maps_than_the_saved_one_is_refused(tmp_path):
    save(tmp_path / "f", fitted(hk.Odd(hk.Symplectic(hk.Gaussian()))))
    other = Symmetrised(hk.Gaussian(), (identity, swapped), (1.0, -1.0), one_sided=True)
    with pytest.raises(ValueError, match="not the one saved"):
        load(tmp_path / "f", kernel=hk.Symplectic(other))


@pytest.mark.parametrize("text", [b"", b"{", b"[1]", b"\xff", b"[" * 10**5, b'{"field": NaN}'])
def test_a_header_that_is_no_header_is_refused(text, saved):
    forge(saved, text, parts(saved.read_bytes())[1])
    with pytest.raises(ValueError, match=r"hamkernel\.save"):
        load(saved)


def test_a_deep_tree_is_refused(saved):
    header, leaves = parts(saved.read_bytes())
    for _ in range(2000):
        scalar(header)["log_lengthscale"] = [scalar(header)["log_lengthscale"]]
    text = "[" * 2000 + "]" * 2000
    scalar(header)["log_lengthscale"] = "deep"
    forge(saved, json.dumps(header).replace('"deep"', text).encode(), leaves)
    with pytest.raises(ValueError, match="not a valid file"):
        load(saved)


def test_parts_that_do_not_fit_each_other_are_refused(tmp_path):
    save(tmp_path / "f", fitted(hk.Symplectic(hk.Gaussian(np.array([1.0, 2.0])))))
    header, leaves = parts((tmp_path / "f").read_bytes())
    scalar(header)["log_lengthscale"]["shape"] = [3]
    old = npy(np.log([1.0, 2.0]))
    assert leaves.count(old) == 1
    forge(tmp_path / "f", header, leaves.replace(old, npy(np.zeros(3))))
    with pytest.raises(ValueError, match=r"not a valid file.*3 lengthscales"):
        load(tmp_path / "f")


def test_what_the_given_kernel_leaves_open_is_taken_from_the_file(tmp_path):
    K = hk.Controlled(hk.Symplectic(turned()), inputs=hk.InputMatrix(1.0, acts_on=(1,)))
    field = hk.fit(K, X, Y, 1e-2, inputs=X[:, :1])  # which counts the inputs
    save(tmp_path / "f", field)
    assert same(field, load(tmp_path / "f", kernel=K))


def test_no_two_classes_that_a_file_may_name_have_one_name():
    found = [eqx.Module]
    for cls in found:  # which grows
        found += cls.__subclasses__()
    ours = [cls for cls in dict.fromkeys(found) if _ours(cls)]
    assert len({cls.__name__ for cls in ours}) == len(ours)


def nodes(tree):
    """Every object and list of a JSON tree."""
    yield tree
    for child in tree.values() if isinstance(tree, dict) else tree:
        if isinstance(child, dict | list):
            yield from nodes(child)


def test_a_header_with_any_value_exchanged_gives_a_field_or_a_value_error(tmp_path):
    save(tmp_path / "f", fitted(BUILT_IN["sum with names"]))
    content = (tmp_path / "f").read_bytes()
    junk = [None, -1, 3, 1e300, "reflection", [], {}, [[]], {"array": "float64", "shape": []}]
    refused = 0
    for _ in range(60):
        header, leaves = parts(content)
        inner = [node for node in nodes(header["field"]) if node]
        node = inner[RNG.integers(len(inner))]
        keys = list(node) if isinstance(node, dict) else range(len(node))
        node[keys[RNG.integers(len(keys))]] = junk[RNG.integers(len(junk))]
        forge(tmp_path / "f", header, leaves)
        try:
            load(tmp_path / "f")
        except ValueError:
            refused += 1
    assert refused > 30


def test_a_field_that_is_nan_is_not_saved(tmp_path):
    X = np.random.default_rng(0).normal(size=(6, 2))
    twice = np.concatenate([X, X])
    field = hk.fit(hk.Symplectic(hk.Gaussian(2.0)), twice, twice, 1e-30, throw=False)
    with pytest.raises(ValueError, match="nothing to save"):
        hk.save(tmp_path / "field", field)
    assert not list(tmp_path.iterdir())


# Results.


def test_what_was_learned_is_loaded_whole(learned, tmp_path):
    save(tmp_path / "f", learned)
    loaded = load(tmp_path / "f")
    assert same(loaded, learned)
    assert repr(loaded) == repr(learned)
    assert loaded.diagnostics == learned.diagnostics
    assert all(type(t) is np.ndarray for t in loaded.runs.times)
    x = jnp.array([0.3, -0.7])
    np.testing.assert_array_equal(loaded.posterior.deviation(x), learned.posterior.deviation(x))
    some = learned.runs.part([slice(None), slice(0, 0)])
    np.testing.assert_array_equal(
        loaded.score(some, draws=0).rmse, learned.score(some, draws=0).rmse
    )
    assert loaded.again.mass == 1.0
    assert loaded.log_evidence == learned.log_evidence


def test_code_of_a_learned_mean_and_kernel_is_asked_for(learned, tmp_path):
    mine = eqx.tree_at(
        lambda of: (of.field.mean, of.mean, of.again.mean),
        learned,
        (jax.tree_util.Partial(fall),) * 3,
        is_leaf=lambda node: node is None,
    )
    save(tmp_path / "f", mine)
    with pytest.raises(ValueError, match=r"fall.*not in the file.*mean=\.\.\."):
        load(tmp_path / "f")
    assert same(load(tmp_path / "f", mean=fall), mine)


def fall(x):
    return jnp.stack([x[1], 0 * x[0]])


@pytest.mark.slow
def test_a_kernel_of_the_user_is_given_to_load_as_it_was_to_learn(learned, tmp_path):
    K = hk.Symplectic(turned(3.0, 0.1))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mine = hk.learn(K, hk.Runs(learned.runs.times, learned.states), iterations=1)
    save(tmp_path / "f", mine)
    assert same(load(tmp_path / "f", kernel=K), mine)  # which has an amplitude more
    with pytest.raises(ValueError, match="not the one saved"):
        load(tmp_path / "f", kernel=hk.Symplectic(cosine))
    other = TurnedBack(jnp.asarray(0.0), jnp.asarray(0.1))
    with pytest.raises(ValueError, match="has the velocity"):
        load(tmp_path / "f", kernel=hk.Symplectic(other))


@pytest.mark.parametrize("solver", [None, hk.Nystrom()], ids=["dense", "low rank"])
def test_a_posterior_is_loaded_with_its_factor(solver, tmp_path):
    K = hk.Symplectic(2.0 * hk.Gaussian(1.3))
    posterior = hk.condition(K, X, Y, 1e-2, solver=solver)
    save(tmp_path / "f", posterior)
    loaded = load(tmp_path / "f")
    assert same(loaded, posterior)
    np.testing.assert_array_equal(loaded.covariance(X[0]), posterior.covariance(X[0]))
    more = loaded.updated(X[:2] + 1, Y[:2])
    np.testing.assert_allclose(more.field(X[0]), posterior.updated(X[:2] + 1, Y[:2]).field(X[0]))


def test_the_result_of_tune_is_loaded_whole(tmp_path):
    tuned = hk.tune(hk.Symplectic(hk.Gaussian()), X, Y, starts=1, max_steps=1)
    save(tmp_path / "f", tuned)
    loaded = load(tmp_path / "f")
    assert same(loaded, tuned)
    assert loaded.bounds == tuned.bounds
