"""A fit under `jax.jit`, `jax.vmap` and `jax.grad`: the host's numbers, and derivatives that differences confirm."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from jax.flatten_util import ravel_pytree
from synthetic import GRAVITY, POSES, SAMPLES, recording, simulated
from whitened_by_hand import gravity_direction, static_gyroscope

import jaximu
from jaximu.data.gravity_norm import gravity_norm
from jaximu.data.poses import PosesAndTurns, condense
from jaximu.data.poses_covariance import turned_by
from jaximu.estimation.problem import Name
from jaximu.estimation.projection import output_error, sensitivity
from jaximu.estimation.track import Recorded
from jaximu.model.effects import CATALOGUE
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.segmentation import segment
from jaximu.simulation.protocols import HandHeld

NOMINAL = jax.tree.map(np.asarray, jaximu.Imu.nominal())
EXCESS = np.array([0.5, 0.5, 0.5])


def data_of(seed: int, poses: int = POSES, samples: int = SAMPLES) -> PosesAndTurns:
    """Return the data of a simulated unit, without padding."""
    made = simulated(seed, poses=poses, used_samples=samples, padded=poses).observations
    data = PosesAndTurns.of(jax.tree.map(np.asarray, made))
    turns = replace(data.turns, output=data.turns.output[:, :samples], interval=data.turns.interval[:, :samples])
    return replace(data, turns=turns)


def off(fit, other) -> float:
    """Return the largest difference of two fits' numbers, in standard deviations."""
    return float(np.max(np.abs((np.asarray(fit.values) - other.values) / other.sigmas())))


@pytest.fixture(scope="module")
def data() -> list[PosesAndTurns]:
    """Data of three units, the last with fewer poses and samples."""
    return [data_of(30), data_of(31), data_of(32, poses=10, samples=40)]


@pytest.fixture(scope="module")
def hosts(data):
    """Return the same fitted on the host."""
    return [jaximu.fit(NOMINAL, each) for each in data]


@pytest.fixture(scope="module")
def batched(data):
    """Return fits of the three, of one that is not finite, and of one of three poses, compiled side by side with the
    units that they start from."""
    spoilt = eqx.tree_at(lambda d: d.poses.accelerometer_mean, data[1], np.full((POSES, 3), np.nan))
    start = jax.tree.map(lambda leaf: np.stack([leaf] * 5), NOMINAL)
    return jax.jit(jax.vmap(jaximu.fit))(start, jaximu.stack([*data, spoilt, data_of(33, poses=3)]))


def test_a_fit_can_be_compiled_with_what_it_starts_from(hosts, batched):
    fit = jax.tree.map(lambda leaf: leaf[0], batched)
    assert off(fit, hosts[0]) < 1e-9
    np.testing.assert_allclose(fit.excess, hosts[0].excess, rtol=1e-9, atol=1e-12)
    assert float(np.max(np.abs(fit.covariance / hosts[0].covariance - 1))) < 1e-2  # taken anew where the fit ended
    assert fit.converged
    assert fit.finite
    assert fit.imu.accelerometer.gain.shape == (3, 3)


def test_units_side_by_side_are_what_each_is_alone(hosts, batched):
    """One that is not finite, and one of three poses, leave the others as they are."""
    fits = batched
    assert max(off(jax.tree.map(lambda leaf, k=k: leaf[k], fits), hosts[k]) for k in range(3)) < 1e-9
    assert fits.converged.tolist()[:3] == [True, True, True]
    assert fits.finite.tolist() == [True, True, True, False, True]
    assert not fits.converged[3]
    assert np.all(np.isfinite(fits.values[4]))
    assert fits.sigmas()[4].max() > 100 * fits.sigmas()[0].max()  # three poses tell little, and it says so


