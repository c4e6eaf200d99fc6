"""The covariance of the conditions is what Monte Carlo finds, and a planted excess is found again."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.signal
import scipy.stats
from synthetic import GRAVITY, POSES, recording, simulated, unit

from jaximu.calibration import calibrate
from jaximu.data.poses import condense
from jaximu.data.poses_covariance import condition_covariance, sensitivities, turned_by
from jaximu.estimation.covariance import Covariance, Weights, inverse_cholesky, update_excess
from jaximu.model import Noise
from jaximu.model.noise_model import AxisNoise, NoiseModel
from jaximu.model.processes import BiasInstability, White
from jaximu.recordings.observations import SlowNoise
from jaximu.recordings.recording import Recording, Signal
from jaximu.recordings.segmentation import Segmentation, observed_poses

chain_of = jax.jit(condition_covariance)


@jax.jit
def covariance_of(imu, data):
    return condition_covariance(imu, data).dense()


NONE = jnp.zeros(3)


@partial(jax.jit, static_argnums=1)
def draw(key, draws, imu, data, accelerometer, turns):
    factor = jnp.sqrt(accelerometer) * jnp.linalg.cholesky(data.poses.accelerometer_covariance)
    density = jnp.sqrt(turns) * jnp.linalg.cholesky(data.turns.noise)
    used = data.turns.interval > 0
    over = jnp.where(used, 1 / jnp.sqrt(jnp.where(used, data.turns.interval, 1.0)), 0.0)

    def one(key):
        first, second = jax.random.split(key)
        mean = jnp.einsum("pij,pj->pi", factor, jax.random.normal(first, (POSES, 3)))
        white = over[..., None] * (jax.random.normal(second, data.turns.output.shape) @ density.T)
        noisy = eqx.tree_at(
            lambda d: (d.poses.accelerometer_mean, d.turns.output),
            data,
            (data.poses.accelerometer_mean + mean, data.turns.output + white),
        )
        return condense(imu, noisy)[0](imu)[: 3 * POSES - 2]

    return jax.lax.map(one, jax.random.split(key, draws), batch_size=100)


def drawn(case, draws, seed, accelerometer=1.0, turns=1.0):
    """The conditions at the truth under noise drawn from the stated covariances, times the given variances."""
    return np.asarray(draw(jax.random.key(seed), draws, case.imu, case.observations, accelerometer, turns))


@pytest.fixture(scope="module")
def case():
    return simulated(21, poses=10, noise=0.0)


def test_covariance_of_the_conditions(case):
    draws = 6000
    covariance = covariance_of(case.imu, case.observations)
    used = (np.asarray(covariance.used) > 0)[: -3 * POSES]  # norms and turns
    assert used.sum() == 10 + 2 * 9
    values = drawn(case, draws, 0)
    np.testing.assert_array_equal(values[:, ~used], 0.0)
    joint = len(used)
    claimed = np.asarray(covariance.total(NONE))[:joint, :joint][np.ix_(used, used)]
    empirical = np.cov(values[:, used].T)
    # whitened by the claimed covariance the empirical one is a Wishart matrix around the identity: its eigenvalues lie
    # within (1 ± sqrt(n / draws))², its relative Frobenius distance is sqrt((n + 1) / draws)
    weights = np.asarray(inverse_cholesky(jnp.asarray(claimed)))
    white = weights @ empirical @ weights.T
    edge = np.sqrt(len(white) / draws)
    eigenvalues = np.linalg.eigvalsh(white)
    assert eigenvalues[0] > (1 - edge) ** 2 - 0.02
    assert eigenvalues[-1] < (1 + edge) ** 2 + 0.02
    assert np.linalg.norm(white - np.eye(len(white))) / np.sqrt(len(white)) < 1.2 * np.sqrt((len(white) + 1) / draws)
    # neighbours that share a pose are truly correlated: leaving that out would not pass
    blind = np.diag(np.diag(claimed))
    weights = np.asarray(inverse_cholesky(jnp.asarray(blind)))
    assert np.linalg.eigvalsh(weights @ empirical @ weights.T)[-1] > 1.3
    # to first order the mean is zero: a mean of second order only
    assert np.abs(values[:, used].mean(axis=0) / np.sqrt(np.diag(claimed))).max() < 5 / np.sqrt(draws)


def test_parts_of_the_covariance(case):
    data = case.observations
    covariance = covariance_of(case.imu, data)
    size = jnp.array([0.5, 2.0, 3.0])
    parts = [np.asarray(covariance.component(number)) for number in range(covariance.components)]
    expected = covariance.measured + np.einsum("k,kij->ij", size, parts) + np.diag(1 - covariance.used)
    np.testing.assert_allclose(covariance.total(size), expected, rtol=1e-12, atol=1e-22)
    for part in (np.asarray(covariance.measured), *parts):
        np.testing.assert_allclose(part, part.T, atol=1e-20)
        np.testing.assert_array_equal(part * (1 - covariance.used), 0.0)
    np.testing.assert_array_equal(parts[1][:POSES], 0.0)  # turns do not enter norms
    # an excess is the mean measured covariance in every real pose
    rest = np.arange(len(covariance.used) - 3 * POSES, len(covariance.used)).reshape(POSES, 3)[:10]
    measured = np.asarray(data.poses.gyroscope_covariance)[:10]
    for rows, own in zip(rest, measured, strict=True):
        np.testing.assert_allclose(np.asarray(covariance.measured)[np.ix_(rows, rows)], own, rtol=1e-12)
        np.testing.assert_allclose(parts[2][np.ix_(rows, rows)], measured.mean(axis=0), rtol=1e-12, atol=1e-22)


def test_excess_is_found_again(case):
    """Noise of three times the stated variance in the poses and five times in the turns: excess 2 and 4."""
    whole = chain_of(case.imu, case.observations)
    joint = len(whole.used) - 3 * POSES  # norms and turns; of means at rest there are no rows
    chain = whole.of_rows(whole.used * (np.arange(len(whole.used)) < joint))
    # as if parameters had been fitted: any Jacobian will do, residuals are projected off it
    jacobian = jnp.asarray(np.random.default_rng(0).standard_normal((len(chain.used), 10))) * chain.used[:, None]
    information = jacobian.T @ jacobian

    @jax.jit
    @jax.vmap
    def iterate(conditions, excess):
        weights = chain.weights(excess)
        residual = weights.whiten(jnp.pad(conditions, (0, 3 * POSES)))
        residual = residual - jacobian @ jnp.linalg.solve(information, jacobian.T @ residual)
        return update_excess([chain], [weights], residual, jacobian, information, excess)

    def found(values, rounds=8):
        excess = jnp.tile(jnp.array([1.0, 1.0, 0.0]), (len(values), 1))
        for _ in range(rounds):
            excess = iterate(jnp.asarray(values), excess)
        return np.asarray(excess)[:, :2]

    noisy = found(drawn(case, 100, 1, accelerometer=3.0, turns=5.0))
    assert np.all(noisy >= 0)
    spread = noisy.std(axis=0) / np.sqrt(len(noisy))
    np.testing.assert_array_less(np.abs(noisy.mean(axis=0) - [2.0, 4.0]), 3.5 * spread + [0.1, 0.2])
    honest = found(drawn(case, 100, 2))
    assert np.median(honest, axis=0).max() < 0.3


def scored(covariance, weights, residual, jacobian, excess):
    """One improvement of the excess; residual and Jacobian are whitened."""
    return update_excess([covariance], [weights], residual, jacobian, jacobian.T @ jacobian, jnp.asarray(excess))


@pytest.mark.parametrize("left_out", [(), (3, POSES + 4, POSES + 5, POSES + 8)])
def test_a_chain_does_what_the_whole_matrix_does(case, left_out):
    chain = chain_of(case.imu, case.observations)
    chain = chain.of_rows(np.asarray(chain.used) * ~np.isin(np.arange(len(chain.used)), left_out))
    dense, size, excess = chain.dense(), len(chain.used), jnp.array([0.3, 0.7, 0.2])
    weights, whole = chain.weights(excess), dense.weights(excess)
    np.testing.assert_allclose(chain.dense().total(excess), dense.total(excess), rtol=1e-12)
    root = np.asarray(weights.whiten(jnp.eye(size)))
    np.testing.assert_allclose(root @ np.asarray(dense.total(excess)) @ root.T, np.eye(size), atol=1e-10)
    np.testing.assert_allclose(weights.back(jnp.eye(size)), root.T, rtol=1e-12, atol=1e-9 * np.abs(root).max())
    for number in range(chain.components):
        known = np.asarray(dense.component(number))
        found = chain.spread(number, jnp.eye(size))
        np.testing.assert_allclose(found, known, rtol=1e-10, atol=1e-12 * np.abs(known).max())
    for one, other in zip(chain.traces(excess, weights), dense.traces(excess, whole), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    random = np.random.default_rng(6)
    rows = jnp.asarray(random.standard_normal((size, 13))) * chain.used[:, None]
    found = [scored(kind, root, root.whiten(rows[:, 0]), root.whiten(rows[:, 1:]), excess)
             for kind, root in ((chain, weights), (dense, whole))]  # fmt: skip
    np.testing.assert_allclose(*found, rtol=1e-8)


def test_a_part_without_rows_stays_as_it_is():
    covariance = Covariance(jnp.eye(6), (jnp.eye(6), jnp.zeros((6, 6))), jnp.ones(6), jnp.zeros(6, int))
    excess = scored(covariance, Weights(jnp.eye(6)), jnp.ones(6), jnp.eye(6)[:, :2], [1.0, 7.0])
    assert excess[1] == 7.0
    assert np.isfinite(excess[0])


def test_diagonal_components_are_scored_as_any_others():
    random = np.random.default_rng(3)
    residual, jacobian = jnp.asarray(random.standard_normal(8)), jnp.asarray(random.standard_normal((8, 2)))
    root, roots = jnp.asarray(np.tril(random.standard_normal((8, 8)))), jnp.asarray(random.uniform(0, 1, (2, 8)))

    def found(*factors):
        covariance = Covariance(jnp.eye(8), factors, jnp.ones(8), jnp.zeros(8, int))
        return scored(covariance, Weights(root), residual, jacobian, jnp.ones(2))

    np.testing.assert_allclose(found(*roots), found(*map(jnp.diag, roots)), rtol=1e-9)
    whole = jnp.asarray(random.standard_normal((8, 3)))
    np.testing.assert_allclose(found(roots[0], whole), found(jnp.diag(roots[0]), whole), rtol=1e-9)


def test_independent_conditions_are_scored_as_any_others():
    random = np.random.default_rng(4)
    residual, jacobian = jnp.asarray(random.standard_normal(8)), jnp.asarray(random.standard_normal((8, 2)))
    variances, roots = jnp.asarray(random.uniform(1, 2, 8)), tuple(jnp.asarray(random.uniform(0, 1, (2, 8))))
    both = [Covariance(each, roots, jnp.ones(8), jnp.zeros(8, int)) for each in (variances, jnp.diag(variances))]
    weights = [each.weights(jnp.array([0.5, 2.0])) for each in both]
    np.testing.assert_allclose(weights[1].root, np.diag(weights[0].root), rtol=1e-12)
    for turned in (lambda each: each.whiten(jacobian), lambda each: each.back(residual)):
        np.testing.assert_allclose(*map(turned, weights), rtol=1e-12)
    found = [scored(kind, each, residual, jacobian, jnp.ones(2)) for kind, each in zip(both, weights, strict=True)]
    np.testing.assert_allclose(*found, rtol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_a_component_at_zero_does_not_hold_the_others_off_their_maximum(seed):
    """Against the bounded maximum of the restricted likelihood, by SciPy, of two components that share rows."""
    random = np.random.default_rng(seed)
    rows = 40
    jacobian = random.standard_normal((rows, 3))
    roots = random.uniform(0.2, 1.5, (2, rows))
    covariance = Covariance(jnp.ones(rows), tuple(jnp.asarray(roots)), jnp.ones(rows), jnp.zeros(rows, int))
    # the first component has less than no scatter, the second some
    conditions = random.standard_normal(rows) * np.sqrt(1 + 0.8 * roots[1] ** 2) * np.where(roots[0] > 0.9, 0.5, 1.0)

    def white(excess):
        weights = covariance.weights(excess)
        return weights, weights.whiten(jnp.asarray(conditions)), weights.whiten(jnp.asarray(jacobian))

    def lost(excess):
        _, residual, slope = (np.asarray(each.root if hasattr(each, "root") else each) for each in white(excess))
        square = slope.T @ slope
        left = residual - slope @ np.linalg.solve(square, slope.T @ residual)
        return left @ left + np.sum(np.log(1 + roots.T**2 @ excess)) + np.linalg.slogdet(square)[1]

    best = scipy.optimize.minimize(lost, [1.0, 1.0], bounds=[(0, None)] * 2, tol=1e-12).x
    excess = jnp.ones(2)
    for _ in range(60):
        weights, residual, slope = white(excess)
        residual = residual - slope @ jnp.linalg.solve(slope.T @ slope, slope.T @ residual)
        excess = scored(covariance, weights, residual, slope, excess)
    assert best[0] == 0.0
    np.testing.assert_allclose(excess, best, atol=1e-4)


# --- slow bias -------------------------------------------------------------------------------------------------------

_RATE = 50.0


def bank(white, sigma, time):
    return AxisNoise(
        np.full(3, white), np.zeros(3), np.tile(np.square(sigma), (3, 1)), np.asarray(time, float)
    )  # fmt: skip


_MODEL = NoiseModel(bank(1e-6, [1e-3, 2e-3], [3.0, 60.0]), bank(1e-8, [1e-4, 2e-4], [3.0, 60.0]))


def drawn_along_time(random, noise, draws, samples):
    """Noise (draws, samples, 3) at `_RATE`: white, and each Gauss–Markov process by its exact recursion."""
    total = np.sqrt(noise.white * _RATE) * random.standard_normal((draws, samples, 3))
    for place, time in enumerate(noise.correlation_time):
        decay = np.exp(-1 / (_RATE * time))
        drive = np.sqrt(1 - decay**2) * random.standard_normal((draws, samples, 3))
        drive[:, 0] /= np.sqrt(1 - decay**2)
        total += np.sqrt(noise.variance[:, place]) * scipy.signal.lfilter([1.0], [1.0, -decay], drive, axis=1)
    return total


@pytest.fixture(scope="module")
def tied():
    """A recording all but free of noise, its poses known, with the slow bias of `_MODEL` in its observations."""
    truth = unit(31)
    made, rests = recording(31, poses=8, rest=2.0, turn=1.2, rates=(_RATE, _RATE), density=(1e-16, 1e-20), imu=truth)
    part = Segmentation(made, rests, 1.0, {}, ())
    return truth, part, observed_poses(part, GRAVITY, bucket=(10, 64), noise=_MODEL)


@jax.jit
def derivatives(imu, data):
    """The conditions' derivatives by mean accelerometer outputs and by gyroscope samples, by differentiation."""

    def of(mean, output):
        changed = eqx.tree_at(lambda d: (d.poses.accelerometer_mean, d.turns.output), data, (mean, output))
        return condense(imu, changed)[0](imu)[: 3 * len(mean) - 2]

    return jax.jacrev(of, argnums=(0, 1))(data.poses.accelerometer_mean, data.turns.output)


