"""The package as a whole: what an import loads, which file knows which, and what is public."""

import ast
import graphlib
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hamkernel as hk

PACKAGE = Path(hk.__file__).parent

# The rooms in the order of the data: a file imports from its own room and those above it.
ROOMS = [
    {"_require", "_show"},
    {"_sizes"},
    {"_machine"},
    {"_kernels"},
    {"_structures", "poisson"},
    {"_observations"},
    {"_gram"},
    {"_gram_operator"},
    {"_features"},
    {"_fields"},
    {"_solvers"},
    {"_posterior"},
    {"_closed_forms"},
    {"_validation"},
    {"_tuning"},
    {"_runs"},
    {"_learned"},
    {"_trajectories"},
    {"_weak"},
    {"_learn"},
    {"_discovery"},
    {"_symplectic"},
    {"_simulate"},
    {"_save", "systems"},
    {"plot"},
    {"_report"},
    {"_command"},
    {"paper"},
    {"__init__", "__main__"},
]
RANK = {name: rank for rank, room in enumerate(ROOMS) for name in room}


def run(code):
    """What a fresh interpreter prints as JSON."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_the_package_says_that_it_is_typed():
    assert (PACKAGE / "py.typed").exists()  # PEP 561


def test_an_import_is_light_and_leaves_jax_alone_and_what_is_heavy_loads_when_used():
    loaded, before, after, used = run(
        "import json, sys, jax\n"
        "before = {name: str(value) for name, value in jax.config.values.items()}\n"
        "import hamkernel\n"
        "hamkernel.systems, hamkernel.fit\n"
        "after = {name: str(value) for name, value in jax.config.values.items()}\n"
        "loaded = sorted(sys.modules)\n"
        "hamkernel.ImplicitMidpoint, hamkernel.plot\n"
        "print(json.dumps([loaded, before, after, sorted(sys.modules)]))"
    )
    heavy = {"matplotlib", "diffrax", "tqdm", "scipy.integrate", "threadpoolctl", "pytest"}
    assert not heavy & set(loaded)
    assert "hamkernel" in loaded
    assert before == after
    assert "jax_enable_x64" in before
    assert {"diffrax", "matplotlib"} <= set(used)


# The order of imports.


def stem(path):
    """The first name below the package: `_show` for _show.py, `paper` for paper/_experiments.py."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path):
    """The files of this package that `path` names in an import, wherever in the file it is."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            below = [f"{node.module}.{alias.name}" for alias in node.names]
            names = below if node.module == "hamkernel" else [node.module or ""]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("hamkernel.")}
    return found - {"__init__"}


SOURCES = sorted(PACKAGE.rglob("*.py"))


def room(name):
    assert name in RANK, f"{name} is in no room: give it a place in ROOMS"
    return RANK[name]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_file_knows_only_files_before_it(path):
    ahead = {name for name in imports(path) if room(name) > room(stem(path))}
    assert not ahead, f"{path.name} imports {ahead}, which come later"


def test_the_order_would_notice_an_import_backwards(tmp_path):
    wrong = tmp_path / "_gram.py"
    wrong.write_text(
        "def f():\n    from hamkernel import fit, _tuning\n    import hamkernel._solvers.fit\n"
    )
    assert imports(wrong) == {"fit", "_tuning", "_solvers"}
    assert all(room(name) > room("_gram") for name in ("_tuning", "_solvers"))


def test_no_two_files_import_each_other():
    graph = {}
    for path in SOURCES:
        if stem(path) not in ("__init__", "__main__"):
            graph.setdefault(stem(path), set()).update(imports(path) - {stem(path)})
    assert list(graphlib.TopologicalSorter(graph).static_order())  # raises on a cycle


MOST_LINES_OF_A_FUNCTION = 60


def lengths(path):
    """The lines of each function of a file, without the docstring."""
    found = {}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            start = node.body[0].end_lineno if ast.get_docstring(node) else node.body[0].lineno - 1
            head = node.body[0].lineno - node.lineno
            found[node.name] = head + (node.end_lineno or 0) - (start or 0)
    return found


def test_functions_fit_on_a_screen():
    for path in SOURCES:
        for name, length in lengths(path).items():
            assert length <= MOST_LINES_OF_A_FUNCTION, f"{path}: {name} has {length} lines"


FORBIDDEN = ("jax._src", "equinox.internal", "jaxopt", "cola")


def test_no_private_imports_no_prints_and_no_configuration():
    for path in SOURCES:
        text = path.read_text()
        program = stem(path) in ("__main__", "paper")  # may ask for float64, and talks
        for name in FORBIDDEN:
            assert f"import {name}" not in text, path
            assert f"from {name}" not in text, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and not program:
                called = ast.unparse(node.func)
                assert called not in ("print", "jax.config.update", "config.update"), path


# What is public.


def public():
    return [(name, getattr(hk, name)) for name in hk.__all__]


def test_every_public_name_exists_once():
    assert len(set(hk.__all__)) == len(hk.__all__)
    assert all(value is not None for _, value in public())
    with pytest.raises(AttributeError, match="no attribute 'Gausian'"):
        _ = hk.Gausian


@pytest.mark.parametrize("name", hk.__all__)
def test_every_public_name_is_documented(name):
    thing = getattr(hk, name)
    text = thing.__doc__
    assert text
    # A dataclass without a docstring gets its signature for one.
    assert not text.startswith(f"{name}(")
    elsewhere = re.search(r"arguments\s+and\s+errors\s+see\s+`", text)  # "… see `fit`."
    made_by_library = name in ("KernelField", "FeatureField", "SolverInfo", "Tuned")
    made_by_library |= name in ("LandmarkFit", "FeatureFit", "ControlledField", "Posterior")
    if callable(thing) and not elsewhere and not made_by_library:
        for parameter in inspect.signature(thing).parameters:
            assert f"{parameter}:" in text, f"{name} does not document {parameter}"


@pytest.mark.parametrize("name", hk.__all__)
def test_every_public_method_is_documented(name):
    thing = getattr(hk, name)
    if not inspect.isclass(thing):
        return
    for attribute, value in inspect.getmembers(thing):
        if attribute.startswith("_") or not callable(value):
            continue
        if getattr(value, "__module__", "").startswith("hamkernel"):
            assert inspect.getdoc(value), f"{name}.{attribute}"


# The annotations, executed: jaxtyping's import hook has to come before the first import.
ANNOTATED = """
import json, sys
from jaxtyping import TypeCheckError, install_import_hook
with install_import_hook("hamkernel", "beartype.beartype"):
    import hamkernel as hk
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from kernels import CASES
def trace(call):
    # Shapes and dtypes are known while JAX traces: most calls need not be compiled for them.
    jax.eval_shape(lambda: [leaf for leaf in jax.tree.leaves(call()) if hasattr(leaf, "dtype")])

