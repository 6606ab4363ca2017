"""Order, symplecticity and reversibility, each beside a solver for which the check fails."""

import pickle

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.test_util import check_grads
from scipy.integrate import solve_ivp

import hamkernel as hk
from hamkernel import GaussLegendre4, GaussLegendre6, ImplicitMidpoint, StormerVerlet, Yoshida4
from hamkernel._symplectic import FixedPointToRounding

GAUSS = [ImplicitMidpoint(), GaussLegendre4(), GaussLegendre6()]
SPLITTING = [StormerVerlet(), Yoshida4()]
NOT_SYMPLECTIC = [diffrax.Heun(), diffrax.Tsit5()]

ROUNDING = 1e-14  # some 50 eps: a few operations on numbers of order one
START = jnp.array([0.12, 0.1, 0.3, -0.25])


def name(solver):
    return type(solver).__name__


class HenonHeiles(eqx.Module):
    """H = (p₁² + p₂² + q₁² + q₂²)/2 + c (q₁² q₂ − q₂³/3)."""

    coupling: float | jax.Array = 1.0
    is_separable = True

    def __call__(self, x):
        q1, q2, p1, p2 = x
        c = self.coupling
        return jnp.stack([p1, p2, -q1 - 2 * c * q1 * q2, -q2 - c * (q1**2 - q2**2)])

    def hamiltonian(self, x):
        q1, q2, p1, p2 = x
        quadratic = (p1**2 + p2**2 + q1**2 + q2**2) / 2
        return quadratic + self.coupling * (q1**2 * q2 - q2**3 / 3)


def tangled(x):
    """The field of H = (1 + q²)(1 + p²)/2, which is not separable."""
    q, p = x
    return jnp.stack([(1 + q**2) * p, -q * (1 + p**2)])


class Term(eqx.Module):
    """A field as `diffrax.ODETerm` calls it."""

    field: HenonHeiles

    @property
    def is_separable(self):
        return self.field.is_separable

    def __call__(self, t, x, args):
        return self.field(x)


def bare_term(field):
    return diffrax.ODETerm(lambda t, x, args: field(x))


def one_step(solver, term, x, h):
    t0, t1 = jnp.zeros((), x.dtype), jnp.asarray(h, x.dtype)
    state = solver.init(term, t0, t1, x, None)
    return solver.step(term, t0, t1, x, None, state, False)[0]


def integrate(solver, term, x0, t0, t1, steps, max_steps=2**18, **options):
    # Arrays, so that all numbers of steps share one compiled loop.
    t0, t1 = jnp.array(t0), jnp.array(t1)
    dt = (t1 - t0) / steps
    ys = diffrax.diffeqsolve(term, solver, t0, t1, dt, x0, max_steps=max_steps, **options).ys
    assert ys is not None
    return ys[-1]


def symplectic_defect(solver, term, x, h=0.3):
    """max |Ψ'ᵀ J Ψ' − J| of one step."""
    m = x.size // 2
    J = np.block([[np.zeros((m, m)), np.eye(m)], [-np.eye(m), np.zeros((m, m))]])
    D = np.asarray(jax.jit(jax.jacrev(lambda x: one_step(solver, term, x, h)))(x))
    return np.abs(D.T @ J @ D - J).max()


# The steps are small enough for the leading term of the error to rule, large enough for the error
# of the finest to stay far above rounding.
@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("solver", "order", "steps"),
    [
        (ImplicitMidpoint(), 2, [40, 80, 160]),
        (StormerVerlet(), 2, [40, 80, 160]),
        (GaussLegendre4(), 4, [20, 40, 80]),
        (Yoshida4(), 4, [60, 120, 240]),
        (GaussLegendre6(), 6, [10, 20, 40]),
    ],
    ids=lambda value: name(value) if isinstance(value, diffrax.AbstractSolver) else None,
)
def test_error_falls_with_the_nominal_order(solver, order, steps):
    field = HenonHeiles()
    exact = solve_ivp(
        lambda t, x: np.asarray(field(x)), (0, 5), START, method="DOP853", rtol=1e-13, atol=1e-15
    ).y[:, -1]
    term = diffrax.ODETerm(Term(field))
    errors = [np.linalg.norm(integrate(solver, term, START, 0.0, 5.0, n) - exact) for n in steps]
    slope = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert abs(slope - order) < 0.15
    assert solver.order(term) == order