@pytest.mark.parametrize("samples", [48, 5])
def test_sensitivities_are_the_derivatives(samples, monkeypatch):
    """By mean accelerometer outputs and by every gyroscope sample, also where one sample turns by half a radian.

    Of rates held over their samples: the reactions leave out that of coning, which the next test measures.
    """
    for module in ("ground.rotation", "data.preintegration"):
        monkeypatch.setattr(f"jaximu.{module}.rotation_vectors", lambda rates, times: rates * times[..., None])
    case = simulated(5, poses=10, noise=1.0, used_samples=samples)
    data, imu = case.observations, case.imu
    found = sensitivities(imu, data, turned_by(imu.gyroscope, data.turns))
    steps = len(data.turns.mask)

    by_mean, by_output = (np.asarray(each) for each in derivatives(imu, data))
    largest = np.abs(np.asarray(imu.gyroscope.recover(data.turns.output)) * data.turns.interval[..., None]).max()
    assert (largest > 0.5) == (samples == 5)
    expected = np.zeros_like(by_mean)
    pose, step = np.arange(POSES), np.arange(steps)
    expected[pose, pose] = found.norm
    turns = expected[POSES:].reshape(steps, 2, POSES, 3)
    turns[step, :, step + 1] = found.after
    turns[step, :, step] = found.before
    used = (np.asarray(condition_covariance(imu, data).used) > 0)[: len(expected)]
    np.testing.assert_array_equal(by_mean[~used], 0.0)
    np.testing.assert_allclose(by_mean[used], expected[used], atol=1e-12)
    expected = np.zeros((steps, 2, steps, *data.turns.output.shape[1:]))
    expected[step, :, step] = found.turn
    expected = expected.reshape(2 * steps, *expected.shape[2:])
    np.testing.assert_array_equal(by_output[:POSES], 0.0)
    np.testing.assert_allclose(by_output[POSES:][used[POSES:]], expected[used[POSES:]], atol=1e-12)


