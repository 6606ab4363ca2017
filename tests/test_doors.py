"""What people type: logs of every kind become runs, and known masses need no lambda."""

# pyright: reportArgumentType=false, reportOptionalSubscript=false, reportCallIssue=false

import datetime
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._closed_forms import Partition

T = np.linspace(0, 3, 40)
X = np.stack([np.sin(2 * T), 2 * np.cos(2 * T)], 1)
U = np.cos(3 * T) + 0.3 * np.sin(7 * T)
K = hk.Symplectic(1.0 * hk.Gaussian(1.0))


class Polars:
    """A frame like that of polars: without `ndim`, and iterated by columns."""

    def __init__(self, values, columns):
        self.values, self.columns, self.shape = values, columns, values.shape

    def to_numpy(self):
        return self.values

    def __iter__(self):
        return iter(self.values.T)

    def __getitem__(self, column):
        return self.values[:, self.columns.index(column)]


class Tensor:
    """A tensor like that of PyTorch that requires a gradient."""

    def __init__(self, values, free=False):
        self.values, self.shape, self.free = values, values.shape, free

    def detach(self):
        return Tensor(self.values, free=True)

    def cpu(self):
        return self

    def __array__(self, *args, **options):
        if not self.free:
            raise RuntimeError("Can't call numpy() on Tensor that requires grad.")
        return self.values


def table(values):
    return np.array([*map(tuple, values)], dtype=[("q", float), ("p", float)])


def same(runs, times=T, states=X):
    assert len(runs) == 1
    np.testing.assert_array_equal(runs.times[0], times)
    np.testing.assert_array_equal(runs.states[0], states)
    assert runs.states[0].dtype == float


def masked():
    return np.ma.masked_array(X, mask=np.arange(80).reshape(40, 2) == 7)


def with_nan():
    out = X.copy()
    out[3, 1] = np.nan
    return out


@pytest.mark.parametrize(
    ("times", "states", "kept"),
    [
        (T, X, X),
        (T.tolist(), X.tolist(), X),
        ([T], [X], X),
        (T.astype(">f8"), X.astype(">f8"), X),
        (T, np.ma.masked_array(X, mask=False), X),
        (T, masked(), with_nan()),
        (T, X.astype(object), X),
        (iter([T]), iter([X]), X),
        (T, X[:, 0], X[:, :1]),
        (T.tolist(), X[:, 0].tolist(), X[:, :1]),
    ],
)
def test_logs_of_every_kind_are_runs(times, states, kept):
    same(hk.Runs(times, states), states=kept)


def test_missing_entries_of_pandas_are_nan():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(X, columns=["q", "p"]).astype("Float64")
    frame.loc[3, "p"] = pandas.NA
    same(hk.Runs(pandas.Series(T), frame), states=with_nan())


@pytest.mark.parametrize("interval", [0.02, np.float64(0.02), jnp.asarray(0.02)])
def test_a_sampling_interval_stands_for_times(interval):
    expected = float(interval) * np.arange(40)
    same(hk.Runs(interval, X), expected)
    two = hk.Runs(interval, [X, X[:20]])
    np.testing.assert_array_equal(two.times[1], expected[:20])
    with pytest.raises(ValueError, match=r"sampling interval must be positive and finite; got -1"):
        hk.Runs(-1.0, X)


def test_rows_as_lists_are_rows():
    """Not 40 runs of two samples, where the sampling interval says nothing of their number."""
    for rows in (X.tolist(), [*X]):
        same(hk.Runs(0.1, rows), 0.1 * np.arange(40))
    assert len(hk.Runs(0.1, [X[:, 0], X[:30, 1]])) == 2


def test_times_of_all_runs_are_given_once():
    both, u = np.stack([X, 2 * X]), np.stack([U, U])
    for times in (T, T.tolist()):
        runs = hk.Runs(times, both, u)
        assert [len(runs), runs.input_count] == [2, 1]
        np.testing.assert_array_equal(runs.times[1], T)
        np.testing.assert_array_equal(runs.states[1], 2 * X)


@pytest.mark.parametrize(
    "states", [table(X), Polars(X, ["q", "p"]), [table(X)], [Polars(X, ["q", "p"])]]
)
def test_names_of_columns_are_kept(states):
    times = [T] if isinstance(states, list) else T
    runs = hk.Runs(times, states, [U] if isinstance(states, list) else U)
    assert runs.names == ("q", "p")
    assert repr(runs) == "Runs(1 run, 40 samples, n=2 (q, p), m=1 held)"
    assert runs.part([slice(0, 9)]).names == ("q", "p")
    assert hk.Runs(T, X).names is None