class Driven(Term):
    """A spring whose velocity and force both depend on time."""

    def __call__(self, t, x, args):
        return jnp.stack([x[1] + jnp.cos(2 * t), -x[0] + jnp.sin(3 * t)])


@pytest.mark.parametrize(
    ("solver", "error"),
    [(ImplicitMidpoint(), 5e-3), (GaussLegendre4(), 1e-6), (StormerVerlet(), 5e-3)],
    ids=lambda value: name(value) if isinstance(value, diffrax.AbstractSolver) else None,
)
def test_velocity_and_force_are_taken_at_the_times_of_the_stages(solver, error):
    exact = solve_ivp(
        lambda t, x: [x[1] + np.cos(2 * t), -x[0] + np.sin(3 * t)],
        (0, 2),
        [1.0, 0.0],
        "DOP853",
        rtol=1e-12,
    ).y[:, -1]
    term = diffrax.ODETerm(Driven(HenonHeiles()))
    end = integrate(solver, term, jnp.array([1.0, 0.0]), 0.0, 2.0, 40)
    assert np.linalg.norm(end - exact) < error


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", GAUSS, ids=name)
def test_gauss_step_is_symplectic_for_any_hamiltonian(solver):
    assert symplectic_defect(solver, bare_term(tangled), jnp.array([0.4, 0.7])) < ROUNDING
    assert symplectic_defect(solver, bare_term(HenonHeiles()), START) < ROUNDING


@pytest.mark.parametrize("solver", SPLITTING, ids=name)
def test_splitting_step_is_symplectic_for_a_separable_hamiltonian(solver):
    assert symplectic_defect(solver, diffrax.ODETerm(Term(HenonHeiles())), START) < ROUNDING


@pytest.mark.parametrize("solver", NOT_SYMPLECTIC, ids=name)
def test_explicit_runge_kutta_step_is_not_symplectic(solver):
    assert symplectic_defect(solver, bare_term(HenonHeiles()), START) > 1e-8


def test_splitting_of_a_field_that_is_not_separable_is_not_symplectic():
    solver = StormerVerlet(assume_separable=True)
    assert symplectic_defect(solver, bare_term(tangled), jnp.array([0.4, 0.7])) > 1e-3


@pytest.mark.few(3)
@pytest.mark.parametrize("solver", [*GAUSS, *SPLITTING, *NOT_SYMPLECTIC], ids=name)
def test_only_symmetric_methods_come_back_by_integrating_backwards(solver):
    term = diffrax.ODETerm(Term(HenonHeiles()))
    there = integrate(solver, term, START, 0.0, 10.0, 40)
    back = integrate(solver, term, there, 10.0, 0.0, 40)
    gap = float(jnp.abs(back - START).max())
    if solver in NOT_SYMPLECTIC:
        assert gap > 1e-8
    else:
        assert gap < 1e-13  # 80 steps of rounding


def test_an_integrator_prints_what_differs_from_its_defaults():
    copy = pickle.loads(pickle.dumps(ImplicitMidpoint()))
    assert repr(copy) == repr(ImplicitMidpoint()) == "ImplicitMidpoint()"
    changed = GaussLegendre4(root_find_max_steps=7)
    assert repr(changed) == "GaussLegendre4(root_find_max_steps=7)"