def test_reactions_to_gain_and_bias_but_for_coning():
    """A gain or a bias that is off changes the conditions as the reactions say, within a thousandth, coning and all."""
    case = simulated(5, poses=10, noise=1.0)
    data, imu = case.observations, case.imu
    found = sensitivities(imu, data, turned_by(imu.gyroscope, data.turns))
    output = np.asarray(data.turns.output)
    for change in (
        output @ np.random.default_rng(0).normal(0, 1, (3, 3)),
        np.broadcast_to([0.3, -1.0, 0.5], output.shape),
    ):
        change = change * (np.asarray(data.turns.interval) > 0)[..., None]

        def at(step, change=change):
            moved = eqx.tree_at(lambda d: d.turns.output, data, output + step * change)
            return condense(imu, moved)[0](imu)[: 3 * POSES - 2]

        exact = jax.jvp(at, (0.0,), (1.0,))[1][POSES:]
        ours = np.einsum("tasi,tsi->ta", found.turn, change).ravel() * np.repeat(np.asarray(data.turns.mask), 2)
        assert np.abs(ours - exact).max() < 1e-3 * np.abs(exact).max()


def test_covariance_with_slow_bias_drawn_along_time(tied):
    """Norms, turns and means at rest, against recordings of white noise and slow bias drawn sample by sample."""
    truth, part, data = tied
    draws, count = 2000, len(part.intervals)
    random = np.random.default_rng(0)
    signal = part.recording.gyroscope
    samples = len(signal)
    force, rate = (drawn_along_time(random, each, draws, samples) for each in (_MODEL.accelerometer, _MODEL.gyroscope))
    at = [(signal.time >= a) & (signal.time < b) for a, b in part.intervals]
    padded = len(data.poses.mask)
    mean_a, mean_g = np.zeros((2, draws, padded, 3))
    for k, inside in enumerate(at):
        mean_a[:, k], mean_g[:, k] = force[:, inside].mean(axis=1), rate[:, inside].mean(axis=1)
    output = np.zeros((draws, *data.turns.output.shape))
    for k in range(count - 1):
        inside = (signal.time >= part.intervals[k, 1]) & (signal.time < part.intervals[k + 1, 0])
        output[:, k, : inside.sum()] = rate[:, inside]

    def one(given):
        noisy = eqx.tree_at(
            lambda d: (d.poses.accelerometer_mean, d.poses.gyroscope_mean, d.turns.output),
            data,
            (
                data.poses.accelerometer_mean + given[0],
                data.poses.gyroscope_mean + given[1],
                data.turns.output + given[2],
            ),
        )
        return condense(truth, noisy)[0](truth)

    values = np.asarray(jax.jit(lambda z: jax.lax.map(one, z, batch_size=100))((mean_a, mean_g, output)))
    covariance = covariance_of(truth, data)
    used = np.asarray(covariance.used) > 0
    assert used.sum() == count + 2 * (count - 1) + 3 * count
    assert len(used) == padded + 2 * (padded - 1) + 3 * padded
    np.testing.assert_array_equal(values[:, ~used], 0.0)
    claimed = np.asarray(covariance.total(NONE))[np.ix_(used, used)]
    empirical = np.cov(values[:, used].T)

    def eigenvalues(claimed):
        weights = np.asarray(inverse_cholesky(jnp.asarray(claimed)))
        return np.linalg.eigvalsh(weights @ empirical @ weights.T)

    edge = np.sqrt(used.sum() / draws)
    found = eigenvalues(claimed)
    # four parts a turn, each with its mean bias, are all but exact
    assert found[0] > (1 - edge) ** 2 - 0.04
    assert found[-1] < (1 + edge) ** 2 + 0.06
    assert found.mean() == pytest.approx(1.0, abs=0.02)
    # kinds of conditions that are not tied to each other would not pass
    kinds = np.repeat([0, 1, 2], [count, 2 * (count - 1), 3 * count])
    assert eigenvalues(claimed * (kinds[:, None] == kinds))[-1] > 1.3 * (1 + edge) ** 2
    assert eigenvalues(np.diag(np.diag(claimed)))[-1] > 2 * (1 + edge) ** 2


