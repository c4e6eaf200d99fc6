"""The sensor model: forward, exactly back, under every transformation; every effect asleep and awake."""

import functools
import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_effects import KNOWN
from scipy.spatial.transform import Rotation
from synthetic import GRAVITY, unit

from jaximu.ground.errors import InputError
from jaximu.model.effects import CATALOGUE, Effect
from jaximu.model.sensor import Imu, Triad
from jaximu.model.stimulus import Stimulus

SHAPES = ((), (1,), (3, 1, 2))
TERMS = [name for name in CATALOGUE if not name.startswith("setup.")]
SETUPS = [name for name in CATALOGUE if name.startswith("setup.")]
SEEN = [name for name in SETUPS if "magnetic_field" not in CATALOGUE[name].needs]
"""Errors of the set-up that accelerometer or gyroscope feel."""
INVERTIBLE = [name for name in TERMS if CATALOGUE[name].invertible]
respond, recover = eqx.filter_jit(Triad.respond), eqx.filter_jit(Triad.recover)
imu_respond = eqx.filter_jit(Imu.respond)


def stimulus(shape, seed=0) -> Stimulus:
    """Everything at random: any direction of gravity, rates up to some 250 °/s, a path of tens of seconds a step."""
    random = np.random.default_rng(seed)
    force, rate, acceleration = random.standard_normal((3, *shape, 3))
    force *= GRAVITY / np.linalg.norm(force, axis=-1, keepdims=True)
    attitude = random.standard_normal((*shape, 4))
    attitude /= np.linalg.norm(attitude, axis=-1, keepdims=True)
    step = random.uniform(20.0, 60.0, shape)
    true = Stimulus(
        specific_force=force,
        angular_rate=np.clip(2 * rate, -4.5, 4.5),
        angular_acceleration=acceleration,
        temperature=np.asarray(25 + 10 * random.standard_normal(shape)),
        temperature_rate=np.asarray(0.02 * random.standard_normal(shape)),
        time=np.asarray(60.0 + (np.cumsum(step, axis=-1) if shape else step)),
        attitude=attitude,
        vibration_power=np.asarray(random.uniform(0.5, 2.0, shape)),
        magnetic_field=25.0 * random.standard_normal((*shape, 3)),
        current=np.asarray(random.uniform(-3.0, 3.0, shape)),
    )
    return true if shape else jax.tree.map(jnp.asarray, true)  # NumPy's arrays without axes turn into scalars


def smooth_motion(count=240, interval=0.005) -> Stimulus:
    """A path of sums of sinusoids up to 1 Hz, every derivative analytic."""
    random = np.random.default_rng(11)
    time = 100.0 + interval * np.arange(count)
    frequency = 2 * np.pi * np.array([0.3, 0.7, 1.0])

    def waves(size, derivative=0):
        draw = np.random.default_rng([12, size])
        amplitude, phase = draw.uniform(-1, 1, (3, size)), draw.uniform(0, 6, (3, size))
        angle = frequency[:, None, None] * time[:, None] + phase[:, None, :] + derivative * np.pi / 2
        return np.sum(frequency[:, None, None] ** derivative * amplitude[:, None, :] * np.sin(angle), axis=0)

    turn = waves(5)[:, :3]
    return Stimulus(
        specific_force=GRAVITY * Rotation.from_rotvec(turn).inv().apply([0.0, 0.0, 1.0]) + waves(4)[:, :3],
        angular_rate=waves(3),
        angular_acceleration=waves(3, 1),
        temperature=30 + 5 * waves(1)[:, 0],
        temperature_rate=5 * waves(1, 1)[:, 0],
        time=time,
        attitude=Rotation.from_rotvec(turn).as_quat(scalar_first=True),
        vibration_power=random.uniform(0.5, 2.0, count),
    )


def awake(name, size=1.0, sign=1.0) -> Effect:
    """The effect with coefficients `size` times typical, of mixed signs."""
    kind = CATALOGUE[name]
    return kind.make(
        sign * size * np.asarray(kind.make(1.0).typical_sizes(1.0).coefficients) * (-1.0) ** np.arange(kind.size)
    )