X = np.random.default_rng(0).normal(size=(3, 2))
x, z = jnp.asarray(X[0]), jnp.asarray(X[1])
for case in CASES:
    trace(lambda: hk.Symplectic(case.make(2))(x, z))
k = CASES[0].make(2)
K = hk.Symplectic(k)
def fitted(structure):
    field = hk.fit(structure, X, X, 1e-2)
    return field(x), jax.vmap(field)(X), hk.gram(structure, X, X[:2]), field.is_separable
for structure in (K, hk.Separable(k), hk.CurlFree(k), hk.DivergenceFree(k), hk.Odd(K),
                  hk.Even(K), hk.Sum(a=K, b=hk.Separable(k))):
    trace(lambda: fitted(structure))
fitted(K), hk.fit(K, X, X, 1e-2).anchored(x, 1.0).hamiltonian(x)
X = np.random.default_rng(0).normal(size=(12, 2))
both, key = hk.Sum(a=K, b=hk.CurlFree(k)), jax.random.key(0)
solvers = (hk.Cholesky(), hk.ConjugateGradient(), hk.Nystrom(), hk.RandomFeatures(8, key))
for solver in solvers:
    field = hk.fit(both, X, X, 1e-2, solver=solver)
    trace(lambda: (field.evaluate(X), field.part("b").potential(x)))
    hk.save(sys.argv[2], field), trace(lambda: hk.load(sys.argv[2])(x))
    if hasattr(solver, "start"):
        trace(lambda: solver.start(both, X, 1e-2).add(X, X).field()(x))
        trace(lambda: solver.fit_chunks(both, [(X, X)])(x))