def test_gauss_coefficients_are_those_of_the_tables():
    r3, r15 = np.sqrt(3), np.sqrt(15)
    four, six = GaussLegendre4.tableau, GaussLegendre6.tableau
    np.testing.assert_allclose(four.c, [1 / 2 - r3 / 6, 1 / 2 + r3 / 6], atol=ROUNDING)
    np.testing.assert_allclose(
        four.a, [[1 / 4, 1 / 4 - r3 / 6], [1 / 4 + r3 / 6, 1 / 4]], atol=ROUNDING
    )
    np.testing.assert_allclose(six.b, [5 / 18, 4 / 9, 5 / 18], atol=ROUNDING)
    np.testing.assert_allclose(
        six.a,
        [
            [5 / 36, 2 / 9 - r15 / 15, 5 / 36 - r15 / 30],
            [5 / 36 + r15 / 24, 2 / 9, 5 / 36 - r15 / 24],
            [5 / 36 + r15 / 30, 2 / 9 + r15 / 15, 5 / 36],
        ],
        atol=ROUNDING,
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("solver", GAUSS, ids=name)
def test_rounded_coefficients_are_symplectic_exactly(solver, dtype):
    share = np.asarray(solver.tableau.share, dtype)
    share = np.where(share < 0.5, 1 - share.T, share)  # as in every step
    assert (share + share.T == 1).all()
    np.testing.assert_allclose(
        share * solver.tableau.b, solver.tableau.a, atol=10 * np.finfo(dtype).eps
    )


def stage_residual(solver, field, x, h):
    """Residual of k_i = f(x + h Σ a_ij k_j), relative to the largest slope."""
    term = bare_term(field)
    guess = solver.init(term, 0.0, h, x, None)
    _, _, _, k, result = solver.step(term, 0.0, h, x, None, guess, False)
    states = np.asarray(x) + h * solver.tableau.a @ np.asarray(k)
    residual = np.asarray(k) - np.stack([np.asarray(field(jnp.asarray(s))) for s in states])
    return np.abs(residual).max() / np.abs(k).max(), result


@pytest.mark.few(9)
@pytest.mark.parametrize("solver", GAUSS, ids=name)
@pytest.mark.parametrize("h", [1e-3, 0.1, 0.8])
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_stage_equations_are_solved_to_rounding(solver, h, scale):
    def field(x):
        return scale * HenonHeiles()(x / scale)

    residual, result = stage_residual(solver, field, scale * START, h)
    assert result == diffrax.RESULTS.successful
    assert residual < 4e-15  # some eps


# 1e9 leaves seven digits, as the tuned fit of noise-free data does.
@pytest.mark.parametrize(("size", "error"), [(1e6, 1e-9), (1e9, 1e-6)])
def test_iteration_stops_at_the_rounding_errors_of_the_field(size, error):
    # A sum that cancels, as a kernel field with large coefficients does: its value is uncertain by
    # size · eps, an increment of eps is never reached, and the solve must end well all the same.
    def field(x):
        return (size + tangled(x)) - size * jnp.cos(x - x)

    residual, result = stage_residual(GaussLegendre4(), field, jnp.array([0.4, 0.7]), 0.1)
    assert result == diffrax.RESULTS.successful
    assert residual < error


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [ImplicitMidpoint(), GaussLegendre4()], ids=name)
@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-9])
def test_the_iteration_ends_at_an_equilibrium_where_the_field_is_nothing_but_rounding(solver, away):
    def field(x):  # a pendulum that hangs at q = 0.3, with ten digits
        return (1e6 + jnp.stack([x[1], -jnp.sin(x[0] - 0.3)])) - 1e6 * jnp.cos(x - x)

    x0 = jnp.array([0.3 + away, 0.0])
    y = integrate(solver, bare_term(field), x0, 0.0, 10.0, 100)
    assert jnp.abs(y - x0).max() < 2 * away + 1e-8  # 1e6 eps in every step
    with pytest.raises(RuntimeError, match=r"diverge|maximum number"):  # hω = 5
        integrate(solver, bare_term(field), jnp.array([0.3 + 1e-9, 0.0]), 0.0, 50.0, 10)