def test_names_of_pandas_and_xarray_are_kept_and_used():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t": T, "angle": X[:, 0], "speed": X[:, 1], "volts": U})
    runs = hk.Runs(frame["t"], frame[["angle", "speed"]], frame["volts"])
    assert repr(runs) == "Runs(1 run, 40 samples, n=2 (angle, speed), m=1 (volts) held)"
    assert [panel.get_ylabel() for panel in hk.plot.smoothing(runs)] == ["angle", "speed"]
    plt.close("all")
    frame["speed"] = 3.0
    with pytest.warns(UserWarning, match=r"constant in all runs: coordinate speed \(always 3\)"):
        hk.Runs(frame["t"], frame[["angle", "speed"]])
    columns = [frame[["angle", "volts"]], frame[["volts", "angle"]]]
    with pytest.raises(ValueError, match=r"are angle, volts and those of states\[1\] volts, angle"):
        hk.Runs([T, T], columns)
    assert hk.Runs(frame["t"], frame["angle"]).with_momenta().names == ("angle", "p of angle")
    xarray = pytest.importorskip("xarray")
    array = xarray.DataArray(X, dims=("time", "c"), coords={"time": T, "c": ["q", "p"]})
    assert hk.Runs(array.time, array).names == ("q", "p")
    log = xarray.Dataset({"q": ("t", X[:, 0]), "p": ("t", X[:, 1])}, {"t": T})
    assert hk.Runs(log.t, log).names == ("q", "p")


def test_a_mapping_of_columns_is_a_table_with_names():
    columns = {"q": X[:, 0], "p": list(X[:, 1])}
    runs = hk.Runs([T, T], [columns, columns], [{"u": U}, {"u": U}])
    assert repr(runs) == "Runs(2 runs, 80 samples, n=2 (q, p), m=1 (u) held)"
    np.testing.assert_array_equal(runs.states[1], X)
    assert hk.Runs(T, columns, {"u": U}).names == ("q", "p")
    with pytest.raises(ValueError, match=r"of one length.*; got q \(40,\), p \(3,\)"):
        hk.Runs(T, {"q": X[:, 0], "p": X[:3, 1]})


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda hk: hk.learn(K, T, X), r"got Symplectic and ndarray\. For states with velocities"),
        (lambda hk: hk.learn(hk.Runs(T, X), K), "after the kernel, .*; got Runs and Symplectic"),
        (lambda hk: hk.learn(K, hk.Runs(T, X), X), "mean is a ndarray; a callable"),
        (lambda hk: hk.fit(K, hk.Runs(T, X)), r"hk\.learn\(K, runs\) needs no velocities"),
        (lambda hk: hk.compare(hk.Runs(T, X)), r"hk\.learn\(K, runs\) needs no velocities"),
        (lambda hk: hk.save(K, "field.hk"), r"hk\.save\(path, field\)"),
        (lambda hk: hk.report("page.html", K), "a str and a Symplectic"),
        (lambda hk: hk.plot.comparison(K), r"result of hk\.compare"),
        (
            lambda hk: hk.plot.phase_portrait(SimpleNamespace(field=K), (-1, 1), (-1, 1)),
            r"got a SimpleNamespace\. Pass its \.field",
        ),
    ],
)
def test_arguments_in_another_order_are_told_the_right_one(call, said):
    with pytest.raises(TypeError, match=said):
        call(hk)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((None, X), "times must be a list with one array a run"),
        (([None], [X]), r"times\[0\] must hold real numbers; got None"),
        ((T, None), "states"),
        ((T, X * 1j), r"states\[0\] has dtype complex128; real numbers are needed"),
        ((T, [["a", "b"]] * 40), r"states\[0\]"),
    ],
)
def test_what_is_no_log_is_refused_in_a_sentence(arguments, said):
    with pytest.raises(TypeError, match=said):
        hk.Runs(*arguments)


@pytest.mark.parametrize("kind", ["polars", "pandas"])
def test_columns_of_text_are_named(kind):
    frame = Polars(np.array([[0.5, "a"]] * 40, dtype=object), ["q", "tag"])
    if kind == "pandas":
        frame = pytest.importorskip("pandas").DataFrame({"q": T, "tag": ["a"] * 40})
    with pytest.raises(TypeError, match=r"states\[0\] has columns that hold no numbers: tag\. Ch"):
        hk.Runs(T, frame)


