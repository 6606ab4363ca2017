"""The paper's experiments: the program's output on 20 noise seeds, and its parts on their own."""

import copy
import json
import os
import pathlib
import subprocess
import sys
from types import SimpleNamespace
from typing import cast

import jax
import matplotlib.image
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel import paper

SEEDS = 20  # which one batch of the program holds: 21 cost twice as much
SPREAD = {"median", "p10", "p90"}
QUANTITIES = {
    "trajectory_error_mean",
    "trajectory_error_max",
    "odd_error_mean",
    "odd_error_variance",
    "true_hamiltonian_mean",
    "true_hamiltonian_variance",
}
LEARNED = {"learned_hamiltonian_mean", "learned_hamiltonian_variance"}
CHOSEN = {"lengthscale", "regularization", "loss", "seconds", "trajectory_error"}


def program(out: pathlib.Path, *arguments: str) -> tuple[str, pathlib.Path]:
    """What the program prints and the folder it fills; strict promotion, warnings as errors."""
    strict = {"JAX_NUMPY_DTYPE_PROMOTION": "strict", "JAX_NUMPY_RANK_PROMOTION": "raise"}
    command = [sys.executable, "-W", "error", "-m", "hamkernel", "--out", str(out), *arguments]
    done = subprocess.run(command, env=os.environ | strict, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout, out


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[str, pathlib.Path]:
    out = tmp_path_factory.mktemp("paper") / "results"
    return program(out, "--no-tune", "--seeds", str(SEEDS))


@pytest.fixture(scope="module")
def tuned_run(tmp_path_factory) -> tuple[str, pathlib.Path]:
    """As the README says, but for the number of seeds: of 25 it tunes the first 20."""
    return program(tmp_path_factory.mktemp("tuned") / "results", "--seeds", "25")


@pytest.fixture(scope="module")
def results(run) -> dict:
    return json.loads((run[1] / "results.json").read_text())


@pytest.fixture(scope="module")
def tuned_results(tuned_run) -> dict:
    return json.loads((tuned_run[1] / "results.json").read_text())


def median(results, experiment, reading, model, quantity):
    return results[experiment][reading][model][quantity]["median"]


def check_layout(results, readings):
    assert set(results) == {"harmonic_oscillator", "pendulum_m0.5", "pendulum_m1"}
    for experiment in results.values():
        assert set(experiment) == readings
        for reading, models in experiment.items():
            assert set(models) == {"separable", "symplectic", "odd_symplectic"}
            for model, quantities in models.items():
                expected = QUANTITIES | (set() if model == "separable" else LEARNED)
                assert set(quantities) == expected | (CHOSEN if reading == "tuned" else set())
                spreads = [quantities[name] for name in expected]
                if reading == "tuned":
                    for name in CHOSEN:
                        assert set(quantities[name]) == {"grid", "gradient"}
                        spreads += quantities[name].values()
                for spread in spreads:
                    assert set(spread) == SPREAD
                    assert spread["p10"] <= spread["median"] <= spread["p90"]


@pytest.mark.slow
@pytest.mark.ci
def test_results_have_every_experiment_reading_model_quantity_and_spread(results):
    check_layout(results, {"lambda", "N*lambda"})


@pytest.mark.slow
def test_results_have_the_tuned_hyperparameters_too(tuned_results, tmp_path):
    check_layout(tuned_results, {"lambda", "N*lambda", "tuned"})
    # The rest is that of the run without tuning, to the tolerance of the integrator.
    _, out = program(tmp_path / "results", "--no-tune", "--seeds", "25")
    for name, readings in json.loads((out / "results.json").read_text()).items():
        for reading, models in readings.items():
            error = models["odd_symplectic"]["trajectory_error_mean"]
            again = tuned_results[name][reading]["odd_symplectic"]["trajectory_error_mean"]
            assert again == pytest.approx(error, rel=1e-6)


@pytest.mark.slow
@pytest.mark.ci
def test_oscillator_with_lambda_has_the_published_learned_hamiltonian(results):
    # Published: −108.54, of one seed; the spread over seeds is about ±3.
    value = median(
        results, "harmonic_oscillator", "lambda", "odd_symplectic", "learned_hamiltonian_mean"
    )
    assert abs(value + 108) < 10


@pytest.mark.slow
@pytest.mark.ci
def test_oscillator_with_n_lambda_as_the_text_says_has_another_one(results):
    value = median(
        results, "harmonic_oscillator", "N*lambda", "odd_symplectic", "learned_hamiltonian_mean"
    )
    assert abs(value + 108) > 10
    assert abs(value + 78) < 5


@pytest.mark.slow
@pytest.mark.ci
def test_odd_symplectic_beats_separable_on_the_oscillator_only_with_lambda(results):
    error = {
        (reading, model): median(
            results, "harmonic_oscillator", reading, model, "trajectory_error_mean"
        )
        for reading in ("lambda", "N*lambda")
        for model in ("separable", "odd_symplectic")
    }
    assert error["lambda", "odd_symplectic"] < error["lambda", "separable"]
    assert error["N*lambda", "odd_symplectic"] > error["N*lambda", "separable"]


@pytest.mark.slow
@pytest.mark.ci
def test_pendulum_of_mass_one_with_lambda_has_the_published_numbers(results):
    # Published: −16.85, 9.81, 7.87 and 1.49.
    at = ("pendulum_m1", "lambda")
    assert abs(median(results, *at, "odd_symplectic", "learned_hamiltonian_mean") + 17) < 1.5
    assert abs(median(results, *at, "odd_symplectic", "true_hamiltonian_mean") - 9.81) < 0.01
    assert abs(median(results, *at, "separable", "odd_error_mean") - 7.87) < 0.4
    assert abs(median(results, *at, "separable", "odd_error_variance") - 1.49) < 0.4


@pytest.mark.slow
@pytest.mark.ci
def test_pendulum_of_mass_one_half_does_not_have_the_published_hamiltonians(results):
    at = ("pendulum_m0.5", "lambda", "odd_symplectic")
    assert abs(median(results, *at, "learned_hamiltonian_mean") + 17) > 1.5
    assert abs(median(results, *at, "true_hamiltonian_mean") - 4.905) < 0.01


@pytest.mark.slow
@pytest.mark.ci
def test_separable_is_thirty_times_worse_on_the_pendulum_of_mass_one(results):
    error = {
        model: median(results, "pendulum_m1", "lambda", model, "trajectory_error_mean")
        for model in ("separable", "odd_symplectic")
    }
    assert error["separable"] > 30 * error["odd_symplectic"]


@pytest.mark.slow
@pytest.mark.ci
def test_only_the_odd_kernel_is_odd_and_symplectic_fields_keep_their_hamiltonian(results):
    for readings in results.values():
        for models in readings.values():
            assert models["odd_symplectic"]["odd_error_mean"]["p90"] < 1e-10  # rounding
            assert models["symplectic"]["odd_error_mean"]["p10"] > 0.1
            assert models["separable"]["odd_error_mean"]["p10"] > 0.1
            for model in ("symplectic", "odd_symplectic"):
                # The integrator's tolerance is 1e-10 and H is of order 100.
                assert models[model]["learned_hamiltonian_variance"]["p90"] < 1e-12


@pytest.mark.slow
def test_gradient_is_at_least_as_good_as_the_grid_in_the_median(tuned_results):
    low = np.geomspace(0.3, 30.0, 30)
    for readings in tuned_results.values():
        for tuned in readings["tuned"].values():
            # For the pendulum of half a kilogram the loss of `Separable` has basins that are
            # narrower than the looks of 16 starts: 3 of its 20 searches miss one, and the median is
            # larger by 1.5 %. The other eight medians are below those of the grid.
            assert tuned["loss"]["gradient"]["median"] <= 1.02 * tuned["loss"]["grid"]["median"]
            for spread in tuned["lengthscale"]["grid"].values():
                assert low[0] <= spread <= low[-1]
            error = tuned["trajectory_error"]["gradient"]["median"]
            assert error == tuned["trajectory_error_mean"]["median"]


@pytest.mark.slow
def test_report_compares_grid_and_gradient(tuned_run):
    text, out = tuned_run
    assert (out / "pendulum_m1_tuning.png").exists()
    assert "Hyperparameters tuned on each of 20 seeds by 5-fold cross-validation" in text
    assert text.count("gradient") >= 9
    assert "Of 9 pairs of system and kernel the gradient finds the lower median loss in" in text


@pytest.mark.slow
@pytest.mark.ci
def test_report_says_which_reading_fits_and_names_files_that_exist(run):
    text, out = run
    assert "Table I is closest to lambda for the harmonic oscillator" in text
    assert "Table II is closest to lambda for the harmonic oscillator" in text
    assert text.count("and to lambda with m = 1 kg for the pendulum") == 2
    named = {line.strip() for line in text.partition("Written:")[2].splitlines() if line.strip()}
    assert named == {str(path) for path in out.iterdir()}


@pytest.mark.slow
@pytest.mark.ci
def test_figures_are_written_and_not_blank(run):
    figures = sorted(run[1].glob("*.png"))
    assert len(figures) == 3 * 2 * 2  # experiments, readings, portraits and test trajectory
    for figure in figures:
        pixels = matplotlib.image.imread(figure)[..., :3]
        assert pixels.shape[1] >= 800
        assert 0.01 < np.mean(np.any(pixels < 0.95, axis=2)) < 0.9


@pytest.mark.slow
@pytest.mark.ci
def test_verdict_is_computed_from_the_results(results):
    swapped = copy.deepcopy(results)
    for readings in swapped.values():
        readings["lambda"], readings["N*lambda"] = readings["N*lambda"], readings["lambda"]
    text = paper.report(swapped, paper.experiments(), SEEDS)
    assert "Table I is closest to N*lambda for the harmonic oscillator" in text
    assert "Table II is closest to N*lambda for the harmonic oscillator" in text


@pytest.mark.slow
def test_data_has_the_noise_of_the_paper_and_keys_decide_it():
    oscillator = paper.experiments()["harmonic_oscillator"]
    keys = jax.vmap(jax.random.key)(np.arange(400))
    X, Y = paper.datasets(oscillator, keys)
    assert X.shape == Y.shape == (400, oscillator.size, 2)
    # ẋ = (p/m, −kq) with m = 0.5, k = 1: closed form.
    ts, w = 0.25 * np.arange(5), np.sqrt(2)
    q0 = np.array([1.0, 2.25, 3.5])[:, None]
    q, p = q0 * np.cos(w * ts), -0.5 * w * q0 * np.sin(w * ts)
    x = np.stack([q, p], axis=-1).reshape(-1, 2)
    y = np.stack([p / 0.5, -q], axis=-1).reshape(-1, 2)
    for noise in (np.asarray(X) - x, np.asarray(Y) - y):
        # 12 000 numbers of standard deviation 0.1: six standard errors.
        assert abs(noise.mean()) < 6 * 0.1 / np.sqrt(noise.size)
        assert abs(noise.std() - 0.1) < 6 * 0.1 / np.sqrt(2 * noise.size)
    again, _ = paper.datasets(oscillator, keys[:2])
    np.testing.assert_allclose(again, X[:2], rtol=1e-9)


def test_an_outcome_agrees_with_the_closed_form_in_numpy_and_scipy():
    oscillator = paper.experiments()["harmonic_oscillator"]
    model = oscillator.models["odd_symplectic"]
    X, Y = paper.datasets(oscillator, jax.vmap(jax.random.key)(np.arange(2)))
    ridge = model.regularization
    outcome = paper.evaluate(oscillator, model.kernel, X, Y, ridge / oscillator.size)
    field, H = odd_symplectic(np.asarray(X[1]), np.asarray(Y[1]), 12.1, ridge)
    solution = solve_ivp(
        lambda t, x: field(x), (0, 4), [2.0, 0.0], "DOP853", outcome.ts, rtol=1e-11, atol=1e-12
    )
    # Rounding in a Gram of condition 1e7 and tolerances of 1e-10 over some turns.
    np.testing.assert_allclose(outcome.learned[1], solution.y.T, atol=1e-6)
    w = np.sqrt(2)
    true = [2 * np.cos(w * solution.t), -w * np.sin(w * solution.t)]
    error = np.linalg.norm(solution.y - true, axis=0)
    quantities = {name: values[1] for name, values in outcome.quantities.items()}
    assert quantities["trajectory_error_mean"] == pytest.approx(error.mean(), abs=1e-6)
    assert quantities["trajectory_error_max"] == pytest.approx(error.max(), abs=1e-6)
    energy = np.mean([H(x) for x in solution.y.T])
    assert quantities["learned_hamiltonian_mean"] == pytest.approx(energy, rel=1e-6)
    assert quantities["true_hamiltonian_mean"] == pytest.approx(2.0, rel=1e-6)


@pytest.mark.slow
def test_grid_refits_are_the_closed_form_and_each_seed_takes_its_best_point():
    pendulum = paper.experiments()["pendulum_m1"]
    X, Y = paper.datasets(pendulum, jax.vmap(jax.random.key)(np.arange(2)))
    compared = paper.compare(pendulum, "separable", X, Y)
    sigmas, ridges = np.geomspace(0.3, 30.0, 30), np.geomspace(1e-10, 1.0, 25)
    for i, j in [(3, 20), (15, 12), (29, 24)]:
        K = hk.Separable(hk.Gaussian(sigmas[i]))
        loss = hk.cross_validation_loss(K, X[0], Y[0], ridges[j], 5)
        # Condition of the systems, up to 1e9, times rounding.
        np.testing.assert_allclose(compared.surface[i, j], loss, rtol=1e-6)
    assert compared.grid.loss[0] == np.nanmin(compared.surface)
    for choice in (compared.grid, compared.gradient):
        for seed in range(2):
            K = hk.Separable(hk.Gaussian(choice.lengthscale[seed]))
            ridge = choice.regularization[seed]
            loss = hk.cross_validation_loss(K, X[seed], Y[seed], ridge, 5)
            np.testing.assert_allclose(choice.loss[seed], loss, rtol=1e-3)
            alone = paper.evaluate(pendulum, K, X[seed : seed + 1], Y[seed : seed + 1], ridge)
            np.testing.assert_allclose(
                choice.quantities["trajectory_error_mean"][seed],
                alone.quantities["trajectory_error_mean"][0],
                rtol=1e-3,  # the tuned are integrated to 1e-6
            )


def odd_symplectic(X, Y, scale, ridge):
    """The learned field and Hamiltonian of the paper's odd symplectic kernel, in NumPy."""
    J = np.array([[0.0, 1.0], [-1.0, 0.0]])

    def block(d):  # −∇∇ᵀg at d
        g = np.exp(-(d @ d) / (2 * scale**2))
        return g * (np.eye(2) / scale**2 - np.outer(d, d) / scale**4)

    def slope(d):  # −∇g at d
        return np.exp(-(d @ d) / (2 * scale**2)) * d / scale**2

    def K(x, z):
        return J @ (block(x - z) - block(x + z)) @ J.T / 2

    G = np.block([[K(x, z) for z in X] for x in X])
    A = np.linalg.solve(G + ridge * np.eye(len(G)), Y.ravel()).reshape(-1, 2)

    def field(x):
        return sum(K(x, z) @ a for z, a in zip(X, A, strict=True))

    def H(x):
        return sum((slope(x - z) - slope(x + z)) @ (J.T @ a) / 2 for z, a in zip(X, A, strict=True))

    return field, H


def test_summary_holds_the_quantiles_over_seeds():
    values = np.random.default_rng(0).normal(size=31)
    outcome = SimpleNamespace(quantities={"trajectory_error_mean": values})
    spread = paper.summarise({"a": {"lambda": {"k": cast(paper.Outcome, outcome)}}})["a"]["lambda"][
        "k"
    ]
    ranked = np.sort(values)  # 31 values: the quantiles are elements 3, 15 and 27
    assert spread["trajectory_error_mean"] == {
        "p10": pytest.approx(ranked[3]),
        "median": pytest.approx(ranked[15]),
        "p90": pytest.approx(ranked[27]),
    }


def test_no_seed_is_refused():
    with pytest.raises(ValueError, match="at least one noise seed"):
        paper.reproduce(seeds=0)


@pytest.mark.slow
def test_a_folder_that_cannot_be_made_is_refused_before_the_work(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    command = [sys.executable, "-m", "hamkernel", "--out", str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert "cannot be written" in done.stderr

    def work(*arguments):
        raise AssertionError("the work began")

    monkeypatch.setattr("hamkernel.paper._reproduce._outcomes", work)
    with pytest.raises(FileExistsError):
        paper.reproduce(tmp_path / "file", seeds=1)
    with pytest.raises(AssertionError, match="the work began"):
        paper.reproduce(tmp_path / "folder", seeds=1)


def test_tuning_before_the_paper_is_refused_at_once(tmp_path):
    with pytest.raises(FileNotFoundError, match="reproduce"):
        paper.retune(tmp_path)