def test_padding_and_parts_with_slow_bias(tied):
    truth, part, data = tied
    covariance = covariance_of(truth, data)
    padding = 1 - np.asarray(covariance.used)
    parts = [np.asarray(covariance.component(number)) for number in range(covariance.components)]
    for each in (covariance.measured, *parts):
        np.testing.assert_allclose(each, each.T, atol=1e-20)
        np.testing.assert_array_equal(np.asarray(each) * padding, 0.0)
        np.testing.assert_array_equal(np.asarray(each) * padding[:, None], 0.0)
    excess = jnp.array([0.5, 2.0, 3.0])
    total = np.asarray(covariance.total(excess))
    np.testing.assert_array_equal(total * padding, np.diag(padding))
    assert np.all(np.isfinite(np.linalg.cholesky(total)))
    expected = covariance.measured + np.einsum("k,kij->ij", excess, parts)
    np.testing.assert_allclose(total, np.asarray(expected) + np.diag(padding), rtol=1e-12)
    # an excess at rest is the mean covariance of the means at rest, in every pose, and in nothing else
    count, padded = len(part.intervals), len(data.poses.mask)
    first = padded + 2 * (padded - 1)
    mean = np.asarray(data.poses.gyroscope_covariance)[:count].mean(axis=0)
    np.testing.assert_array_equal(parts[2][:first], 0.0)
    rest = parts[2][first : first + 3 * count, first : first + 3 * count]
    np.testing.assert_allclose(rest, scipy.linalg.block_diag(*[mean] * count), rtol=1e-12)
    # padding in the ties themselves does not reach the conditions
    ties = np.array(data.slow.gyroscope)
    ties[:, count:padded, count:padded] = 1e6
    changed = eqx.tree_at(lambda d: d.slow.gyroscope, data, jnp.asarray(ties))
    np.testing.assert_array_equal(covariance_of(truth, changed).measured, covariance.measured)


