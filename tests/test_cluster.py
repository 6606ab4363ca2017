"""Fits to parts of the data add up, are kept in files, and run on engines of others."""

import copy
import operator
import os
import pickle
import socket
import subprocess
import sys
from functools import reduce
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from data import swings

import hamkernel as hk

K = hk.Symplectic(hk.Gaussian(1.5))
# In the order of q, so that no part looks like another one. The shapes are few.
X, Y = (each[np.argsort(swings(600)[0][:, 0])] for each in swings(600))
NEW = swings(50, seed=9)[0]
WAVES = hk.RandomFeatures(40, jax.random.key(0))
# Landmarks so dense that their Gram has the condition 1e12, and coefficients of 1e5 and more.
DENSE = hk.Nystrom(1e12, points=X[::20])


def parts_of(start, size=100):
    return [start.add(X[i : i + size], Y[i : i + size]) for i in range(0, len(X), size)]


def one_pass(start, size=100):
    for i in range(0, len(X), size):
        start = start.add(X[i : i + size], Y[i : i + size])
    return start


def merged(parts) -> Any:
    return sum(parts)


def values(model):
    return np.asarray(model.field().evaluate(NEW))


def relative(a, b):
    return np.linalg.norm(np.asarray(a) - np.asarray(b)) / np.linalg.norm(b)


def same_bits(a, b):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.asarray(x).tobytes() == np.asarray(y).tobytes() for x, y in pairs)


# Sums that add.


@pytest.mark.parametrize(
    ("solver", "regularization"),
    [
        pytest.param(DENSE, 1e-4, id="landmarks", marks=pytest.mark.slow),
        pytest.param(DENSE, 1e-13, id="hard landmarks"),
        pytest.param(WAVES, 1e-13, id="hard features", marks=pytest.mark.slow),
    ],
)
def test_parts_add_up_to_one_pass_bit_for_bit_in_any_order(solver, regularization):
    start = solver.start(K, X, regularization)
    a, b, c, d, e, f = parts_of(start)
    whole = values(one_pass(start))
    for total in (
        merged([a, b, c, d, e, f]),
        reduce(operator.add, [f, e, d, c, b, a]),
        (d + a) + ((f + start) + (b + (c + e))),  # `start` is an empty part
    ):
        assert int(total.count) == 600
        np.testing.assert_array_equal(values(total), whole)
    # The control: a part twice, or left out, is far away.
    assert relative(values(a + b + c + d + e), whole) > 1e-4
    assert relative(values(a + b + c + d + e + f + f), whole) > 1e-4


def test_what_rounding_takes_from_the_sums_is_what_keeps_the_order_from_showing():
    start = DENSE.start(K, X, 1e-13)
    parts = parts_of(start)
    seen = [part.sums.normal_equations.square for part in parts]
    plain = [relative(reduce(jnp.add, seen[::step]), reduce(jnp.add, seen)) for step in (1, -1)]
    assert plain[0] == 0 < plain[1] < 1e-15  # 5e-11 in the field
    ours = merged(parts)
    exact: Any = sum(np.asarray(each, np.longdouble) for each in seen)
    got = np.asarray(ours.sums.normal_equations.square, np.longdouble) + np.asarray(
        ours.compensation[0].square
    )
    assert float(abs(got - exact).max() / abs(exact).max()) < 1e-18
    assert float(abs(ours.compensation[0].square).max()) > 0


@pytest.mark.slow
def test_merged_features_are_those_of_a_qr_in_numpy():
    """At λ = 1e-13 in chunks in the order of q, where the normal equations lose four digits."""
    design: Any = hk.fit(K, X[:1], Y[:1], 1e-4, solver=WAVES).features
    rows = np.asarray(design(jnp.asarray(X))).reshape(X.size, -1)
    ridge = np.sqrt(len(X) * 1e-13) * np.eye(rows.shape[1])
    both = np.concatenate([rows, ridge]), np.append(Y, np.zeros(len(ridge)))
    weights = np.linalg.lstsq(*both, rcond=None)[0]
    expected = np.asarray(design(jnp.asarray(NEW))) @ weights
    assert relative(values(merged(parts_of(WAVES.start(K, X, 1e-13)))), expected) < 1e-12