def test_derivatives_of_a_fit_are_right(data, hosts):
    """By gravity, a pose's force, one sample of the gyroscope and what is known of a number; reverse as forward."""
    name, width = hosts[0].names[0], float(hosts[0].sigmas()[0])

    def values(change):
        gravity, force, sample, mean = change
        fields = (
            data[0].gravity + gravity,
            jnp.asarray(data[0].poses.accelerometer_mean).at[3, 1].add(force),
            jnp.asarray(data[0].turns.output).at[4, 20, 2].add(sample),
        )
        moved = eqx.tree_at(lambda d: (d.gravity, d.poses.accelerometer_mean, d.turns.output), data[0], fields)
        prior = jaximu.Prior((name,), (hosts[0].values[0] + mean)[None], np.eye(1) / width)
        return jaximu.fit(NOMINAL, moved, prior=prior, excess=EXCESS, estimate_excess=False).values

    weights = np.random.default_rng(0).normal(size=len(hosts[0].values))

    @jax.jit
    def both_ways(change):
        at, along = jax.linearize(values, change)
        reverse = jax.linear_transpose(along, change)(jnp.asarray(weights))[0]
        return at, jax.vmap(along, out_axes=1)(jnp.eye(4)), reverse

    none = jnp.zeros(4)
    _, forward, reverse = both_ways(none)
    # second derivatives of the residuals are left out, which weigh by what data and prior leave
    for place, most in enumerate((1e-7, 1e-4, 1e-3, 1e-4)):
        step = none.at[place].set(1e-4)
        slope = (both_ways(step)[0] - both_ways(-step)[0]) / 2e-4
        assert float(np.max(np.abs(forward[:, place] - slope)) / np.max(np.abs(slope))) < most
    np.testing.assert_allclose(reverse, weights @ forward, rtol=1e-12)
    assert 0.2 < forward[0, 3] < 0.9  # as much as it weighs beside the data


def test_what_a_user_writes_of_logs():
    """Observed, stacked and fitted, from recordings of different length and with no gyroscope."""
    logs = [recording(seed, poses=poses)[0] for seed, poses in ((1, 12), (2, 14))]
    data = [jaximu.observe(log, GRAVITY) for log in logs]
    assert float(data[0].gravity) == GRAVITY
    many = jaximu.stack(data)
    assert many.turns.output.shape[0] == 2
    fit = jaximu.fit(NOMINAL, data[0])
    calibration = jaximu.calibrate(logs[0], GRAVITY)
    assert off(fit, calibration.fit) < 1e-6
    alone = jaximu.observe(jaximu.Recording(logs[0].accelerometer), GRAVITY)
    found = jaximu.fit(NOMINAL, alone)
    assert {name.owner for name in found.names} == {"accelerometer"}
    with pytest.raises(jaximu.InputError, match="stack those alike"):
        jaximu.stack([data[0], alone])
    with pytest.raises(jaximu.InputError, match="nothing to stack"):
        jaximu.stack([])
    with pytest.raises(jaximu.InputError, match="has no gyroscope and others have"):
        jaximu.observe([logs[0], jaximu.Recording(logs[0].accelerometer)], GRAVITY)


def test_free_numbers_can_be_chosen_under_a_trace():
    def bias(name: Name) -> bool:
        return name.owner == "accelerometer" and name.part == "bias"

    unit = replace(NOMINAL, accelerometer=replace(NOMINAL.accelerometer, bias=np.array([0.1, -0.2, 0.15])))
    data = jaximu.observe(jaximu.Recording(recording(1, imu=unit)[0].accelerometer), GRAVITY)

    def fitted(excess):  # which alone is traced
        return jaximu.fit(NOMINAL, data, bias, excess=excess, estimate_excess=False)

    host, traced = fitted(EXCESS), jax.jit(fitted)(EXCESS)
    assert len(host.names) == 3
    assert off(traced, host) < 1e-9
    np.testing.assert_array_equal(traced.imu.accelerometer.gain, np.eye(3))


def test_effects_need_samples(data):
    unit = NOMINAL.with_effects(jaximu.CATALOGUE["accel.asymmetry"].dormant())
    with pytest.raises(jaximu.InputError, match=r"accel.asymmetry cannot be fitted.*samples=True"):
        jaximu.fit(unit, data[0])
    log = recording(1)[0]
    with pytest.raises(jaximu.InputError, match="no gyroscope, without which no effect can be fitted"):
        jaximu.observe(jaximu.Recording(log.accelerometer), GRAVITY, samples=True)