def test_fixed_point_iteration_fails_loudly_where_newton_converges():
    def stiff(x):
        return jnp.stack([x[1], -900.0 * x[0]])  # h ω / 2 = 3: the iteration diverges

    x0 = jnp.array([1.0, 0.0])
    with pytest.raises(RuntimeError, match=r"diverge|maximum number"):
        integrate(ImplicitMidpoint(), bare_term(stiff), x0, 0.0, 2.0, 10)
    newton = optx.Newton(rtol=1e-13, atol=1e-13)
    y = integrate(ImplicitMidpoint(root_finder=newton), bare_term(stiff), x0, 0.0, 2.0, 10)
    # The midpoint rule is a rotation of (30 q, p), whatever the step.
    np.testing.assert_allclose(30**2 * y[0] ** 2 + y[1] ** 2, 30**2, rtol=1e-12)


def test_newton_and_fixed_point_make_the_same_step():
    newton = GaussLegendre4(root_finder=optx.Newton(rtol=1e-14, atol=1e-14))
    a = one_step(newton, bare_term(tangled), jnp.array([0.4, 0.7]), 0.2)
    b = one_step(GaussLegendre4(), bare_term(tangled), jnp.array([0.4, 0.7]), 0.2)
    np.testing.assert_allclose(a, b, atol=ROUNDING)


def test_fixed_point_iteration_finds_the_fixed_point_of_the_cosine():
    solution = optx.fixed_point(lambda x, _: jnp.cos(x), FixedPointToRounding(), jnp.array(1.0))
    np.testing.assert_allclose(solution.value, 0.7390851332151607, rtol=1e-15)


def test_midpoint_conserves_a_quadratic_hamiltonian_to_rounding():
    def oscillator(x):
        return jnp.stack([2.0 * x[1], -x[0]])

    def energy(x):
        return x[1] ** 2 + x[0] ** 2 / 2

    x0, steps = jnp.array([1.0, 0.5]), 100_000
    y = integrate(ImplicitMidpoint(), bare_term(oscillator), x0, 0.0, 0.1 * steps, steps)
    # Rounding walks at random: about eps √steps = 7e-14.
    assert abs(energy(y) / energy(x0) - 1) < 1e-12
    z = integrate(diffrax.Heun(), bare_term(oscillator), x0, 0.0, 0.1 * steps, steps)
    assert abs(energy(z) / energy(x0) - 1) > 0.1


def rollout(solver, coupling, x0):
    term = diffrax.ODETerm(Term(HenonHeiles(coupling)))
    return jnp.sum(jnp.sin(integrate(solver, term, x0, 0.0, 2.0, 16, max_steps=16)))


# One of each family by default.
@pytest.mark.parametrize(
    "solver",
    [
        pytest.param(ImplicitMidpoint(), marks=pytest.mark.slow),
        GaussLegendre4(),
        pytest.param(GaussLegendre6(), marks=pytest.mark.slow),
        pytest.param(StormerVerlet(), marks=pytest.mark.slow),
        pytest.param(Yoshida4(), marks=pytest.mark.slow),
    ],
    ids=name,
)
def test_gradient_of_a_rollout_is_the_central_difference(solver):
    f = jax.jit(lambda c, x: rollout(solver, c, x))
    check_grads(f, (jnp.array(0.9), START), order=1, modes=["rev"])


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse_mode():
    term = diffrax.ODETerm(Term(HenonHeiles()))

    def end(x, adjoint):
        return integrate(GaussLegendre4(), term, x, 0.0, 2.0, 16, max_steps=16, adjoint=adjoint)

    forward = jax.jacfwd(lambda x: end(x, diffrax.ForwardMode()))(START)
    reverse = jax.jacrev(lambda x: end(x, diffrax.RecursiveCheckpointAdjoint()))(START)
    np.testing.assert_allclose(forward, reverse, atol=1e-13)


@pytest.mark.few(2)
@pytest.mark.parametrize("solver", [*GAUSS, *SPLITTING], ids=name)
def test_batch_by_vmap_under_jit_is_the_loop(solver):
    starts = START[None] * jnp.linspace(0.5, 1.5, 3)[:, None]
    term = diffrax.ODETerm(Term(HenonHeiles()))

    def end(x):
        return integrate(solver, term, x, 0.0, 2.0, 16)

    np.testing.assert_allclose(
        jax.jit(jax.vmap(end))(starts), jnp.stack([end(x) for x in starts]), atol=ROUNDING
    )


