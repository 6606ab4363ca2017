"""The picture, the page and the command of a learned field, read back."""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import base64
import html
import re
import warnings
from types import SimpleNamespace

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest

import hamkernel as hk
from hamkernel._command import columns, kernel, run
from hamkernel._learned.result import _coefficients
from hamkernel._report import script


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


@pytest.mark.slow
def test_the_figure_has_the_fit_the_force_and_the_plane(learned):
    panels = learned.plot(run=1).axes
    assert len(panels) == 6
    force = next(ax for ax in panels if ax.get_ylabel() == r"$\dot{p}$")
    (mean,) = [line for line in force.lines if line.get_label() == "mean"]
    q, p = np.asarray(mean.get_xydata()).T
    np.testing.assert_allclose(p, -np.sin(q), atol=0.05)  # of a pendulum
    assert [ax.get_title() for ax in panels][-1] == "all runs"
    with pytest.raises(ValueError, match="there is no run 2"):
        learned.plot(run=2)


def test_a_summary_has_a_line_for_each_finding(learned):
    lines = repr(learned).splitlines()
    assert len(lines) < 10
    assert lines[0].startswith("Learned from 2 runs, 40 samples: ")
    assert ".plot()" in lines[-1]
    assert "usable" in repr(jax.tree.map(lambda leaf: None, learned))
    shown = learned._repr_html_()
    assert "<table>" in shown
    (picture,) = re.findall('src="data:image/png;base64,([^"]*)"', shown)
    assert base64.b64decode(picture).startswith(b"\x89PNG")


def test_friction_and_gain_are_said_in_units_of_the_states():
    """Not as the standard deviations of their priors, which the kernel has."""
    rng = np.random.default_rng(0)
    X, U = rng.normal(size=(60, 2)), rng.normal(size=(60, 1))
    q, p = X.T
    Y = np.stack([p, -q - 0.3 * p - 0.4 * np.tanh(p / 0.1) + 2.5 * U[:, 0]], axis=1)
    friction = hk.Friction(0.6, 0.8, rest_speed=0.1)
    K = hk.Symplectic(hk.Polynomial(2)) + friction
    K = hk.Controlled(K, inputs=hk.InputMatrix(9.0, acts_on=(1,)))
    field = hk.fit(K, X, Y, 1e-8, inputs=U)
    assert _coefficients(field, ("q", "p")) == [
        ("friction", "viscous [0.3], dry [0.4] on coordinate p"),
        ("input matrix", "[2.5] on coordinate p"),
    ]