def test_parts_of_other_observations_add_up():
    start = DENSE.start(K, X, 1e-4)
    rest = hk.Equilibria(np.zeros(2)) + hk.Velocities(X[:50], Y[:50], noise=2.0)
    apart = start.add(X[100:200], Y[100:200]) + start.add(rest)
    together = start.add(rest).add(X[100:200], Y[100:200])
    np.testing.assert_array_equal(values(apart), values(together))
    np.testing.assert_array_equal(apart.trace, together.trace)


@pytest.mark.slow
def test_fits_that_differ_do_not_add_and_the_error_says_in_what():
    start, four = DENSE.start(K, X, 1e-4), hk.Nystrom(1e12, points=np.tile(X[::20], 2))
    for name, other in {
        "kernels": DENSE.start(hk.Symplectic(hk.Gaussian(1.4)), X, 1e-4),
        "regularizations": DENSE.start(K, X, 1e-3),
        "landmarks": hk.Nystrom(1e12, points=X[1::20]).start(K, X, 1e-4),
        "samples, or functions in their kernels": DENSE.start(K, X[::-1] * 0.9, 1e-4),
        "numbers of coordinates": four.start(K, np.tile(X, 2), 1e-4),
    }.items():
        with pytest.raises(ValueError, match=f"have different {name}, and do not add. Start once"):
            start + other
    with pytest.raises(TypeError, match="a LandmarkFit in float64 and a FeatureFit in float64 do"):
        start + WAVES.start(K, X, 1e-4)
    with pytest.warns(UserWarning, match="float32"):
        low = DENSE.start(K, X.astype(np.float32), 1e-4)
    with pytest.raises(TypeError, match="LandmarkFit in float64 and a LandmarkFit in float32"):
        start + low
    for wrong in (3, "x", None, start.sums):
        with pytest.raises(TypeError):
            start + wrong


def warped(fn):
    return hk.Symplectic(hk.Warp(hk.Gaussian(1.5), fn))


@pytest.mark.slow
def test_other_features_or_functions_in_a_kernel_do_not_add():
    with pytest.raises(ValueError, match="different features"):
        WAVES.start(K, X) + hk.RandomFeatures(40, jax.random.key(1)).start(K, X)
    one, two, other = (
        DENSE.start(warped(fn), X, 1e-4)
        for fn in (lambda x: x + 0.1 * x**3, lambda x: 0.1 * x**3 + x, lambda x: x)
    )
    assert same_bits(one + two, one)  # as functions that travelled, which are not the same object
    with pytest.raises(ValueError, match="different samples, or functions in their kernels"):
        one + other


def test_parts_add_under_jit_and_the_check_stays():
    start = DENSE.start(K, X, 1e-4)
    a, b = parts_of(start, 300)
    assert same_bits(jax.jit(operator.add)(a, b), a + b)
    other = eqx.tree_at(lambda f: f.regularization, b, 2 * b.regularization)
    with pytest.raises(Exception, match="different regularizations"):
        jax.jit(operator.add)(a, other)


def test_copies_that_travelled_add_up():
    start = DENSE.start(K, X, 1e-4)
    a, b = parts_of(start, 300)
    for there in (pickle.loads(pickle.dumps(b)), copy.deepcopy(b)):
        assert same_bits(a + there, a + b)


def test_a_process_without_float64_refuses_a_fit_that_has_it():
    sent = pickle.dumps(DENSE.start(K, X, 1e-4))
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(TypeError, match="JAX_ENABLE_X64=1 in the environment of every worker"):
            pickle.loads(sent)
    finally:
        jax.config.update("jax_enable_x64", True)


# Restart.


@pytest.mark.parametrize("solver", [DENSE, WAVES], ids=["landmarks", "features"])
def test_a_fit_is_saved_and_goes_on_to_the_same_bits(solver, tmp_path):
    start = solver.start(K, X, 1e-4)
    hk.save(tmp_path / "empty", start)
    assert same_bits(hk.load(tmp_path / "empty"), start)
    half = start.add(X[:300], Y[:300])
    hk.save(tmp_path / "half", half)
    loaded = hk.load(tmp_path / "half")
    assert type(loaded) is type(half)
    assert repr(loaded) == repr(half)
    rest = loaded.add(X[300:], Y[300:])
    assert same_bits(rest, half.add(X[300:], Y[300:]))
    assert same_bits(start.add(X[300:], Y[300:]) + loaded, rest)