@pytest.fixture(scope="module")
def with_effects():
    """Return a unit of two effects to be fitted, and the data of three logs with their samples, which differ in length,
    in rate, in whether vibration stands out, in whether both sensors share their stamps; the last log, too."""
    names = "accel.quadratic", "gyro.g_sensitivity"
    unit = NOMINAL.with_effects(*(jaximu.CATALOGUE[name].dormant() for name in names))
    logs = [recording(seed, poses=poses)[0] for seed, poses in ((1, 12), (2, 14))]
    log, random = recording(3, poses=12, rates=(50.0, 80.0))[0], np.random.default_rng(3)
    shaken = log.accelerometer.values + 0.3 * random.normal(size=(len(log.accelerometer), 1)) * np.array(
        [0.5, 1.0, 0.2]
    )
    rests = segment(log).intervals
    still = ((log.accelerometer.time[:, None] > rests[:, 0]) & (log.accelerometer.time[:, None] < rests[:, 1])).any(1)
    values = np.where(still[:, None], log.accelerometer.values, shaken)
    logs.append(replace(log, accelerometer=replace(log.accelerometer, values=values)))
    return jax.tree.map(np.asarray, unit), [jaximu.observe(log, GRAVITY, samples=True) for log in logs], logs[-1]


def test_effects_are_fitted_under_a_trace_and_side_by_side(with_effects):
    """As on the host, one unit alone."""
    unit, data, _ = with_effects
    assert [each.samples[0].recorded.shaken is not None for each in data] == [False, False, True]
    alone = [jaximu.fit(unit, each) for each in data]
    many = jaximu.stack(data)
    traced = jax.jit(jax.vmap(lambda each: jaximu.fit(unit, each)))(many)
    together = jaximu.fit(jax.tree.map(lambda leaf: np.stack([leaf] * 3), unit), many)
    for fits in (traced, together):
        assert fits.converged.all()
        assert max(off(jax.tree.map(lambda leaf, k=k: leaf[k], fits), alone[k]) for k in range(3)) < 1e-9


@pytest.mark.slow  # as without effects above
def test_derivatives_of_a_fit_with_effects_are_right(with_effects):
    """By gravity and what is known of a coefficient, changed together."""
    unit, data, _ = with_effects
    alone = jaximu.fit(unit, data[0])
    place = next(k for k, name in enumerate(alone.names) if name.part == "coefficients")
    width = float(alone.sigmas()[place])

    def values(share):
        prior = jaximu.Prior((alone.names[place],), width * share[None], np.eye(1) / width)
        moved = eqx.tree_at(lambda each: each.gravity, data[0], data[0].gravity + 1e-4 * share)
        return jaximu.fit(unit, moved, prior=prior, excess=EXCESS, estimate_excess=False).values

    slope = values(np.array(0.5)) - values(np.array(-0.5))
    forward = jax.jit(jax.jacfwd(values))(jnp.array(0.0))
    assert float(np.max(np.abs((forward - slope) / alone.sigmas()))) < 1e-4
    assert 0.2 < forward[place] / width < 0.9


def test_what_shakes_one_of_two_units_is_told_of_that_one(with_effects):
    _, (still, _, shaken), log = with_effects
    rectified = NOMINAL.with_effects(jaximu.CATALOGUE["accel.vibration_rectification"].dormant())
    with pytest.raises(jaximu.InputError, match="vibration"):
        jaximu.fit(rectified, still)
    both = jaximu.fit(jax.tree.map(lambda leaf: np.stack([leaf] * 2), rectified), jaximu.stack([still, shaken]))
    place = next(k for k, name in enumerate(both.names) if name.part == "coefficients")
    assert both.sigmas()[0, place] > 10 * both.sigmas()[1, place]  # nothing shook the first
    with pytest.raises(jaximu.InputError, match="number of recordings"):
        jaximu.stack([still, jaximu.observe([log, log], GRAVITY, samples=True)])