def test_a_page_has_all_of_it_inside(learned, tmp_path):
    hk.report(learned, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    (picture,) = re.findall('src="data:image/png;base64,([^"]*)"', page)
    assert base64.b64decode(picture).startswith(b"\x89PNG")
    assert "http" not in page  # nothing is fetched
    assert "learned.diagnostics" not in page  # which a reader without Python does not have
    for row in learned.diagnostics:
        assert html.escape(row.name) in page
    with pytest.raises(TypeError, match=r"report takes the result of hk\.learn"):
        hk.report(learned.field, tmp_path / "other.html")


@pytest.mark.slow
def test_the_ten_lines_load_and_simulate(learned, tmp_path, capsys):
    hk.save(tmp_path / "learned.hk", learned)
    text = script(str(tmp_path / "learned.hk"), learned)
    assert len(text.splitlines()) <= 10
    exec(compile(text, "simulate.py", "exec"), {})
    assert "[" in capsys.readouterr().out


def test_the_script_applies_the_inputs_of_the_log(monkeypatch):
    t, own = np.linspace(0, 2, 21), np.linspace(-1, 3, 41)
    states = np.column_stack([np.cos(t), -np.sin(t)])
    for inputs, delay in ((np.sin(t), 0.0), ((own, np.sin(own)), 0.25)):
        runs = hk.Runs([t], [states], [inputs], between="linear", delay=delay)
        stub, seen = SimpleNamespace(runs=runs, states=[states], field=None), {}
        monkeypatch.setattr(hk, "load", lambda file, stub=stub: stub)

        def simulate(field, x0, ts, seen=seen, **options):
            seen.update(options, x0=x0, ts=ts)
            return SimpleNamespace(ys=0.0)

        monkeypatch.setattr(hk, "simulate", simulate)
        text = script("learned.hk", stub)
        assert len(text.splitlines()) <= 10
        exec(compile(text, "simulate.py", "exec"), {})
        assert seen["between"] == "linear"
        np.testing.assert_allclose(seen["inputs"][:, 0], np.sin(seen["ts"] - delay), atol=2e-3)


def test_the_script_loads_the_file_beside_it(learned, tmp_path, monkeypatch):
    """Whatever the folder is from which it is run."""
    text, loaded = script("learned.hk", learned, is_beside=True), []
    assert len(text.splitlines()) <= 11
    monkeypatch.setattr(hk, "load", lambda file: loaded.append(file) or learned)
    monkeypatch.setattr(hk, "simulate", lambda *args, **options: SimpleNamespace(ys=0.0))
    exec(compile(text, "simulate.py", "exec"), {"__file__": str(tmp_path / "simulate.py")})
    assert loaded == [tmp_path / "learned.hk"]


def test_columns_are_read_by_name_and_what_is_wrong_is_named(tmp_path):
    file = tmp_path / "run.csv"
    file.write_text("t, q ,p\n0,1,2\n1,,3\n\n", encoding="utf-8")
    np.testing.assert_array_equal(columns(file, ["q", "t"]), [[1, 0], [np.nan, 1]])
    with pytest.raises(ValueError, match=r"no column 'v'; its columns are t, q, p\."):
        columns(file, ["v"])
    file.write_text("t,q\n0,a\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"line 2: could not convert string to float: 'a'"):
        columns(file, ["t", "q"])
    file.write_text("t,q\n0,1\n1,b\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"line 3: could not convert string to float: 'b'"):
        columns(file, ["q"])
    file.write_text("", encoding="utf-8")
    with pytest.raises(ValueError, match="no column 'q'; it is empty"):
        columns(file, ["q"])
    file.write_text("0,1\n1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match="no column 'q'; the first line must have the names"):
        columns(file, ["q"])
    file.write_text("t,q,q\n0,1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match="has 2 columns named 'q'"):
        columns(file, ["t", "q"])
    file.write_text("<" * 200_000, encoding="utf-8")
    with pytest.raises(ValueError, match="is no CSV file: field larger"):
        columns(file, ["q"])
    with pytest.raises(FileNotFoundError, match="there is no file"):
        columns(str(tmp_path / "nope.csv"), ["q"])
    for rows in ("t,q\n", "t,q\ns,V\n"):
        file.write_text(rows, encoding="utf-8")
        with pytest.raises(ValueError, match="no rows"):
            columns(file, ["q"])


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("Model TDS2024B\nRecord Length,2,,\n\nt,q °\ns,V\n0,1.5\n1e-6,2\n", "utf-8"),
        ("t;q °\n0;1,5\n1e-6;2,0\n", "latin-1"),
        ("t\tq °\n0\t1.5\n1e-6\t2\n", "utf-16"),
    ],
)
def test_columns_of_oscilloscopes_and_spreadsheets_are_read(tmp_path, text, encoding):
    file = tmp_path / "scope.csv"
    file.write_text(text, encoding=encoding)
    np.testing.assert_array_equal(columns(file, ["t", "q °"]), [[0, 1.5], [1e-6, 2]])
    with pytest.raises(ValueError, match=r"no column 'p'; its columns are t, q °"):
        columns(file, ["t", "p"])


def test_the_command_refuses_with_a_sentence(tmp_path, capsys):
    file = tmp_path / "run.csv"
    file.write_text("t,q\n0,1\n1,2\n2,1\n", encoding="utf-8")
    masses = ["--states", "q", "--mass", "1", "2"]
    twice = ["--states", "q", "t"]
    for options in (["--states", "q"], ["--states", "q", "p"], masses, twice):
        with pytest.raises(SystemExit):
            run([str(file), "--time", "t", *options], print)
    said = capsys.readouterr().err
    assert "positions alone with --mass" in said
    assert "no column 'p'" in said
    assert "--mass names 2 masses and --states 1 columns" in said
    assert "the column 't' is named twice" in said
    assert kernel(4, 1, friction=True).inputs.acts_on == (2, 3)


@pytest.mark.parametrize(
    ("options", "momenta", "given"),
    [
        (
            ["--states", "q", "p", "--inputs", "u", "--friction", "--between", "smooth"],
            (1,),
            (None, None),
        ),
        (["--states", "q", "--mass", "2", "--noise", "0.1"], None, (2.0, 0.1)),
        (["--states", "q", "p", "--mass", "1", "2", "--noise", "1", "3"], None, ([1, 2], [1, 3])),
        (["--states", "q", "--inputs", "u", "v", "--mass", "2"], (1,), (2.0, None)),
    ],
)
def test_options_of_the_command_reach_the_kernel_and_learn(
    tmp_path, monkeypatch, options, momenta, given
):
    rng, file, asked = np.random.default_rng(0), tmp_path / "run.csv", []
    rows = np.column_stack([0.1 * np.arange(40), rng.normal(size=(40, 4))])
    np.savetxt(file, rows, delimiter=",", header="t,q,p,u,v", comments="")

    def record(K, runs, **given):
        asked.append((K, runs, given))
        raise ValueError("enough")

    monkeypatch.setattr("hamkernel._command.learn", record)
    with pytest.raises(SystemExit):
        run([str(file), "--time", "t", *options, "--out", str(tmp_path)], lambda text: None)
    ((K, runs, options_of_learn),) = asked
    names = [name for name in options if name in ("q", "p", "u", "v")]
    count = runs.dimension
    assert runs.names == tuple(names[:count])
    assert runs.input_names == (tuple(names[count:]) or None)
    assert runs.between == ("smooth" if "smooth" in options else "held")
    np.testing.assert_array_equal(runs.states[0][:, 0], rows[:, 1])
    if momenta is None:
        assert isinstance(K, hk.Symplectic)
        assert runs.inputs is None
    else:
        assert K.inputs.acts_on == momenta
        np.testing.assert_array_equal(runs.inputs[0][:, 0], rows[:, 3])
        assert isinstance(K.drift, hk.Sum) == ("--friction" in options)
    assert (getattr(K, "drift", K).scalar_kernels[0].kernel.__class__ is hk.Select) == bool(
        given[0]
    )
    for name, value in zip(("mass", "noise"), given, strict=True):
        np.testing.assert_array_equal(options_of_learn[name], value)


def test_the_command_writes_a_page_a_field_and_a_script(learned, tmp_path, monkeypatch):
    file, said = tmp_path / "run.csv", []
    rows = np.column_stack([learned.runs.times[0], learned.runs.states[0]])
    np.savetxt(file, rows, delimiter=",", header="t,q,p", comments="")
    score = hk.Score(
        *(np.ones(2),) * 3, np.array(9.0), np.array(np.nan), (), (), (), np.ones(2), first=1
    )
    stub = eqx.tree_at(lambda of: of.again.iterations, learned, 2)

    def learn(K, runs, **options):
        warnings.warn("do not use it", stacklevel=1)
        return stub

    monkeypatch.setattr("hamkernel._command.learn", learn)
    monkeypatch.setattr(type(learned), "score", lambda self: score)
    options = ["--time", "t", "--states", "q", "p", "--out", str(tmp_path / "out")]
    run([str(file), *options], said.append)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"report.html", "learned.hk", "simulate.py"}
    assert said[-1].startswith("Written:")
    assert "Warning: do not use it" in said

    def too_short(self):
        raise ValueError("no run has ten samples")

    monkeypatch.setattr(type(learned), "score", too_short)
    (tmp_path / "out" / "report.html").unlink()
    run([str(file), *options], said.append)
    assert said[-2:] == ["No score: no run has ten samples", said[-1]]
    assert (tmp_path / "out" / "report.html").exists()