def test_a_flat_list_of_rows_is_refused_with_the_line_that_makes_rows():
    with pytest.raises(ValueError, match=r"Rows of one flat list: np.reshape\(values, \(40, 2\)\)"):
        hk.Runs(T, X.ravel().tolist())


@pytest.mark.parametrize(
    "inputs", [U, U[:, None], U.tolist(), (T, U), [T, U], ([*T], [*U]), (T, U[:, None])]
)
def test_one_input_of_runs_is_one_column(inputs):
    runs = hk.Runs(T, X, inputs)
    np.testing.assert_array_equal(runs.inputs[0], U[:, None])
    np.testing.assert_array_equal(runs.input_times[0], T)


KINDS = {
    "list": lambda x: x.tolist(),
    "iterator": lambda x: iter(x.tolist()),
    "big-endian": lambda x: x.astype(">f8"),
    "objects": lambda x: x.astype(object),
    "masked": lambda x: np.ma.masked_array(x, mask=False),
    "structured": table,
    "polars": lambda x: Polars(x, ["q", "p"]),
    "tensor": Tensor,
}


@pytest.mark.parametrize("kind", KINDS)
def test_arrays_of_every_kind_are_data(kind):
    make = KINDS[kind]
    data = hk.Velocities(make(X), make(2 * X), inputs=make(3 * X))
    np.testing.assert_array_equal(data.X, X)
    np.testing.assert_array_equal(data.Y, 2 * X)
    np.testing.assert_array_equal(data.inputs, 3 * X)
    with jax.enable_x64(False):
        assert hk.Velocities(make(X), make(X)).X.dtype == jnp.float32


def test_missing_entries_are_components_that_were_not_measured():
    np.testing.assert_array_equal(hk.Velocities(X, masked()).Y, with_nan())
    holes = with_nan().tolist()
    holes[3][1] = None
    np.testing.assert_array_equal(hk.Velocities(X, holes).Y, with_nan())


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (np.datetime64("2026-01-01") + np.arange(40), r"np\.timedelta64\(1, 's'\)"),
        (np.arange(40) * np.timedelta64(50, "ms"), "holds dates or durations"),
        ([datetime.datetime(2026, 1, day) for day in range(1, 31)], "holds dates or durations"),
        (T.astype(str), r"Text becomes numbers by \.astype\(float\)"),
    ],
)
def test_dates_and_text_are_no_numbers(times, said):
    with pytest.raises(TypeError, match=said):
        hk.Runs(times, X[: len(times)])


LABELS = np.repeat([0, 1, 2, 3], 10)


@pytest.mark.parametrize(
    "folds",
    [
        LABELS.astype(float) / 2,
        [f"run {i}" for i in LABELS],
        LABELS.astype(str),
        LABELS.astype(object),
        [("monday", i) for i in LABELS],
        np.datetime64("2026-01-01") + LABELS,
        iter(LABELS.tolist()),
        Polars(LABELS, None),
    ],
)
def test_labels_of_folds_are_labels_of_any_kind(folds):
    partition = Partition(40, folds)
    np.testing.assert_array_equal(partition.labels, LABELS)
    assert partition.of_labels


@pytest.mark.parametrize(
    ("folds", "said"),
    [
        ([*LABELS[:-1], None], r"no label for point 39 \(None\)"),
        (np.where(LABELS == 2, np.nan, LABELS), r"no label for point 20 \(nan\)"),
        (LABELS[:, None], r"folds has shape \(40, 1\)"),
        (["a", "b"], r"folds has shape \(2,\)"),
        (2.5, r"got 2\.5"),
        (np.array(2.5), r"got array\(2\.5\)"),
        ("run", "'loo' or labels; got 'run'"),
    ],
)
def test_folds_without_a_label_for_each_point_are_refused(folds, said):
    with pytest.raises(ValueError, match=said):
        Partition(40, folds)


@pytest.fixture(scope="module")
def controlled():
    K = hk.Sum(energy=hk.Symplectic(hk.Gaussian(1.0)), friction=hk.Friction(0.3, 0.1))
    K = hk.Controlled(K, inputs=[[0.0], [1.0]])
    return hk.fit(K, X, np.gradient(X, T, axis=0), 1e-3, inputs=U)