def test_vibration_is_the_mean_square_over_a_window():
    """Against a convolution, about both ends and with padding."""
    random = np.random.default_rng(1)
    for count, window in ((400, 12), (401, 13)):
        log = recording(1, poses=3)[0]
        force = random.normal(size=(count, 3)) + 9.0
        known = replace(Recorded.of(log), real=np.arange(count) < count - 20, window=np.int64(window))
        kernel = np.ones(window) / window
        used = force * known.real[:, None]
        smooth = np.stack([np.convolve(axis, kernel, "same") for axis in used.T], 1)
        square = np.sum((known.real[:, None] * (force - smooth)) ** 2, 1)
        np.testing.assert_allclose(known.vibration(force), np.convolve(square, kernel, "same"), atol=1e-11)


def test_residuals_take_what_effects_need(with_effects):
    """Given the stimulus they take off what effects add, and without it say what is missing."""
    _, data, _ = with_effects
    effects = (
        jaximu.CATALOGUE["accel.warm_up"].make(0.1, time_constant=30.0),
        jaximu.CATALOGUE["gyro.warm_up"].make(1e-3, time_constant=30.0),
    )
    unit, poses, turns = NOMINAL.with_effects(*effects), data[0].poses, data[0].turns
    middle = Stimulus(time=(poses.start + poses.stop) / 2)
    inside = Stimulus(time=poses.stop[:-1, None] + np.cumsum(turns.interval, axis=1))
    bare = eqx.tree_at(
        lambda d: (d.poses.accelerometer_mean, d.turns.output),
        data[0],
        (
            poses.accelerometer_mean - np.asarray(effects[0].term(middle)),
            turns.output - np.asarray(effects[1].term(inside)),
        ),
    )
    ones, square = np.ones(len(poses.mask)), np.tile(np.eye(2), (len(turns.mask), 1, 1))
    for with_them, without in (
        (gravity_norm(unit, data[0], ones, middle), gravity_norm(NOMINAL, bare, ones)),
        (
            gravity_direction(unit, data[0], None, square, stimulus=middle, during=inside),
            gravity_direction(NOMINAL, bare, None, square),
        ),
    ):
        np.testing.assert_allclose(with_them, without, atol=1e-12)
    with pytest.raises(jaximu.InputError, match="time"):
        gravity_norm(unit, data[0], ones)


def test_what_effects_add_in_one_recording_leaves_the_turns_of_another():
    """The columns of an effect of the gyroscope are what the conditions change by, over both recordings."""
    logs = [recording(seed, poses=12)[0] for seed in (1, 2)]
    data = jaximu.observe(logs, GRAVITY, samples=True)
    kind = jaximu.CATALOGUE["gyro.g_sensitivity"]
    numbers, none = kind.typical * np.linspace(0.2, 1.0, kind.size), np.zeros(kind.size)
    unit = jaximu.calibrate(logs, GRAVITY).imu.with_effects()

    def conditions(change):
        moved = unit.with_effects(kind.make(numbers + change))
        seen = data.along(moved, tuple(moved.all_effects().values())).condensed.conditions
        return np.asarray(jax.tree.map(lambda leaf: np.asarray(leaf[0]), seen)(unit))

    lifted = jax.tree.map(lambda leaf: np.asarray(leaf)[None], unit.with_effects(kind.make(numbers)))
    columns = data.about(lifted).columns[0]
    for place in range(kind.size):
        step = none.copy()
        step[place] = 0.1 * kind.typical
        slope = (conditions(step) - conditions(-step)) / (0.2 * kind.typical)
        assert np.max(np.abs(columns[:, place] - slope)) < 2e-2 * np.max(np.abs(slope))


