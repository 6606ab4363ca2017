"""Whether `learn` says of logs that it has not met before if the field may be used."""

# pyright: reportArgumentType=false

import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel._learned.diagnostics import _noise_against_motion
from hamkernel._runs.table import Diagnostic, Diagnostics
from hamkernel._trajectories.quality import energies

K = hk.Symplectic(hk.Gaussian(1.0))
FRICTION = hk.Sum(energy=hk.Symplectic(hk.Gaussian(1.0)), friction=hk.Friction())


def pendulum(runs=3, samples=60, spacing=0.1, noise=0.02, friction=0.0, seed=0):
    """Times and noisy (q, p) of a pendulum, by SciPy."""
    rng = np.random.default_rng(seed)
    t = spacing * np.arange(samples)
    states = []
    for _ in range(runs):
        x0 = rng.uniform(-1.5, 1.5, 2)
        path = solve_ivp(
            lambda _, x: [x[1], -np.sin(x[0]) - friction * x[1]],
            (0, t[-1]),
            x0,
            t_eval=t,
            rtol=1e-10,
            atol=1e-10,
        ).y.T
        states.append(path + noise * rng.standard_normal(path.shape))
    return [t] * runs, states


def animals(years=91, seed=0):
    """Prey and predators, in thousands, whose growth the weather changes each year."""
    rng = np.random.default_rng(seed)
    x, log = np.array([30.0, 10.0]), []
    for _ in range(years):
        growth = 0.6 + 0.35 * rng.standard_normal()
        x = solve_ivp(
            lambda _, x, g: [g * x[0] * (1 - x[0] / 150) - 0.03 * x[0] * x[1],
                             -0.8 * x[1] + 0.02 * x[0] * x[1]],
            (0, 1), x, args=(growth,),
        ).y[:, -1]  # fmt: skip
        log.append(x * np.exp(0.1 * rng.standard_normal(2)))
    return np.arange(float(years)), np.array(log)


def learn_and_listen(K, runs, **options):
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        learned = hk.learn(K, runs, **options)
    return learned, [str(each.message) for each in heard]


@pytest.mark.slow  # and the fields of test_learn.py
def test_a_good_log_is_silent_and_usable():
    learned, heard = learn_and_listen(K, hk.Runs(*pendulum()))
    assert learned.converged
    assert heard == []
    assert learned.diagnostics.failing == ()
    np.testing.assert_allclose(learned.noise, 0.02, rtol=0.2)


def runs_from(angles, noise=0.01):
    """Runs of a pendulum that is released from these angles, by SciPy."""
    t, rng = np.linspace(0, 8, 60), np.random.default_rng(0)
    options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-10}
    paths = [
        solve_ivp(lambda _, x: [x[1], -np.sin(x[0])], (0, 8), [angle, 0.0], **options).y.T
        for angle in angles
    ]
    return hk.Runs([t] * len(paths), [x + noise * rng.standard_normal(x.shape) for x in paths])


def test_energies_are_compared_with_what_noise_leaves_of_one():
    X = np.random.default_rng(0).uniform(-2, 2, (80, 2))
    Y = np.stack([X[:, 1], -np.sin(X[:, 0])], 1)
    field = hk.fit(K, X, Y, regularization=1e-10)
    fit = SimpleNamespace(
        scale=np.ones(2), noise=np.array([0.01, 0.02]), kept=np.ones(2),
        driven=False, is_disturbed=False, pushed=(),
    )  # fmt: skip
    paths = runs_from([1.2, 1.1], noise=0.0).host_arrays()[1]
    H = np.array([-np.cos(1.2), -np.cos(1.1)])
    some = np.concatenate([x[np.linspace(0, 59, 8).astype(int)] for x in paths])
    slopes = np.stack([np.sin(some[:, 0]), some[:, 1]], 1)
    one = np.sqrt(np.mean(np.sum((slopes * fit.noise) ** 2, axis=1)) / 60)
    assert energies(field, fit, paths) == pytest.approx(H.std() / one, rel=1e-3)
    other = {"kept": np.array([0.0, 1.0])}, {"is_disturbed": True}
    alone, pushed = (SimpleNamespace(**vars(fit) | each) for each in other)
    assert energies(field, alone, paths) == 0.0
    assert energies(field, pushed, paths) is None
    apart = hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0) + hk.Select(hk.Gaussian(1.0), 1))
    assert energies(hk.fit(apart, X, Y, regularization=1e-10), fit, paths) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angles", "apart", "failing"),
    [([1.2], False, ("energies",)), ([1.2, 1.2], False, ("energies",)),
     ([1.2, 1.1], False, ()), ([1.2], True, ())],
)  # fmt: skip
def test_runs_of_one_energy_determine_a_field_that_is_separable_alone(angles, apart, failing):
    whole, parts = hk.Gaussian(1.0), [hk.Select(hk.Gaussian(1.0), i) for i in (0, 1)]
    kernel = hk.Symplectic(parts[0] + parts[1] if apart else whole)
    learned, heard = learn_and_listen(kernel, runs_from(angles))
    assert learned.diagnostics.failing == failing
    assert len(heard) == len(failing)
    x = jnp.array([[0.2, 0.2], [-0.8, 0.8], [0.0, 0.6]])  # inside the orbit
    error = np.abs(
        np.asarray(jax.vmap(learned.field)(x)) - np.stack([x[:, 1], -jnp.sin(x[:, 0])], 1)
    )
    assert (error.max() > 0.04) == bool(failing)