@pytest.mark.slow
def test_one_input_is_one_column_everywhere(controlled):
    np.testing.assert_array_equal(hk.Velocities(X, X, inputs=U).inputs, U[:, None])
    np.testing.assert_array_equal(hk.Velocities(X, X, parameters=U).inputs, U[:, None])
    x, u = X[0], U[:1]
    np.testing.assert_array_equal(controlled(x, U[0]), controlled(x, u))
    np.testing.assert_array_equal(controlled.evaluate(X, U), controlled.evaluate(X, U[:, None]))
    driven = hk.systems.Driven(hk.systems.Pendulum(1.0), [[0.0], [1.0]])
    column, one = (hk.simulate(driven, x, T, inputs=u).ys for u in (U[:, None], U))
    np.testing.assert_array_equal(one, column)
    vector, number = (
        hk.simulate(driven, x, T, inputs=u).ys for u in (lambda t: jnp.sin(t)[None], jnp.sin)
    )
    np.testing.assert_array_equal(number, vector)


def test_numbers_of_other_libraries_are_numbers():
    assert hk.Runs(T, X, U, delay=np.array(0.1)).delay == 0.1
    assert isinstance(hk.Runs(T, X, U, delay=jnp.asarray(0.5)).delay, float)
    for delay in (True, None, [0.1, 0.2], "late"):
        with pytest.raises(TypeError, match="delay must be a number"):
            hk.Runs(T, X, U, delay=delay)
    runs = hk.Runs([T, T], [X, X], parameters=[0.5, 0.8])
    np.testing.assert_array_equal(np.concatenate(runs.parameters), [0.5, 0.8])