def test_slow_noise_that_ties_nothing_changes_nothing(case):
    """The same variances as independent ones: the old matrix, and the means at rest beside it."""
    data = case.observations
    poses, turns = data.poses, data.turns
    axes = [jnp.asarray(np.stack([np.diag(np.diag(each)) for each in np.asarray(which)]))
            for which in (poses.accelerometer_covariance, poses.gyroscope_covariance)]  # fmt: skip
    plain = eqx.tree_at(lambda d: (d.poses.accelerometer_covariance, d.poses.gyroscope_covariance), data, tuple(axes))
    steps = len(turns.mask)
    force = np.stack([np.diag(np.asarray(axes[0])[:, axis, axis]) for axis in range(3)])
    rate = np.zeros((3, POSES + 4 * steps, POSES + 4 * steps))
    for axis in range(3):
        rate[axis, :POSES, :POSES] = np.diag(np.asarray(axes[1])[:, axis, axis])
    slow = SlowNoise(jnp.asarray(force), jnp.asarray(rate), jnp.zeros(turns.interval.shape, int))
    loose = eqx.tree_at(lambda d: d.slow, plain, slow, is_leaf=lambda leaf: leaf is None)
    before, after = covariance_of(case.imu, plain), covariance_of(case.imu, loose)
    np.testing.assert_allclose(after.measured, before.measured, rtol=1e-10, atol=1e-22)
    for one, other in zip(after.factors, before.factors, strict=True):
        np.testing.assert_array_equal(one.rows, other.rows)
        np.testing.assert_allclose(one.values, other.values, rtol=1e-12)
    size = POSES + 2 * steps
    real = np.asarray(poses.mask)
    rest = scipy.linalg.block_diag(*(each * use for each, use in zip(np.asarray(axes[1]), real, strict=True)))
    np.testing.assert_allclose(np.asarray(after.measured)[size:, size:], rest, rtol=1e-12)
    np.testing.assert_array_equal(np.asarray(after.measured)[size:, :size], 0.0)
    np.testing.assert_array_equal(after.used, before.used)