def imu_with(names, size=0.0, seed=5) -> Imu:
    """A unit with effects, each where its name says that it belongs."""
    effects = {prefix: [awake(n, size) for n in names if n.startswith(prefix)]
               for prefix in ("accel", "gyro", "mag", "setup")}  # fmt: skip
    plain = unit(seed)
    compass = None
    if effects["mag"]:
        compass = Triad(
            plain.gyroscope.gain, 20.0 * plain.gyroscope.bias, tuple(effects["mag"]), "magnetic_field", "uT"
        )
    return Imu(
        replace(plain.accelerometer, effects=tuple(effects["accel"])),
        replace(plain.gyroscope, effects=tuple(effects["gyro"])),
        tuple(effects["setup"]),
        compass,
    )


def triad_with(names, size=0.0) -> Triad:
    imu = imu_with(names, size)
    return imu.triads()[CATALOGUE[names[0]].owner]


def sensed(triad, true):
    return getattr(true, triad.quantity)


def test_linear_model_by_hand():
    triad = Triad(jnp.array([[2.0, 0, 0], [0.1, 3, 0], [0, 0, 4]]), jnp.array([1.0, 0, -1]))
    output = respond(triad, Stimulus(jnp.array([1.0, 2, 3])))
    np.testing.assert_allclose(output, [3.0, 6.1, 11.0], atol=1e-15)
    np.testing.assert_allclose(recover(triad, output), [1.0, 2, 3], atol=1e-15)


def test_an_input_that_is_missing_is_named():
    for triad, words in zip(unit(1).triads().values(), ("specific force", "angular rate"), strict=True):
        with pytest.raises(InputError, match=words):
            triad.respond(replace(stimulus((2,)), **{triad.quantity: None}))


def test_input_effects_come_before_the_gain_and_output_effects_after():
    gain, bias = np.array([[2.0, 0.1, -0.2], [0.3, 3.0, 0.4], [-0.5, 0.6, 4.0]]), np.array([1.0, -2.0, 3.0])
    lag, ramp = np.array([1e-2, -2e-2, 3e-2]), np.array([0.1, 0.2, -0.3])
    effects = (CATALOGUE["gyro.bias_ramp"].make(ramp), CATALOGUE["gyro.lag"].make(lag))
    true = stimulus((4,))
    output = respond(Triad(gain, bias, effects, quantity="angular_rate", time_reference=40.0), true)
    for k in range(4):
        entering = true.angular_rate[k] - lag * true.angular_acceleration[k]
        np.testing.assert_allclose(output[k], gain @ entering + bias + ramp * (true.time[k] - 40.0), rtol=1e-14)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("quantity", ["accelerometer", "gyroscope"])
def test_round_trip_without_effects(quantity, shape):
    triad, true = getattr(unit(3), quantity), stimulus(shape)
    output = respond(triad, true)
    assert output.shape == (*shape, 3)
    np.testing.assert_allclose(recover(triad, output), sensed(triad, true), rtol=0, atol=1e-14)


# One compiled function does for all effects of a triad what each test looks at: one each takes minutes to compile.
def sizes(effects) -> np.ndarray:
    """The coefficients of effects, end to end."""
    return np.concatenate([np.asarray(effect.coefficients) for effect in effects])


def with_sizes(effects, flat) -> tuple[Effect, ...]:
    ends = np.cumsum([0, *(effect.size for effect in effects)])
    parts = [flat[start:stop] for start, stop in itertools.pairwise(ends)]
    return tuple(eqx.tree_at(lambda e: e.coefficients, e, part) for e, part in zip(effects, parts, strict=True))


def place(effects, name) -> slice:
    index = [effect.name for effect in effects].index(name)
    start = sum(effect.size for effect in effects[:index])
    return slice(start, start + effects[index].size)


@functools.cache
def there_and_back(prefix):
    """For each effect alone at ten times its usual size, and at minus that: the output, and the input found from it.

    What is solved for must come from the output alone, so the stimulus given to `recover` holds something else there.
    """
    names = [name for name in INVERTIBLE if name.startswith(prefix)]
    triad, true = triad_with(names, 10.0), stimulus((3, 1, 2))
    other = replace(true, **{triad.quantity: np.full((3, 1, 2, 3), 1e3)})

    @jax.jit
    @jax.vmap
    def run(flat):
        changed = replace(triad, effects=with_sizes(triad.effects, flat))
        output = changed.respond(true)
        return output, changed.recover(output, other)

    full = sizes(triad.effects)
    alone = np.zeros((len(names), len(full)))
    for row, name in zip(alone, names, strict=True):
        row[place(triad.effects, name)] = full[place(triad.effects, name)]
    pairs = run(np.concatenate([alone, -alone]))
    linear = np.asarray(respond(replace(triad, effects=()), true))
    return (
        names,
        sensed(triad, true),
        linear,
        *(np.asarray(part).reshape(2, len(names), *linear.shape) for part in pairs),
    )