losses = (hk.cross_validation_loss, hk.generalized_cross_validation, hk.log_marginal_likelihood)
for loss in losses:
    trace(lambda: jax.grad(lambda ridge: loss(K, X, X, ridge))(1e-2))
trace(lambda: hk.cross_validation_residuals(K, X, X, 1e-2, [0, 1, 1] * 4))
for other, solver in ((K, None), (1.0 * hk.Gaussian(jnp.ones(2)), solvers[2]), (k, solvers[3])):
    other = other if other is K else hk.Odd(hk.Symplectic(other))
    hk.tune(other, X, X, folds=[0, 1, 2] * 4, starts=2, max_steps=2, solver=solver)
hk.check_kernel(k, X), hk.gram_operator(K, X, X[:2]).mv(X[:2])
data = hk.Velocities(X, X, noise=np.array([1.0, 0.1])) + hk.Energies(X, X[:, 0])
data = data + hk.Equilibria(X[:1]) + hk.Functionals(X[:4, None], np.ones((4, 1, 2)), np.zeros(4))
scaled = hk.Symplectic(2.0 * k)
posterior = hk.condition(scaled, data, regularization=1e-2)
def known(posterior):
    box = np.array([[-1.0, -1.0], [1.0, 1.0]])
    deviations = posterior.deviation(x), posterior.energy_deviation(x, z)
    return deviations, posterior.covariance(x), posterior.sample(key, 2, box)
trace(lambda: known(posterior)), trace(lambda: posterior.updated(X[:2], X[:2]))
for loss in losses:
    trace(lambda: loss(scaled, data, regularization=1e-2))
trace(lambda: hk.fit(hk.PortHamiltonian(k), X, X, 1e-2).dissipation(x))
trace(lambda: hk.fit(K, X, X, 1e-2, mean=hk.systems.Pendulum()).hamiltonian(x))
trace(lambda: hk.fit(hk.Invariant(K, [-np.eye(2)]), X, X, 1e-2)(x))
states, rates = np.ones((4, 3)) + np.eye(4, 3), np.eye(4, 3)
hk.fit(hk.Poisson(k, hk.poisson.rigid_body), states, rates, 1e-2)
hk.Runs([np.arange(8.0)], [X[:8]]).velocities()
pendulum = hk.systems.Pendulum()
trace(lambda: hk.systems.sample(pendulum, X[0], np.linspace(0, 1, 3), 0.1, key=key))
hk.simulate(pendulum, x, np.arange(3), dt=1)  # and is concrete: far from the data?
for options in ({}, {"dt": 0.1, "solver": hk.GaussLegendre4()}):
    trace(lambda: hk.simulate(pendulum, x, np.arange(3), **options))
def refused(call):
    try:
        call()
    except TypeCheckError:
        return True
    return False
print(json.dumps([refused(lambda: k(X, X)), refused(lambda: K(x, jnp.zeros(3)))]))
"""


@pytest.mark.slow
@pytest.mark.ci
def test_annotations_hold_when_they_are_executed(tmp_path, fast_compilation):
    program = [sys.executable, "-c", ANNOTATED, Path(__file__).parent, tmp_path / "field.npz"]
    done = subprocess.run(program, capture_output=True, text=True, env=fast_compilation)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout) == [True, True]  # wrong shapes, the control