def flickering(seed):
    """A unit held still in 20 poses, whose flicker noise is many times its white noise over a pose, and the truth."""
    truth = unit(seed)
    made, _ = recording(seed, poses=20, rest=2.0, turn=1.2, rates=(_RATE, _RATE), density=(1e-12, 1e-16), imu=truth)
    force = Noise((White(1e-3), BiasInstability(3e-3, 100.0)), "specific_force")
    rate = Noise((White(1e-4), BiasInstability(3e-4, 100.0)), "angular_rate")
    count = len(made.accelerometer)
    signals = [
        Signal(each.time, each.values + noise.sample(count, _RATE, seed=seed), each.unit)
        for each, noise in ((made.accelerometer, force), (made.gyroscope, rate))
    ]
    times = force.processes[1].bank(1 / _RATE)
    sizes = np.sqrt(np.log(4) / np.pi) * np.ones(len(times))
    model = NoiseModel(bank(1e-6, 3e-3 * sizes, times), bank(1e-8, 3e-4 * sizes, times))
    return truth, Recording(*signals), model


def scores(calibration, truth):
    """Errors over claimed standard deviations: gyroscope biases, gyroscope gains, accelerometer biases and gains."""
    found = []
    for name, triad in calibration.triads().items():
        gain, bias = calibration.sigma(name)
        true = truth.triads()[name]
        free = gain > 0
        found.append((np.asarray(triad.bias) - np.asarray(true.bias)) / bias)
        found.append((np.asarray(triad.gain) - np.asarray(true.gain))[free] / gain[free])
    return [np.square(each).mean() for each in found]


def test_claimed_uncertainty_holds_with_flicker_where_its_model_is_given():
    """Coverage: squared errors over claimed variances are one in the mean with the model, not with white noise."""
    known, blind = [], []
    for seed in (40, 41, 42, 44, 45, 46, 47):  # of one padded shape
        truth, made, model = flickering(seed)
        known.append(scores(calibrate(made, static=model), truth))
        white = NoiseModel(*(AxisNoise.of_white(each.white) for each in (model.accelerometer, model.gyroscope)))
        blind.append(scores(calibrate(made, static=white), truth))
    known, blind = np.mean(known, axis=0), np.mean(blind, axis=0)
    draws = 7 * np.array([3, 6, 3, 9])
    # correlated numbers count for a third of so many
    low, high = (scipy.stats.chi2.ppf(p, draws / 3) / (draws / 3) for p in (0.001, 0.999))
    assert np.all(known > low) and np.all(known < high), (known, blind)
    assert blind[2] > 2 * high[2]  # the gyroscope's bias: all poses share the flicker