@pytest.mark.parametrize("name", INVERTIBLE)
def test_round_trip_with_effects_ten_times_their_usual_size(name):
    names, truth, linear, outputs, found = there_and_back(name.partition(".")[0])
    for sign in (0, 1):
        assert np.abs(outputs[sign, names.index(name)] - linear).max() > 1e-4
        np.testing.assert_allclose(found[sign, names.index(name)], truth, rtol=0, atol=1e-9)


def test_what_a_dead_band_took_is_left_and_the_rest_comes_back():
    """Also where another effect's output lies within the band and must not be taken for a rate that was stopped."""
    width = np.array([0.5, 1.0, 2.0])
    others = (awake("gyro.temperature", 10.0), awake("gyro.scale_temperature", 1.0))
    triad = replace(unit(5).gyroscope, effects=(CATALOGUE["gyro.dead_band"].make(width), *others))
    true = replace(stimulus((3, 1, 2)), temperature=np.full((3, 1, 2), 60.0))
    inside = np.abs(true.angular_rate) < width
    assert inside.any() and not inside.all()
    # the scale over temperature sees the rate itself, so that what it put out for a stopped rate is all that is left
    leak = np.asarray(others[1].coefficients) * 35.0 * true.angular_rate
    gain = np.asarray(triad.gain)
    found = np.asarray(recover(triad, respond(triad, true), true))
    for place in np.ndindex(3, 1, 2):
        passed = np.where(inside[place], 0.0, true.angular_rate[place])
        expected = np.linalg.solve(gain + np.diag(others[1].coefficients) * 35.0, gain @ passed + leak[place])
        np.testing.assert_allclose(found[place], expected, atol=1e-12)


@pytest.mark.parametrize("prefix", ["accel", "gyro", "mag"])
def test_all_effects_of_a_triad_together_under_every_transformation(prefix):
    triad = triad_with([name for name in INVERTIBLE if name.startswith(prefix)], 1.0)
    true = stimulus((4, 2))  # paths of two samples, so that effects with a memory have one
    output = respond(triad, true)
    np.testing.assert_allclose(recover(triad, output, true), sensed(triad, true), atol=1e-11)
    # of the slopes only what depends on the input says anything, and with a tenth of it four rounds are enough: this
    # compiles in a tenth of the time
    names = [name for name in INVERTIBLE if name.startswith(prefix) and triad.quantity in CATALOGUE[name].needs]
    memory = [name for name in INVERTIBLE if name == f"{prefix}.thermal_lag"]
    triad = replace(triad_with([*names, *memory], 0.1), iterations=4)
    output = respond(triad, true)

    def back(output, true):
        return triad.recover(output.reshape(2, 3), true).ravel()

    def forward(value, true):
        return triad.respond(replace(true, **{triad.quantity: value.reshape(2, 3)})).ravel()

    @jax.jit
    @jax.vmap
    def transformed(output, true):
        slope = jax.jacfwd(forward)(sensed(triad, true).ravel(), true)
        return back(output, true), jax.jacfwd(back)(output, true), jax.jacrev(back)(output, true), slope

    value, inverse, reverse, slope = transformed(output.reshape(4, 6), true)
    np.testing.assert_allclose(value.reshape(4, 2, 3), sensed(triad, true), atol=1e-10)
    np.testing.assert_allclose(inverse @ slope, np.broadcast_to(np.eye(6), (4, 6, 6)), atol=1e-9)
    np.testing.assert_allclose(reverse, inverse, atol=1e-12)


def slopes(function, value, step):
    """A function, its derivative in forward and in reverse mode and by central differences, compiled as one."""

    @jax.jit
    def everything(value, moved):
        return function(value), jax.jacfwd(function)(value), jax.jacrev(function)(value), jax.vmap(function)(moved)

    moves = np.concatenate([np.diag(step), -np.diag(step)])
    at, forward, reverse, moved = everything(value, value + moves)
    up, down = np.split(np.asarray(moved), 2)
    return np.asarray(at), np.asarray(forward), np.asarray(reverse), np.moveaxis(up - down, 0, -1) / (2 * step)


def assert_one_slope(forward, reverse, central):
    size = np.abs(central).max()
    assert size > 0
    np.testing.assert_allclose(forward, central, rtol=1e-6, atol=1e-7 * size)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12 * size)