@pytest.mark.few(2)
@pytest.mark.parametrize("solver", [*GAUSS, *SPLITTING], ids=name)
def test_float32_stays_float32(solver):
    term = diffrax.ODETerm(Term(HenonHeiles()))
    y = one_step(solver, term, START.astype(jnp.float32), 0.1)
    assert y.dtype == jnp.float32
    np.testing.assert_allclose(y, one_step(solver, term, START, 0.1), atol=1e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("solver", [GaussLegendre4(), GaussLegendre6(), Yoshida4()], ids=name)
def test_values_between_steps_are_cubic(solver):
    term = diffrax.ODETerm(Term(HenonHeiles()))
    times = jnp.linspace(0.0, 5.0, 37)
    exact = solve_ivp(
        lambda t, x: np.asarray(HenonHeiles()(x)),
        (0, 5),
        START,
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-12,
    ).y.T
    errors = []
    for steps in [50, 100]:
        saveat = diffrax.SaveAt(ts=times)
        ys = diffrax.diffeqsolve(term, solver, 0.0, 5.0, 5.0 / steps, START, saveat=saveat).ys
        errors.append(np.abs(ys - exact).max())
    assert errors[1] < errors[0] / 10  # 2⁴ = 16 for an error O(h⁴), of which some leeway
    assert errors[1] < 1e-5


@pytest.mark.parametrize("solver", SPLITTING, ids=name)
def test_splitting_refuses_a_field_that_is_not_known_to_be_separable(solver):
    with pytest.raises(ValueError, match=r"cannot be proved.*assume_separable=True"):
        integrate(solver, bare_term(HenonHeiles()), START, 0.0, 1.0, 4)
    trusted = type(solver)(assume_separable=True)
    a = integrate(trusted, bare_term(HenonHeiles()), START, 0.0, 1.0, 4)
    b = integrate(solver, diffrax.ODETerm(Term(HenonHeiles())), START, 0.0, 1.0, 4)
    np.testing.assert_array_equal(a, b)


def test_after_a_jump_of_the_field_the_force_is_computed_anew():
    solver, term = StormerVerlet(), diffrax.ODETerm(Term(HenonHeiles()))
    t0, t1 = jnp.zeros(()), jnp.array(0.1)
    stale = jnp.full(2, 9.0)
    fresh = solver.step(term, t0, t1, START, None, stale, True)[0]
    np.testing.assert_array_equal(fresh, one_step(solver, term, START, 0.1))
    kept = solver.step(term, t0, t1, START, None, stale, False)[0]
    assert np.abs(kept - fresh).max() > 0.1


def test_splitting_refuses_an_odd_number_of_coordinates():
    with pytest.raises(ValueError, match="got 3 coordinates"):
        one_step(StormerVerlet(assume_separable=True), bare_term(jnp.sin), jnp.ones(3), 0.1)


@pytest.mark.parametrize("state", [jnp.ones((2, 4)), (jnp.ones(2), jnp.ones(2)), jnp.ones(())])
def test_a_state_that_is_not_one_array_of_coordinates_is_refused(state):
    term = bare_term(lambda x: x)
    with pytest.raises(ValueError, match="vmap"):
        ImplicitMidpoint().init(term, 0.0, 0.1, state, None)


@pytest.mark.parametrize("solver", [ImplicitMidpoint(), StormerVerlet()], ids=name)
def test_diffrax_refuses_an_adaptive_step(solver):
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    term = diffrax.ODETerm(Term(HenonHeiles()))
    with pytest.raises(RuntimeError, match=r"adaptive step sizes .* error estimates"):
        diffrax.diffeqsolve(term, solver, 0.0, 1.0, 0.1, START, stepsize_controller=controller)


def energies(field, x0, solver, dt, steps):
    """H(x(t)) / H(x(0)) at 1001 steps of the given number of them or a few more."""
    stride = steps // 1000 + 1  # no divisor of a period: the motion is met in every phase
    ts = np.arange(1001) * stride * dt
    ys = jnp.asarray(hk.simulate(field, x0, ts, solver, dt).ys)
    H = np.asarray(jax.vmap(field.hamiltonian)(ys))
    return H / H[0]


def drift_and_wobble(energy):
    """Fitted change of the energy over the whole run, and the spread about that line."""
    time = np.linspace(-0.5, 0.5, energy.size)
    slope, offset = np.polyfit(time, energy, 1)
    return abs(slope), np.std(energy - slope * time - offset)


def significant(wobble, samples):
    """Three standard errors of the fitted change, of samples of a wobble."""
    return 3 * np.sqrt(12 / samples) * wobble


@pytest.mark.slow
@pytest.mark.parametrize("solver", [*GAUSS, *SPLITTING, diffrax.Tsit5()], ids=name)
def test_energy_of_the_oscillator_over_1e5_periods_drifts_only_if_not_symplectic(solver):
    oscillator, dt = hk.systems.HarmonicOscillator(mass=1.0, stiffness=1.0), 0.2
    steps = int(1e5 * 2 * np.pi / dt)
    energy = energies(oscillator, jnp.array([1.0, 0.5]), solver, dt, steps)
    drift, wobble = drift_and_wobble(energy)
    # Where H is conserved exactly there is no wobble, and rounding errors walk at random.
    walk = 5 * np.finfo(float).eps * np.sqrt(steps)  # 2e-12
    if solver in NOT_SYMPLECTIC:
        assert drift > 1e-3
        assert drift > 100 * wobble
    else:
        assert drift < significant(wobble, energy.size) + walk
        assert np.abs(energy - 1).max() < (walk if solver in GAUSS else 0.01)


def learned_pendulum(k):
    pendulum = hk.systems.Pendulum(mass=1.0)
    starts = np.array([[1.26, 0.0], [2.51, 0.0], [2.98, -4.0]])
    X, Y = hk.systems.sample(
        pendulum, starts, 0.1 * np.arange(8), 0.01, 0.01, key=jax.random.key(0)
    )
    field = hk.fit(hk.Odd(hk.Symplectic(k)), X.reshape(-1, 2), Y.reshape(-1, 2), 1e-5)
    return field.anchored(jnp.zeros(2))


@pytest.mark.slow
@pytest.mark.parametrize("solver", [*GAUSS, *SPLITTING, diffrax.Tsit5()], ids=name)
def test_energy_of_a_learned_pendulum_over_1e5_steps_drifts_only_if_not_symplectic(solver):
    split = hk.Select(hk.Gaussian(3.0), 0) + hk.Select(hk.Gaussian(6.0), 1)
    field = learned_pendulum(split if solver in SPLITTING else hk.Gaussian(3.0))
    # 24 steps for each swing.
    energy = energies(field, jnp.array([np.pi / 2, 0.0]), solver, 0.1, 100_000)
    drift, wobble = drift_and_wobble(energy)
    if solver in NOT_SYMPLECTIC:
        assert drift > 1e-3
        assert drift > 100 * wobble
    else:
        assert drift < significant(wobble, energy.size)
        assert np.abs(energy - 1).max() < 0.05


@pytest.mark.slow
def test_steps_of_a_field_fitted_to_rounding_converge():
    # ℓ and λ as `tune` finds them for exact data: coefficients of 1e11, eight digits in the field.
    system = hk.systems.HenonHeiles()
    X = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (100, 4)))
    field = hk.fit(hk.Symplectic(hk.Gaussian(92.0)), X, jax.vmap(system)(X), 1e-17)
    assert jnp.abs(field.coefficients).max() > 1e10
    for solver in GAUSS:
        ys = hk.simulate(field, START, np.linspace(0, 100, 101), solver, dt=0.05).ys
        H = jax.vmap(system.hamiltonian)(jnp.asarray(ys))
        assert jnp.abs(H / H[0] - 1).max() < 2e-3