def test_another_solver_finds_the_same(data):
    """Of a problem of one's own; single precision is refused where computing begins."""
    parameters = jaximu.Parameters.select(NOMINAL, lambda name: name.owner == "gyroscope" and name.part == "bias")
    weights = np.full((POSES, 3, 3), np.eye(3) * 1e4)
    problem = jaximu.Problem(
        NOMINAL, parameters, data[0], lambda imu, seen: static_gyroscope(imu, seen, weights), tolerance=1e3
    )
    ours = jaximu.solve(problem, jnp.zeros(3))
    solver = optx.GaussNewton(rtol=1e-9, atol=1e-9)
    other = jaximu.solve(problem, jnp.zeros(3), solver=solver)
    assert other.converged
    np.testing.assert_allclose(other.z, ours.z, rtol=0, atol=1e-9)
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.raises(jaximu.InputError, match="double precision"):
            jaximu.solve(problem, jnp.zeros(3))
    finally:
        jax.config.update("jax_enable_x64", True)


def test_what_is_host_by_nature_says_so():
    log = recording(1)[0]

    def observed(values):
        return segment(replace(log, accelerometer=replace(log.accelerometer, values=values))).intervals

    with pytest.raises(jaximu.InputError, match=r"cannot be traced.*observe"):
        jax.jit(observed)(log.accelerometer.values)

    def simulated_output(bias):
        unit = eqx.tree_at(lambda imu: imu.accelerometer.bias, NOMINAL, bias)
        return jaximu.simulate(unit, HandHeld(3, 1.0))[0].accelerometer.values

    with pytest.raises(jaximu.InputError, match=r"traced cannot be simulated.*Imu.respond"):
        jax.jit(simulated_output)(jnp.zeros(3))


def test_any_least_squares_solver_of_optimistix_ends_where_ours_does(data, hosts):
    fit = jaximu.fit(NOMINAL, data[0], solver=optx.Dogleg(rtol=1e-9, atol=1e-9))
    assert fit.converged
    assert off(fit, hosts[0]) < 1e-6
    assert int(fit.steps) != int(hosts[0].steps)


def test_a_solver_that_does_not_converge_says_so(data):
    """Steps a millionth as long as they should be: it is this solver that is used."""
    fit = jaximu.fit(NOMINAL, data[0], solver=optx.GradientDescent(learning_rate=1e-6, rtol=1e-9, atol=1e-9))
    assert not fit.converged


# --- what a unit's numbers go through, function by function -----------------------------------------------------------

_RANDOM = np.random.default_rng(40)
_STIMULUS = jaximu.Stimulus(
    specific_force=jnp.asarray(_RANDOM.normal(0, 6, (20, 3))), angular_rate=jnp.asarray(_RANDOM.normal(0, 2, (20, 3))),
    time=jnp.arange(20) / 50.0, temperature=jnp.linspace(20.0, 30.0, 20),
)  # fmt: skip
_OUTPUTS = _STIMULUS.specific_force, _STIMULUS.angular_rate
_EFFECTS = [
    CATALOGUE[name].make(10 * CATALOGUE[name].typical)
    for name in ("accel.quadratic", "accel.temperature", "gyro.g_sensitivity", "gyro.lag", "gyro.warm_up")
]


def _norm(imu, data):
    return gravity_norm(imu, data, jnp.ones(len(data.poses.mask)))


def _direction(imu, data):
    return gravity_direction(imu, data, None, jnp.ones((len(data.turns.mask), 2, 2)))


def _whitened(imu, data):
    conditions, covariance, *_ = condense(imu, data)
    return covariance.weights(jnp.asarray(EXCESS)).whiten(conditions(imu))


TRACEABLE = {
    "Imu.respond": lambda imu, data: imu.with_effects(*_EFFECTS).respond(_STIMULUS),
    "Imu.recover": lambda imu, data: imu.recover(data.poses.accelerometer_mean, data.poses.gyroscope_mean),
    "Imu.recover with effects": lambda imu, data: imu.with_effects(*_EFFECTS).recover(*_OUTPUTS, _STIMULUS),
    "sensitivity": lambda imu, data: sensitivity(imu, np.arange(24), _STIMULUS),
    "output_error": lambda imu, data: output_error(NOMINAL, imu, _STIMULUS),
    "gravity_norm": _norm,
    "gravity_direction": _direction,
    "static_gyroscope": lambda imu, data: static_gyroscope(imu, data, jnp.ones((len(data.poses.mask), 3, 3))),
    "turned_by": lambda imu, data: turned_by(imu.gyroscope, data.turns),
    "whitening": _whitened,
}  # fmt: skip