@pytest.mark.slow
@pytest.mark.parametrize("value", [-9999.0, 1e6])
def test_one_row_that_is_no_measurement_is_named_and_spoils_no_field(value):
    times, states = pendulum()
    states[1][20] = value
    with pytest.warns(UserWarning, match="Write NaN"):
        runs = hk.Runs(times, states)
    assert [list(rows) for rows in runs.impossible] == [[], [20], []]
    learned, heard = learn_and_listen(K, runs)
    # The run with that row is left out, or the field must not be used.
    assert not learned.converged or np.allclose(learned.noise, 0.02, rtol=0.2)
    assert len(heard) == 1
    assert "one curve" not in learned.diagnostics.failing


@pytest.mark.slow
def test_dropouts_written_as_zeros_make_the_field_unusable():
    times, states = pendulum()
    for x in states:
        x[::8] = 0.0
    with pytest.warns(UserWarning, match="Write NaN"):
        runs = hk.Runs(times, states)
    learned, heard = learn_and_listen(K, runs)
    assert not learned.converged
    assert len(heard) == 1


@pytest.mark.slow
@pytest.mark.parametrize("step", [None, 0.05])
def test_a_run_at_rest_is_one_measurement_of_the_noise(step):
    times, states = pendulum(noise=0.02 if step is None else 0.0)
    noise = 0.02
    if step is not None:
        states, noise = [step * np.round(x / step) for x in states], step / np.sqrt(12)
    runs = hk.Runs([*times, times[0]], [*states, np.zeros_like(states[0])])
    learned, heard = learn_and_listen(K, runs)
    assert heard == []
    np.testing.assert_allclose(learned.noise, noise, rtol=0.08)  # 13 % too small as 60 samples


@pytest.mark.slow
def test_animals_in_weather_are_no_hamiltonian_system():
    years, log = animals()
    learned, heard = learn_and_listen(K, hk.Runs([years], [log]))
    assert not learned.converged
    assert len(heard) == 1
    assert "one curve" not in learned.diagnostics.failing


@pytest.mark.slow
def test_a_quantised_encoder_and_the_right_friction_are_silent():
    times, states = pendulum(runs=3, samples=200, spacing=0.05, noise=0.0, friction=0.1)
    step = 2 * np.pi / 4096
    states = [np.column_stack([step * np.round(x[:, 0] / step), x[:, 1] * np.nan]) for x in states]
    half = hk.Sum(energy=hk.Symplectic(hk.Select(hk.Gaussian(1.0), 0)), friction=hk.Friction())
    learned, heard = learn_and_listen(
        half, hk.Runs(times, states), mean=lambda x: jnp.array([x[1], 0.0])
    )
    assert learned.converged, learned.diagnostics
    assert heard == [], learned.diagnostics
    np.testing.assert_allclose(learned.noise[0], step / np.sqrt(12), rtol=0.1)


def rubbing(x0, t, rng):
    """Noisy (q, p) of an oscillator with dry friction of .5, by SciPy."""
    path = solve_ivp(
        lambda _, x: [x[1], -x[0] - 0.5 * np.tanh(20 * x[1])], (0, t[-1]), x0, t_eval=t, rtol=1e-8
    ).y.T
    return path + 0.01 * path.std(axis=0) * rng.standard_normal(path.shape)


@pytest.mark.slow
@pytest.mark.parametrize(("kernel", "usable"), [(K, False), (FRICTION, True)])
def test_runs_that_can_be_followed_without_their_friction_ask_for_it(kernel, usable):
    # The three runs never cross, so some field without friction follows them within the noise.
    t, rng = np.linspace(0, 6, 61), np.random.default_rng(0)
    runs = hk.Runs([t] * 3, [rubbing(x0, t, rng) for x0 in ([2.0, 0.0], [3.0, 1.0], [-4.0, 0.0])])
    learned, heard = learn_and_listen(kernel, runs)
    assert learned.converged == usable
    assert ("missing force" in learned.diagnostics.failing) != usable
    assert ["hk.Friction()" in said for said in heard] == [True] * (not usable), heard


def counts_of_animals(rng):
    """Predators and prey on three orbits, whose logarithms are Hamiltonian."""
    t = np.linspace(0, 12, 121)
    for x0 in ([1.5, 1.0], [2.0, 1.0], [1.0, 0.6]):
        path = solve_ivp(
            lambda _, x: [x[0] * (1 - x[1]), x[1] * (x[0] - 1)],
            (0, 12), x0, t_eval=t, rtol=1e-8,
        ).y.T  # fmt: skip
        yield t, path * np.exp(0.02 * rng.standard_normal(path.shape))