@functools.cache
def dormant_slopes(prefix):
    """What a score test asks for: slopes by coefficients that are zero, forward [0] and through the inverse [1]."""
    names = [name for name in TERMS if name.startswith(prefix) and not CATALOGUE[name].probes]
    # two rounds resolve a slope at zero, and compile in an eighth of the time of sixteen
    triad, true = replace(triad_with(names, 1.0), iterations=2), stimulus((4,))
    linear = np.asarray(respond(replace(triad, effects=()), true))

    def both(flat):
        changed = replace(triad, effects=with_sizes(triad.effects, flat))
        return jnp.stack([changed.respond(true), changed.recover(linear, true)])

    step = 1e-4 * np.abs(sizes(triad.effects))
    return triad, (linear, sensed(triad, true)), *slopes(both, np.zeros_like(step), step)


# no slope where all numbers are zero; those of the catalogue's effects that say so are tried at sizes of their own
FLAT = ("accel.learned_network", "gyro.learned_network", *(name for name in TERMS if CATALOGUE[name].probes))


@pytest.mark.parametrize("name", [name for name in TERMS if name not in FLAT])
def test_derivative_by_a_dormant_effect(name):
    triad, expected, at, *derivatives = dormant_slopes(name.partition(".")[0])
    np.testing.assert_allclose(at, expected, atol=1e-14)
    for side in (0, 1):
        assert_one_slope(*(derivative[side][..., place(triad.effects, name)] for derivative in derivatives))


@pytest.mark.parametrize("name", SEEN)
def test_derivative_by_a_dormant_error_of_the_setup(name):
    # a g-sensitivity lets the gyroscope, too, see what befalls the specific force
    imu, true = replace(imu_with([name], 1.0), gyroscope=triad_with(["gyro.g_sensitivity"], 1.0)), stimulus((5,))

    def both(flat):
        return jnp.stack(replace(imu, setup=with_sizes(imu.setup, flat)).respond(true))

    step = 1e-4 * np.abs(sizes(imu.setup))
    at, *derivatives = slopes(both, np.zeros_like(step), step)
    np.testing.assert_allclose(at, np.stack(imu_respond(replace(imu, setup=()), true)), atol=1e-13)
    inner = slice(1, -1)  # beyond its ends a path stays where it was: a kink, at which slopes are anybody's choice
    assert_one_slope(*(derivative[:, inner] for derivative in derivatives))


@pytest.mark.parametrize(
    "name",  # a learned curve keeps the range that it was learned over
    [name for name in TERMS if CATALOGUE[name].inner and CATALOGUE[name].cause and name.startswith("gyro")],
)
def test_derivative_by_an_inner_parameter(name):
    (inner, declared) = next(iter(CATALOGUE[name].inner.items()))
    triad, true = triad_with([name], 1.0), stimulus((6,), seed=2)

    def response(value):
        return eqx.tree_at(lambda t: getattr(t.effects[0], inner), triad, value[0]).respond(true)

    at, forward, reverse, central = slopes(
        response, np.array([1.1 * declared.typical]), np.array([1e-5 * declared.typical])
    )
    assert np.abs(at - respond(replace(triad, effects=()), true)).max() > 1e-5
    if name.endswith("step"):  # a fit searches the onset on a grid, because this is so
        for slope in (forward, reverse, central):
            np.testing.assert_array_equal(slope, 0.0)
    else:
        size = np.abs(central).max()
        assert size > 0
        np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-6 * size)
        np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12 * size)


def test_a_dead_band_is_found_on_a_grid():
    """Its slope is zero on the grid's every point, and the misfit is least where the band was."""
    triad, random = triad_with(["gyro.dead_band"]), np.random.default_rng(3)
    true = Stimulus(angular_rate=random.uniform(-0.02, 0.02, (400, 3)))
    grid = np.linspace(0, 0.012, 13)

    @jax.jit
    @jax.vmap
    def at(width):
        def output(width):
            return eqx.tree_at(lambda t: t.effects[0].coefficients, triad, jnp.full(3, width)).respond(true)

        return output(width), jax.jacfwd(output)(width)

    outputs, derivatives = at(grid)
    np.testing.assert_array_equal(derivatives, np.zeros((13, 400, 3)))
    gain, bias = np.asarray(triad.gain), np.asarray(triad.bias)
    for width, output in zip(grid, outputs, strict=True):
        passed = np.where(np.abs(true.angular_rate) >= width, true.angular_rate, 0.0)
        np.testing.assert_allclose(output, passed @ gain.T + bias, atol=1e-15)
    misfit = np.sum((outputs - outputs[7]) ** 2, axis=(1, 2))
    assert np.argsort(misfit)[0] == 7
    assert np.all(np.diff(misfit[:8]) < 0) and np.all(np.diff(misfit[7:]) > 0)