def test_every_piece_of_the_way_is_compiled_batched_and_differentiated(data):
    few = jax.tree.map(jnp.asarray, data[2])

    def numbers(name):
        """Return a piece as a function of a unit that gives all its numbers in a row."""
        return lambda imu: ravel_pytree(eqx.filter(TRACEABLE[name](imu, few), eqx.is_inexact_array))[0]

    units = [jax.tree.map(jnp.asarray, simulated(seed).imu) for seed in (30, 31)]
    random = np.random.default_rng(41)
    direction = jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape)), units[0])
    units += [jax.tree.map(lambda a, b, step=step: a + step * b, units[0], direction) for step in (1e-5, -1e-5)]
    expected = {name: np.stack([numbers(name)(unit) for unit in units[:2]]) for name in TRACEABLE}
    scale = {name: np.abs(each[0]).max() for name, each in expected.items()}
    share = {name: jnp.asarray(random.normal(size=each.shape[1])) / scale[name] for name, each in expected.items()}

    @jax.jit
    @jax.vmap
    def both_ways(unit):
        """By piece all numbers, and how a sum of them changes along a direction: forward, and by the gradient."""
        ways = {}
        for name, part in share.items():
            found, change = jax.jvp(numbers(name), (unit,), (direction,))
            gradient = jax.vjp(numbers(name), unit)[1](part)[0]
            ways[name] = found, part @ change, ravel_pytree(gradient)[0] @ ravel_pytree(direction)[0]
        return ways

    for name, (found, forward, reverse) in both_ways(jax.tree.map(lambda *leaves: jnp.stack(leaves), *units)).items():
        wanted = expected[name]
        assert np.all(np.isfinite(wanted)), name
        assert np.abs(wanted[0] - wanted[1]).max() > 1e-9 * scale[name], name
        np.testing.assert_allclose(found[:2], wanted, atol=1e-11 * scale[name], err_msg=name)
        np.testing.assert_allclose(reverse, forward, rtol=1e-10, atol=1e-12, err_msg=name)
        difference = float(share[name] @ (found[2] - found[3])) / 2e-5
        assert float(forward[0]) == pytest.approx(difference, rel=1e-5, abs=1e-7), name


def test_data_move_with_the_samples():
    """As if the recording had been another one: a sample in a pose, and one in a turn, of each triad."""
    log = recording(1, poses=12)[0]
    data = jaximu.observe(log, GRAVITY, samples=True)
    part = data.samples[0]
    changes = {name: np.zeros(np.shape(values)) for name, values in part.outputs.items()}
    places = [np.flatnonzero(np.asarray(part.pose["gyroscope"]) == 3)[7], np.asarray(part.sample)[4, 20]]
    signals = {name: log.signals[name].values.copy() for name in changes}
    for number, place in enumerate(places):
        for name, values in signals.items():
            changes[name][place] = 1e-4 * (1 + np.arange(3)) * (1 + number)
            values[place] += changes[name][place]
    other = replace(log, **{name: replace(log.signals[name], values=values) for name, values in signals.items()})
    wanted, moved = jaximu.observe(other, GRAVITY, samples=True), data.moved([changes])
    for where in (
        lambda d: d.poses.accelerometer_mean,
        lambda d: d.poses.gyroscope_mean,
        lambda d: d.turns.output,
        lambda d: d.samples[0].outputs,
    ):
        for one, two, before in zip(*(jax.tree.leaves(where(d)) for d in (moved, wanted, data)), strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-12)
            assert np.any(np.asarray(one) != before)