@pytest.mark.slow
@pytest.mark.parametrize(("coordinates", "usable"), [(np.asarray, False), (np.log, True)])
def test_a_field_outside_the_structure_is_asked_for(coordinates, usable):
    # A divergence-free field passes three orbits that never cross; its free runs follow them.
    times, states = zip(*counts_of_animals(np.random.default_rng(0)), strict=True)
    runs = hk.Runs(times, [coordinates(x) for x in states])
    learned, heard = learn_and_listen(K, runs)
    assert learned.converged == usable, learned.diagnostics
    assert ("missing force" in learned.diagnostics.failing) != usable
    assert ["outside the structure" in said for said in heard] == [True] * (not usable), heard


@pytest.mark.slow
def test_a_limit_cycle_is_refused_though_a_wrong_field_follows_its_runs():
    # Free runs follow the three runs to .06 of a constant; an unseen one is off by 1.4 deviations.
    t, rng, states = np.linspace(0, 6, 61), np.random.default_rng(3), []
    for start in ([0.5, 0.0], [2.5, 0.0], [-1.0, 2.0]):
        options = {"t_eval": t, "rtol": 1e-10, "atol": 1e-10}
        cycle = lambda _, x: [x[1], (1 - x[0] ** 2) * x[1] - x[0]]  # noqa: E731
        x = solve_ivp(cycle, (0, 6), start, **options).y.T
        states.append(x + 0.02 * x.std(axis=0) * rng.standard_normal(x.shape))
    K = hk.PortHamiltonian(hk.Gaussian(1.0), friction=0.1)
    learned, _ = learn_and_listen(K, hk.Runs([t] * 3, states))
    assert not learned.converged, learned.diagnostics
    assert "missing force" in learned.diagnostics.failing


@pytest.mark.slow
def test_correlated_errors_of_sensors_are_no_missing_force():
    times, states = pendulum(runs=3, noise=0.0)
    rng = np.random.default_rng(0)
    for x in states:
        error = np.zeros(2)
        for row in x:
            error = 0.8 * error + 0.6 * rng.standard_normal(2)
            row += 0.02 * error
    learned, _ = learn_and_listen(K, hk.Runs(times, states))
    assert learned.converged, learned.diagnostics
    assert learned.diagnostics["missing force"].passes


def double_pendulum():
    """Five runs of 4 s, with angles of .5 rad and momenta of 3 N m s, by SciPy."""
    rng, t, g = np.random.default_rng(3), 0.04 * np.arange(101), 9.81

    def rates(_, x):
        (q, p), c = (x[:2], x[2:]), np.cos(x[0] - x[1])
        v = np.linalg.solve([[2.0, c], [c, 1.0]], p)
        s = -v[0] * v[1] * np.sin(x[0] - x[1])
        return [*v, -2 * g * np.sin(q[0]) + s, -g * np.sin(q[1]) - s]

    states, noise = [], np.array([0.005, 0.005, 0.02, 0.02])
    for _ in range(5):
        x0 = np.append(rng.uniform(-1.2, 1.2, 2), np.zeros(2))
        path = solve_ivp(rates, (0, 4), x0, t_eval=t, rtol=1e-9, atol=1e-9).y.T
        states.append(path + noise * rng.standard_normal(path.shape))
    return hk.Runs([t] * 5, states)


@pytest.mark.slow
@pytest.mark.parametrize(("lengthscale", "is_named"), [(2.0, True), ([1.5, 1.5, 5.0, 5.0], False)])
def test_a_lengthscale_for_each_coordinate_is_asked_for(lengthscale, is_named):
    K = hk.Odd(hk.Symplectic(hk.Gaussian(lengthscale)))
    learned, heard = learn_and_listen(K, double_pendulum())
    assert len(heard) == is_named
    assert ("whiteness" in learned.diagnostics.failing) == is_named
    assert ("one lengthscale" in learned.diagnostics["whiteness"].advice) == is_named


def test_a_sentence_of_the_table_has_the_name_of_the_column():
    fit = SimpleNamespace(names=("angle", "speed"), noise=np.array([0.1, 0.9]), scale=np.ones(2))
    row = _noise_against_motion(fit)
    assert "the noise of coordinate speed is 0.9" in row.meaning


def test_the_table_prints_in_ascii_and_in_html():
    table = Diagnostics(
        (
            Diagnostic("noise", "0.1", "0.5", True, "the field explains the runs"),
            Diagnostic("a < b", "3", "2", False, "it fails", "Mend it.", decides=True),
        )
    )
    assert table.failing == ("a < b",)
    assert not table.is_usable
    assert "Mend it." in repr(table)
    assert "a &lt; b" in table._repr_html_()
    assert table["noise"].passes
    with pytest.raises(KeyError, match="there are noise, a < b"):
        table["nothing"]