def test_references_of_a_triad_are_what_its_effects_count_from():
    effects = (awake("accel.temperature"), awake("accel.bias_ramp"))
    triad = replace(unit(2).accelerometer, effects=effects, temperature_reference=40.0, time_reference=70.0)
    true = replace(stimulus((2,)), temperature=np.array([40.0, 41.0]), time=np.array([70.0, 72.0]))
    change = respond(triad, true) - respond(replace(triad, effects=()), true)
    np.testing.assert_allclose(change[0], 0, atol=1e-14)
    np.testing.assert_allclose(change[1], effects[0].coefficients + 2 * effects[1].coefficients, atol=1e-14)


def test_imu():
    imu, true = unit(1), stimulus((2,))
    force, rate = imu_respond(imu, true)
    np.testing.assert_allclose(force, respond(imu.accelerometer, true), atol=1e-14)
    np.testing.assert_allclose(rate, respond(imu.gyroscope, true), atol=1e-14)
    back = imu.recover(force, rate)
    np.testing.assert_allclose(back[0], true.specific_force, atol=1e-14)
    np.testing.assert_allclose(back[1], true.angular_rate, atol=1e-14)
    alone = Imu(imu.accelerometer, None)
    assert imu_respond(alone, true)[1] is None
    assert alone.recover(force, None)[1] is None
    np.testing.assert_allclose(alone.recover(force, None)[0], true.specific_force, atol=1e-14)
    assert list(alone.triads()) == ["accelerometer"] and list(imu.triads()) == ["accelerometer", "gyroscope"]
    counts = Imu.nominal((2000.0,) * 3, (10.0, 0, -10), "count", (50.0,) * 3, (0.0,) * 3, "count")
    force, rate = imu_respond(counts, true)
    np.testing.assert_allclose(force, 2000 * np.asarray(true.specific_force) + [10, 0, -10], rtol=1e-14)
    np.testing.assert_allclose(rate, 50 * np.asarray(true.angular_rate), rtol=1e-14)
    assert counts.accelerometer.output_unit == counts.gyroscope.output_unit == "count"


# `Imu.recover` of triads that need each other runs without jit: its 8 turns of 16 rounds take half a minute to compile
CROSSED = ["accel.size_effect", "accel.lever_arm", "accel.quadratic", "accel.scale_temperature",
           "gyro.g_sensitivity", "gyro.g_squared_sensitivity", "gyro.quadratic", "gyro.scale_temperature",
           "gyro.earth_rotation"]  # fmt: skip


@pytest.mark.parametrize("given", [True, False], ids=["given", "derived"])
def test_effects_across_the_triads_are_undone_exactly(given):
    """Both triads' inputs from both outputs alone; ω̇ known, or both ways the differences of the rates' samples."""
    imu, true = imu_with(CROSSED, 3.0), smooth_motion()
    true = true if given else replace(true, angular_acceleration=None)
    output = imu_respond(imu, true)
    linear = imu_respond(imu_with([]), true)
    assert all(np.abs(a - b).max() > 2e-3 for a, b in zip(output, linear, strict=True))
    known = replace(true, specific_force=None, angular_rate=None)
    force, rate = imu.recover(*output, known)
    np.testing.assert_allclose(force, true.specific_force, rtol=0, atol=1e-9)
    np.testing.assert_allclose(rate, true.angular_rate, rtol=0, atol=1e-9)


def test_what_the_samples_do_not_resolve_of_the_angular_acceleration_is_lost():
    """The sensors felt the true ω̇, the recovery takes differences: h²/6 of its curvature within, h/2 ω̈ at the ends."""
    imu, true = imu_with([*CROSSED, "gyro.lag"], 1.0), smooth_motion()
    output = imu_respond(imu, true)
    known = replace(true, specific_force=None, angular_rate=None, angular_acceleration=None)
    force, rate = (np.asarray(part) for part in imu.recover(*output, known))
    interval = true.time[1] - true.time[0]
    curvature = np.abs(np.diff(true.angular_acceleration, 2, axis=0)).max() / interval**2
    second = np.abs(np.diff(true.angular_acceleration, axis=0)).max() / interval
    reach = np.abs(imu.accelerometer.effects[0].coefficients).max() + 0.01  # m, size effect and lever arm
    within, ends = interval**2 / 6 * curvature, interval / 2 * second
    # an arm crosses two components of ω̇; a wrong rate at an end spreads inwards by the lag over the interval (0.2)
    force_error, rate_error = np.abs(force - true.specific_force), np.abs(rate - true.angular_rate)
    assert 0.1 * reach * within < force_error[8:-8].max() < 2.2 * reach * within
    assert force_error.max() < 2.2 * reach * ends
    assert 0.1 * 1e-3 * within < rate_error[8:-8].max() < 1.3e-3 * within
    assert rate_error.max() < 1.3e-3 * ends