def test_a_log_keeps_its_digits_whatever_jax_is_told():
    """In float32, 1e5 + t has steps of .0469 and .0547 for .05."""
    code = (
        "import numpy as np, hamkernel as hk, jax\n"
        "t = 1e5 + 0.05 * np.arange(60)\n"
        "x = np.stack([np.sin(t), np.cos(t)], 1)\n"
        "runs = hk.Runs(t, x)\n"
        "print(np.ptp(np.diff(runs.times[0])) < 1e-9, runs.times[0].dtype)\n"
        "X, Y, _ = hk.Runs(0.05 * np.arange(60), np.stack([np.sin(t - 1e5), np.cos(t - 1e5)], 1))"
        ".velocities()\n"
        "print(float(abs(Y - np.stack([X[:, 1], -X[:, 0]], 1)).max()) < 2e-3, X.dtype)\n"
        "try:\n"
        "    hk.Runs(np.float32(1.7e9) + np.arange(9, dtype=np.float32), x[:9])\n"
        "except ValueError as error:\n"
        "    print('float32, which tells times near 1.7e+09 apart by 128' in str(error))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "float64", "True", "float32", "True"], done.stdout


@pytest.mark.parametrize("mass", [2.0, [2.0, 3.0], [[2.0, 0.5], [0.5, 3.0]]])
def test_kinetic_energy_is_that_of_numpy(mass):
    mean, x = hk.kinetic(mass), np.array([0.3, -0.4, 1.5, 0.7])
    M = np.broadcast_to(mass, (2, 2)) if np.ndim(mass) == 2 else np.diag(np.broadcast_to(mass, 2))
    v = np.linalg.solve(M, x[2:])
    np.testing.assert_allclose(mean(x), [*v, 0, 0])
    np.testing.assert_allclose(mean.hamiltonian(x), x[2:] @ v / 2)
    assert "mass=" in repr(mean)


@pytest.mark.parametrize(
    ("mass", "said"),
    [
        (-1.0, "mass must be positive"),
        ([[1.0, 2.0], [2.0, 1.0]], "symmetric positive definite"),
        ([[1.0, 0.5], [0.0, 1.0]], "symmetric positive definite"),
        (np.ones((2, 3)), r"\(\), \(m,\) or \(m, m\)"),
    ],
)
def test_what_is_no_mass_is_refused(mass, said):
    with pytest.raises(ValueError, match=said):
        hk.kinetic(mass)


def test_a_state_of_other_masses_is_refused():
    with pytest.raises(ValueError, match=r"shape \(4,\), with a mass for each q"):
        hk.kinetic([1.0, 2.0])(np.ones(2))


def test_positions_and_a_mass_are_enough(learned, tmp_path):
    """A pendulum, H = p²/2 − cos q: the field of (q, p), saved and loaded without a mean."""
    assert learned.runs.states[0].shape == (20, 2)
    assert np.isnan(learned.runs.states[0][:, 1]).all()
    x, H = jnp.array([0.7, 0.4]), learned.field.hamiltonian
    np.testing.assert_allclose(learned.field(x), [0.4, -np.sin(0.7)], rtol=0.05)
    np.testing.assert_allclose(H(x) - H(x * 0), 0.4**2 / 2 + 1 - np.cos(0.7), rtol=0.05)
    assert learned.field.is_separable
    hk.save(tmp_path / "field", learned.field)
    np.testing.assert_array_equal(hk.load(tmp_path / "field")(x), learned.field(x))
    K = learned.kernel
    with pytest.raises(TypeError, match="give one of mass and mean"):
        hk.learn(K, learned.runs, mean=hk.kinetic(1.0), mass=1.0)
    with pytest.raises(ValueError, match=r"positions alone, hk\.learn\(K, runs, mass=m\)"):
        hk.learn(K, hk.Runs(T, X[:, 0]))


def test_the_line_of_the_readme_reads_a_csv_with_a_header(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    log = np.column_stack([T, X, U])
    np.savetxt("run1.csv", log, delimiter=",", header="t,q,p,u", comments="")
    text = (Path(__file__).parents[1] / "README.md").read_text()
    (line,) = re.findall(r"`(table = np\.loadtxt\(.*?\))`", text)
    (runs,) = re.findall(r"`(hk\.Runs\(table.*?\))`", text)
    names = {"np": np, "hk": hk}
    exec(line, names)
    same(eval(runs, names))


def test_a_run_at_rest_among_others_is_no_fast_logger():
    swing = np.stack([np.sin(2 * T), 2 * np.cos(2 * T)], 1)
    noisy = swing + 0.01 * np.random.default_rng(0).standard_normal(swing.shape)
    rest = np.tile([0.3, 0.0], (60, 1))
    runs = hk.Runs([T, 0.1 * np.arange(60)], [noisy, rest])  # a warning is an error here
    assert runs.check().failing == ()
    stays = np.concatenate([noisy, np.tile(noisy[-1], (40, 1))])
    assert hk.Runs(0.1, [stays, stays]).check()["repeated samples"].passes
    with pytest.warns(UserWarning, match=r"repeated samples: coordinate 0 \(75%\), 1 \(75%\)"):
        hk.Runs([0.1 * np.arange(160), 0.1 * np.arange(60)], [np.repeat(noisy, 4, axis=0), rest])


def test_the_table_of_a_log_says_what_was_found_and_what_to_do():
    x = X.copy()
    x[20] = -9999
    with pytest.warns(UserWarning, match="the first of them sample 20 of run 0.*Write NaN"):
        runs = hk.Runs(T, x, U)
    found = runs.check()
    assert found.failing == ("impossible samples",)
    row = found["impossible samples"]
    assert row.value == "1, the first of them sample 20 of run 0"
    assert "Write NaN there" in row.advice
    names = "impossible samples, outages, wrapped angles, gaps, constant, clipped sensors, "
    names += "dead sensors, repeated samples, interpolated samples, constant inputs, "
    names += "dependent inputs, feedback"
    assert [each.name for each in found] == names.split(", ")
    assert "! impossible samples" in repr(found)


@pytest.mark.slow
def test_what_is_printed_degrades_on_a_terminal_of_ascii():
    code = (
        "from hamkernel._runs.table import Diagnostic, Diagnostics\n"
        "row = Diagnostic('chi', 'χ² is 2', '≤ 1', False, 'λ ≤ χ … ∂ q̇', 'Ж')\n"
        "print(Diagnostics((row,)))"
    )
    for encoding, said in (
        ("ascii", "lambda <= chi ... d q'"),
        ("cp1252", "lambda"),
        ("utf-8", "λ ≤ χ …"),
    ):
        run = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            env={**os.environ, "PYTHONIOENCODING": encoding},
        )
        assert run.returncode == 0, run.stderr
        assert said in run.stdout.decode(encoding)


def test_a_part_of_a_controlled_field_is_that_of_its_drift(controlled):
    field = controlled
    x = jnp.array([0.2, 0.5])
    parts = [field.part("energy")(x), field.part("friction")(x)]
    np.testing.assert_allclose(sum(parts), field(x, jnp.zeros(1)), atol=1e-10)
    assert abs(parts[1][1]) > 1e-6
    with pytest.raises(KeyError, match=r"no part 'rest'.*'energy', 'friction'"):
        field.part("rest")


@pytest.mark.parametrize("leaf", [None, True])
def test_trees_without_arrays_have_a_text(leaf):
    K = hk.Symplectic(2.0 * hk.Gaussian(1.0))
    posterior = hk.condition(K, X, np.gradient(X, T, axis=0), 1e-3)
    for tree, name in ((hk.Runs(T, X), "Runs("), (hk.Runs(T, X, U), "Runs("), (posterior, "Post")):
        assert repr(jax.tree.map(lambda _: leaf, tree)).startswith(name)