@pytest.mark.slow
def test_functions_of_the_kernel_of_a_saved_fit_are_asked_for(tmp_path):
    def bent(x):
        return x + 0.1 * x**3

    model = DENSE.start(warped(bent), X, 1e-4).add(X[:300], Y[:300])
    hk.save(tmp_path / "f", model)
    with pytest.raises(ValueError, match=r"code that is not in the file.*kernel=\.\.\."):
        hk.load(tmp_path / "f")
    with pytest.raises(ValueError, match="a function in the kernel is not the one"):
        hk.load(tmp_path / "f", kernel=warped(lambda x: x))
    loaded = hk.load(tmp_path / "f", kernel=warped(bent))
    assert same_bits(loaded + model, model + model)


@pytest.mark.slow
def test_rows_as_landmarks_and_inputs_are_saved(tmp_path):
    data = hk.Velocities(X[:50], Y[:50], noise=2.0) + hk.Equilibria(np.zeros(2))
    controlled = hk.Controlled(K, inputs=hk.InputMatrix(1.0, acts_on=(1,)))
    models = {
        "rows": hk.Nystrom().start(K, data, 1e-4).add(data),
        "inputs": hk.Nystrom().start(controlled, X[:50], 1e-4, X[:50, :1]),
    }
    for name, model in models.items():
        hk.save(tmp_path / name, model)
        assert same_bits(hk.load(tmp_path / name), model)


def hole(i):
    return X[:50], np.where(np.arange(50)[:, None] == i, np.nan, Y[:50])


def test_a_bad_chunk_leaves_what_was_added_as_it_was():
    model = DENSE.start(K, X, 1e-4).add(X[:300], Y[:300])
    before = copy.deepcopy(model)
    for bad, said in ((hole(7), "row 7"), ((X[:3, :1], Y[:3, :1]), "1 coordinate")):
        with pytest.raises(ValueError, match=said):
            model.add(*bad)
    assert same_bits(model, before)
    assert same_bits(model.add(X[300:], Y[300:]), before.add(X[300:], Y[300:]))


def test_a_generator_that_raises_names_the_chunk():
    def reading(error):
        yield X[:300], Y[:300]
        raise error

    with pytest.raises(ValueError, match="chunk 1, counted from 0: a bad file"):
        DENSE.fit_chunks(K, reading(ValueError("a bad file")), 1e-4, sample=X)
    for error in (OSError("no disk"), KeyboardInterrupt()):
        with pytest.raises(type(error)) as caught:
            DENSE.fit_chunks(K, reading(error), 1e-4, sample=X)
        assert caught.value is error
        assert error.__notes__ == ["in chunk 1, counted from 0"]
    # The next call is as ever, and BLAS has its threads again.
    DENSE.fit_chunks(K, [(X[:300], Y[:300])], 1e-4, sample=X)


RESTARTED = """
import os, sys
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import hamkernel as hk

file, killed_at = sys.argv[1], int(sys.argv[2])
rng = np.random.default_rng(0)
X = rng.uniform(-2, 2, size=(2000, 2))
Y = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.01 * rng.normal(size=X.shape)
K = hk.Symplectic(hk.Gaussian(1.5))
model = hk.load(file) if os.path.exists(file) else hk.Nystrom().start(K, X, 1e-6)
for i in range(int(model.count), 2000, 100):
    if i == 100 * killed_at:
        os.kill(os.getpid(), 9)
    model = model.add(X[i : i + 100], Y[i : i + 100])
    hk.save(file, model)
print(int(model.count), np.asarray(model.field().evaluate(X[:9])).tobytes().hex())
"""


@pytest.mark.slow
def test_a_process_that_is_killed_goes_on_from_its_file_to_the_same_numbers(tmp_path):
    def run(file, killed_at):
        command = [sys.executable, "-c", RESTARTED, str(tmp_path / file), str(killed_at)]
        return subprocess.run(command, capture_output=True, text=True)

    chunk = int.from_bytes(os.urandom(1)) % 19 + 1
    assert run("killed", chunk).returncode == -9
    assert int(hk.load(tmp_path / "killed").count) == 100 * chunk, chunk
    again, whole = run("killed", -1), run("whole", -1)
    assert again.returncode == whole.returncode == 0, again.stderr
    assert again.stdout == whole.stdout
    assert whole.stdout.startswith("2000 ")