def test_a_lag_is_undone_without_knowing_the_acceleration():
    """Both ways differences: what remains is (τ d/dt)⁴ of the motion, 1e-9 for 1 ms and 1 Hz, away from the ends."""
    triad, true = triad_with(["gyro.lag"], 1.0), replace(smooth_motion(), angular_acceleration=None)
    output = respond(triad, true)
    found = np.asarray(recover(triad, output, replace(true, angular_rate=None)))
    error = np.abs(found - true.angular_rate)
    assert np.abs(np.asarray(output) - respond(replace(triad, effects=()), true)).max() > 1e-3
    assert error[8:-8].max() < 2 * (1e-3 * 2 * np.pi) ** 4
    assert error.max() < 1e-6


def test_only_what_belongs_to_the_unit_is_transferred():
    imu = imu_with(list(CATALOGUE), 1.0)
    kept = imu.transferable()
    assert kept.setup == ()
    for name, triad in imu.triads().items():
        names = [effect.name for effect in kept.triads()[name].effects]
        dropped = {effect.plain for effect in triad.effects if effect.name not in names}
        expected = {"accelerometer": {"lever_arm"}, "gyroscope": {"earth_rotation"}}.get(name, set())
        known = {effect.plain for effect in triad.effects if effect.name in KNOWN}
        session = {"bias_ramp", "warm_up", "step", "scale_step", "scale_ramp", "learned_time"}
        assert dropped & known == ({"hard_iron_step"} if name == "magnetometer" else session | expected)
        assert dropped == {effect.plain for effect in triad.effects if effect.scope != "device"}
        np.testing.assert_array_equal(kept.triads()[name].gain, triad.gain)
        np.testing.assert_array_equal(kept.triads()[name].bias, triad.bias)
    alone = Imu(imu.accelerometer, None, imu.setup).transferable()
    assert alone.gyroscope is None and alone.setup == ()


def few_rounds(imu):
    return replace(imu, **{name: replace(triad, iterations=2) for name, triad in imu.triads().items()})


def test_units_in_one_batch_are_as_one_by_one():
    names = ["accel.quadratic", "accel.warm_up", "accel.lever_arm", "gyro.thermal_lag", "gyro.g_sensitivity",
             "setup.table_rate_scale", "setup.gravity"]  # fmt: skip
    units = [few_rounds(imu_with(names, size, seed)) for seed, size in enumerate((0.5, 1.0, 2.0))]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *units)
    true = stimulus((4,))

    def there_and_back(imu):
        output = imu.respond(true)
        return output, imu.recover(*output, true)

    together = jax.jit(jax.vmap(there_and_back))(stacked)
    one = eqx.filter_jit(there_and_back)
    for k, imu in enumerate(units):
        each, alone = jax.tree.map(lambda leaf, k=k: leaf[k], together), one(imu)
        for batch, single in zip(jax.tree.leaves(each), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(batch, single, rtol=0, atol=1e-13)
    # the units differ, so that agreement says something
    assert np.abs(np.diff(np.asarray(together[0][0]), axis=0)).min(axis=(1, 2)).max() > 1e-6


def test_effects_go_where_their_names_say():
    made = [CATALOGUE[name].make(1.0) for name in ("gyro.lag", "setup.gravity", "accel.cubic", "gyro.quadratic")]
    found = unit(1).with_effects(*made)
    assert [e.name for e in found.accelerometer.effects] == ["accel.cubic"]
    assert [e.name for e in found.gyroscope.effects] == ["gyro.lag", "gyro.quadratic"]
    assert [e.name for e in found.setup] == ["setup.gravity"]
    assert not found.with_effects().setup and not found.with_effects().gyroscope.effects
    with pytest.raises(InputError, match=r"no gyroscope, which the effect gyro\.lag belongs to"):
        Imu(unit(1).accelerometer, None).with_effects(made[0])