# Engines of others: two worker processes of Dask, and a million points in twenty files.

DASK = """
import operator, os, signal, sys
from pathlib import Path

import jax
jax.config.update("jax_enable_x64", True)
import dask.bag
import numpy as np
from dask.distributed import Client, LocalCluster

import hamkernel as hk

folder = Path(sys.argv[1])


def added(model, path, killed_at=None):
    part = np.load(path)
    model = model.add(part["X"], part["Y"])
    jax.block_until_ready(model)
    if path.name == killed_at:  # once: the second time the file is there
        try:
            (path.parent / "killed").touch(exist_ok=False)
        except FileExistsError:
            return model
        os.kill(os.getpid(), signal.SIGKILL)
    return model


def killing(model, path):
    return added(model, path, "07.npz")


if __name__ == "__main__":
    os.environ["JAX_ENABLE_X64"] = "1"
    rng = np.random.default_rng(0)
    for i in range(20):
        X = rng.uniform(-2, 2, size=(50_000, 2))
        Y = np.stack([X[:, 1], -np.sin(X[:, 0])], axis=1) + 0.01 * rng.normal(size=X.shape)
        np.savez(folder / f"{i:02}.npz", X=X, Y=Y)
    paths = sorted(folder.glob("*.npz"))
    sample, K = rng.uniform(-2, 2, size=(2000, 2)), hk.Symplectic(hk.Gaussian(1.5))
    start = hk.Nystrom().start(K, sample, 1e-8)
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with Client(cluster):
            files = dask.bag.from_sequence(paths, npartitions=4)
            parts = [
                files.fold(added, operator.add, initial=start).compute(),
                # Not the first file of its partition: some of it was added, and is lost.
                files.fold(killing, operator.add, initial=start).compute(),
            ]
    whole = start
    for path in paths:
        whole = added(whole, path)
    values = [np.asarray(m.field().evaluate(sample)) for m in (whole, *parts)]
    off = [np.linalg.norm(v - values[0]) / np.linalg.norm(values[0]) for v in values]
    killed = (folder / "killed").exists()
    print([int(m.count) for m in parts], off, killed)
    assert all(int(m.count) == 1_000_000 for m in parts)
    assert max(off) < 1e-12
    assert killed
"""


@pytest.mark.slow
def test_two_workers_of_dask_are_one_pass_and_one_that_dies_is_run_again(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "program.py").write_text(DASK)
    command = [sys.executable, str(tmp_path / "program.py"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]


# The program of the guide.


@pytest.mark.slow
def test_the_program_for_jax_distributed_fits_in_two_processes(tmp_path):
    parts = np.array_split(np.arange(600), 4)
    for i, part in enumerate(parts[:3]):  # one process has more than the other
        np.savez(tmp_path / f"{i}.npz", X=X[part], Y=Y[part])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    program = Path(__file__).parents[1] / "docs" / "distributed.py"
    environment = os.environ | {"JAX_CPU_COLLECTIVES_IMPLEMENTATION": "gloo"}
    environment.pop("XLA_FLAGS", None)
    options = "--coordinator", address, "--processes", "2", "--process"
    processes = [
        subprocess.Popen(
            [sys.executable, program, tmp_path, tmp_path / "field", *options, str(i)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        for i in range(2)
    ]
    try:
        said = [process.communicate(timeout=600) for process in processes]
    finally:
        for process in processes:
            process.kill()
    assert all(process.returncode == 0 for process in processes), said
    assert "process 0: 150 of 300 points of 2 files" in said[0][0]
    assert "process 1: 150 of 150 points of 1 files" in said[1][0]
    assert "300 points: SolverInfo(" in said[0][0]
    used = np.concatenate([parts[0], parts[1]])
    exact = hk.fit(K, X[used], Y[used], 1e-6)
    field = hk.load(tmp_path / "field")
    assert relative(field.evaluate(NEW), exact.evaluate(NEW)) < 1e-5
