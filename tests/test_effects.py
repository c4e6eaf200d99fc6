"""The catalogue: every effect says what it is, and is what it says."""

import dataclasses
import functools
import importlib
import inspect
import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_effects import DEMANDED, KNOWN, NETWORKS
from test_sensor import SETUPS, SHAPES, TERMS, stimulus

import jaximu.mistakes
import jaximu.model.effects
from jaximu.diagnosis.noise import NOISE_NAMES
from jaximu.ground.errors import InputError
from jaximu.mistakes import MISTAKES
from jaximu.mistakes.titles import effect_title
from jaximu.model.effects import CATALOGUE, Effect, Inner, SetupEffect
from jaximu.model.sensor import Imu
from jaximu.model.stimulus import Stimulus

EVERY = pytest.mark.parametrize("kind", CATALOGUE.values(), ids=CATALOGUE)
OF_A_PATH = ("setup.time_offset", "setup.reference_delay", "setup.reference_filter", "setup.clock_scale")
FIELDS = ("specific_force", "angular_rate", "angular_acceleration", "temperature", "temperature_rate", "time",
          "attitude", "vibration_power", "magnetic_field", "current")  # fmt: skip


def test_the_catalogue_holds_what_was_demanded():
    assert len(DEMANDED) == 59
    assert set(CATALOGUE) >= KNOWN
    assert {name for name in KNOWN if CATALOGUE[name].cause} == DEMANDED


def test_whatever_is_named_has_an_english_name():
    """Mistakes in data and kinds of noise too: each identifier in the code has a title in words, and each its own."""
    files = Path(jaximu.__file__).parent.rglob("*.py")
    found = {name for path in files for name in re.findall(r'"((?:data|noise|setup)\.\w+)"', path.read_text("utf-8"))}
    titles = {effect_title(name) for name in found}
    assert set(MISTAKES) | set(NOISE_NAMES) <= found
    assert len(found) > 40 and len(titles) == len(found)
    assert all(re.fullmatch(r"[a-z][^()]+ \((data|noise|setup)\.\w+\)", title) for title in titles)


def test_every_mistake_has_its_english_name_in_its_own_file():
    for path in sorted(Path(jaximu.mistakes.__file__).parent.glob("*.py")):
        found = set(re.findall(r'Finding\(\s*"([^"]+)"', path.read_text("utf-8"))) - set(CATALOGUE)
        if found:
            assert set(importlib.import_module(f"jaximu.mistakes.{path.stem}").TITLES) == found
    assert all(effect_title(name).startswith(title) for name, title in MISTAKES.items())


def test_every_file_of_the_folder_is_in_the_catalogue():
    folder = Path(jaximu.model.effects.__file__).parent
    names = {file.stem for file in folder.glob("*.py") if not file.stem.startswith("_")} - {"base", "catalogue"}
    modules = [importlib.import_module(f"jaximu.model.effects.{name}") for name in sorted(names)]
    listed = [effect for module in modules for effect in module.EFFECTS]
    assert len(listed) == len(set(listed)) == len(CATALOGUE)
    assert set(listed) == set(CATALOGUE.values())


def test_an_effect_of_a_session_can_act_in_one_recording_alone():
    kind = CATALOGUE["gyro.warm_up@2"]
    whole = CATALOGUE["gyro.warm_up"]
    assert (kind, whole) == (whole.within(2), kind.within(0))
    assert (kind.name, kind.plain, kind.recording, whole.recording) == ("gyro.warm_up@2", "warm_up", 2, 0)
    assert effect_title(kind.name) == "gyroscope warm-up in recording 2 (gyro.warm_up@2)"
    effect = kind.make([1.0, 2.0, 3.0], time_constant=7.0)
    assert effect.document("rad/s")["recording"] == 2 and "recording" not in whole.make(1.0).document("rad/s")
    for number, factor in ((1, 0.0), (2, 1.0)):
        there = effect.in_recording(number)
        assert type(there) is whole and there.time_constant == 7.0
        np.testing.assert_array_equal(there.coefficients, factor * np.array([1.0, 2.0, 3.0]))
    for name in ("gyro.warm_up@0", "gyro.warm_up@", "gyro.g_sensitivity@2", "gyro.nothing@2"):
        assert name not in CATALOGUE
        with pytest.raises(KeyError):
            CATALOGUE[name]


@EVERY
def test_metadata_is_complete(kind):
    assert issubclass(kind, Effect)
    assert issubclass(kind, SetupEffect) == kind.name.startswith("setup.")
    assert CATALOGUE[kind.name] is kind
    assert re.fullmatch(r"(accel|gyro|mag|setup)\.[a-z_]+", kind.name)
    for text in (kind.formula, kind.unit, kind.excited_by, kind.source, kind.recovery, inspect.getdoc(kind)):
        assert isinstance(text, str)
        assert text.strip()
    assert kind.scope in ("device", "session", "fixture")
    assert kind.refers_to in ("input", "output")
    assert kind.size > 0
    assert 0 < kind.typical < np.inf
    assert kind.needs and set(kind.needs) <= set(FIELDS)
    assert kind.name not in kind.look_alikes
    assert set(kind.look_alikes) <= set(CATALOGUE)
    if not issubclass(kind, SetupEffect):
        assert kind.unit.startswith("output") == (kind.refers_to == "output")
    else:
        assert kind.scope != "device"  # an error of the set-up belongs to no unit
    assert kind.invertible or kind.recovery != "exactly"
    if kind.name in KNOWN:
        assert kind.memory == {"thermal_lag": 3, "thermal_hysteresis": 1}.get(kind.name.partition(".")[2], 0)
        assert bool(kind.probes) == (kind.name == "gyro.dead_band")
    assert (kind.memory > 0) == (kind.remember is not Effect.remember)


@EVERY
def test_inner_parameters_are_declared(kind):
    fields = {field.name for field in dataclasses.fields(kind)}
    assert fields == {"coefficients", *kind.inner}
    for inner in kind.inner.values():
        assert isinstance(inner, Inner)
        assert 0 <= inner.low < inner.typical < inner.high < np.inf
        assert inner.unit.strip() and inner.meaning.strip()
    effect = kind.make(2.5)
    np.testing.assert_array_equal(effect.coefficients, np.full(kind.size, 2.5))
    assert all(getattr(effect, name) == inner.typical for name, inner in kind.inner.items())
    other = kind.dormant(**{name: inner.low for name, inner in kind.inner.items()})
    np.testing.assert_array_equal(other.coefficients, np.zeros(kind.size))
    assert all(getattr(other, name) == inner.low for name, inner in kind.inner.items())


@EVERY
def test_another_number_of_coefficients_is_refused(kind):
    with pytest.raises(InputError, match=rf"^{re.escape(kind.name)} has {kind.size} coefficient"):
        kind.make(np.ones(kind.size + 1))


@EVERY
def test_unknown_inner_parameter_is_refused(kind):
    known = next(iter(kind.inner), "it has none")
    with pytest.raises(InputError, match=rf"^{re.escape(kind.name)} has no inner parameter 'tau'.*{known}"):
        kind.make(1.0, tau=1.0)


@EVERY
def test_typical_sizes_are_in_the_units_of_the_output(kind):
    sizes = kind.make(3.0).typical_sizes(2000.0)
    factor = 2000.0 if kind.refers_to == "output" and not issubclass(kind, SetupEffect) else 1.0
    expected = np.full(kind.size, factor * kind.typical)
    if kind.name in NETWORKS:  # per axis four weights of the output, then twelve numbers inside tanh, without a unit
        expected = np.tile(np.repeat([factor * kind.typical, 1.0], [4, 12]), 3)
    np.testing.assert_array_equal(sizes.coefficients, expected)
    assert all(getattr(sizes, name) == inner.typical for name, inner in kind.inner.items())
    assert jax.tree.structure(sizes) == jax.tree.structure(kind.make(3.0))


def test_unit_of_a_coefficient():
    unit = {name: kind.coefficient_unit for name, kind in CATALOGUE.items()}
    assert unit["accel.quadratic"]("count") == "count/(m/s^2)^2"
    assert unit["accel.quadratic"]("m/s^2") == "(m/s^2)/(m/s^2)^2"
    assert unit["gyro.temperature"]("rad/s") == "(rad/s)/K"
    assert unit["gyro.warm_up"]("rad/s") == "rad/s"
    assert unit["accel.lever_arm"]("count") == "m"
    assert unit["setup.time_offset"]("rad/s") == "s"


def acts_on(kind):
    """What an error of the set-up is asked to change."""
    return "magnetic_field" if "magnetic_field" in kind.needs else "angular_rate"


def outcome(effect, true):
    """What an effect does: its term, or by how much it changes what the gyroscope goes through; (..., m)."""
    if not isinstance(effect, SetupEffect):
        return effect.term(true)
    changes, acted = [], effect.act(true, acts_on(type(effect)))
    for field in FIELDS:
        value, before = getattr(acted, field), getattr(true, field)
        if field == "attitude":  # q and −q are one attitude
            value = jnp.where(jnp.sum(value * before, axis=-1, keepdims=True) < 0, -value, value)
        change = value - before
        changes.append(change if change.ndim > true.time.ndim else change[..., None])
    return jnp.concatenate(changes, axis=-1)


def shapes_of(kind):
    return [shape for shape in SHAPES if kind.name not in OF_A_PATH or (shape and shape[-1] > 1)]


def in_units(unit, metre, second, kelvin):
    """The number that a unit of the catalogue amounts to, when its base units are these."""
    values = {"m": metre, "s": second, "K": kelvin, "rad": 1.0, "uT": 1.0, "A": 1.0, "output": 1.0}
    return eval(unit.replace("^", "**"), {"__builtins__": {}}, values)


DIMENSIONS = {
    "specific_force": "m/s^2", "angular_rate": "rad/s", "angular_acceleration": "rad/s^2", "temperature": "K",
    "temperature_rate": "K/s", "time": "s", "attitude": "1", "vibration_power": "(m/s^2)^2", "magnetic_field": "uT",
    "current": "A",
}  # fmt: skip
OTHER_UNITS = {"metre": 1.25, "second": 0.5, "kelvin": 2.0}


@functools.cache
def outcomes(kinds):
    """Outcomes of each effect for several coefficients on stimuli of every shape; compiled as one."""
    stimuli = [stimulus(shape, 4) for shape in SHAPES]
    paths = jax.tree.map(lambda leaf: leaf[:, 0], stimuli[-1])
    rescaled = {field: getattr(paths, field) / in_units(unit, **OTHER_UNITS) for field, unit in DIMENSIONS.items()}
    reference = paths.temperature_reference / OTHER_UNITS["kelvin"]
    in_other_units = replace(paths, **rescaled, temperature_reference=reference)
    inputs = {}
    for kind in kinds:
        # large enough for a band to stop some rates, and for the set-up's errors to leave the first order
        size = (1e3 if kind.name.startswith(("setup.", "gyro.dead_band")) else 1.0) * kind.typical
        a, b = (size * np.random.default_rng([seed, kind.size]).standard_normal(kind.size) for seed in (2, 3))
        usual = {name: np.float64(each.typical) for name, each in kind.inner.items()}
        other = {name: value / in_units(kind.inner[name].unit, **OTHER_UNITS) for name, value in usual.items()}
        if kind.name.endswith(("learned_temperature", "learned_network")):
            # of an absolute temperature only what is beyond 0 °C changes its number
            other |= {name: 273.15 + (usual[name] - 273.15) / OTHER_UNITS["kelvin"] for name in ("low", "high")}
        inputs[kind.name] = np.stack([0 * a, a, b, a + 2 * b]), usual, a / in_units(kind.unit, **OTHER_UNITS), other

    @jax.jit
    def run(inputs, stimuli, paths, in_other_units):
        found = {}
        for kind in kinds:
            rows, usual, other, inner = inputs[kind.name]

            def of(coefficients, true, kind=kind, usual=usual):
                return outcome(kind(coefficients, **usual), true)

            shapes = [SHAPES.index(shape) for shape in shapes_of(kind)]
            found[kind.name] = (
                [jax.vmap(of, in_axes=(0, None))(rows, stimuli[index]) for index in shapes],
                jax.vmap(of, in_axes=(None, 0))(rows[1], paths),
                outcome(kind(other, **inner), in_other_units),
            )
        return found

    return jax.tree.map(np.asarray, run(inputs, stimuli, paths, in_other_units))


def outcomes_of(kind):
    """For each shape, those of coefficients zero, a, b and a + 2 b; of a, path by path; of a, all in other units."""
    together = () if issubclass(kind, SetupEffect) else tuple(CATALOGUE[name] for name in TERMS)
    return outcomes(together or (kind,))[kind.name]


@EVERY
def test_dormant_effect_is_absent(kind):
    rounding = 1e-13 if issubclass(kind, SetupEffect) else 0.0  # of rotating there and back
    for shape, (zero, *_) in zip(shapes_of(kind), outcomes_of(kind)[0], strict=True):
        assert zero.shape[:-1] == shape
        np.testing.assert_allclose(zero, 0.0, rtol=0, atol=rounding)


@EVERY
def test_takes_any_batch_and_its_last_axis_is_the_path(kind):
    by_shape, by_path, _ = outcomes_of(kind)
    for shape, (_, some, *_) in zip(shapes_of(kind), by_shape, strict=True):
        assert some.shape[:-1] == shape
        assert issubclass(kind, SetupEffect) or some.shape == (*shape, 3)
        assert np.all(np.isfinite(some))
    some = by_shape[-1][1]
    assert np.abs(some).max() > 0
    np.testing.assert_allclose(some[:, 0], by_path, rtol=1e-12, atol=1e-14)


NOT_LINEAR = ("gyro.dead_band", "setup.reference_rotation", "setup.table_tilt", *NETWORKS, *OF_A_PATH)


@EVERY
def test_is_linear_in_its_coefficients(kind):
    differences = []
    for _, a, b, both in outcomes_of(kind)[0]:
        size = np.abs(a).max() + 2 * np.abs(b).max()
        differences.append(np.abs(both - (a + 2 * b)).max() / max(size, 1e-300))
    # those which are not linear must show it: whoever takes them for linear should hear of it
    if kind.name in NOT_LINEAR or kind.probes:
        assert max(differences) > 1e-6
    else:
        assert max(differences) < 1e-13


@EVERY
def test_units_are_those_of_the_formula(kind):
    """In other metres, seconds and kelvins all numbers change by their stated units, and the outcome by its own."""
    _, before, after = outcomes_of(kind)
    if issubclass(kind, SetupEffect):
        sizes = {"attitude": 4} | {
            field: 3 for field in FIELDS if field.startswith(("specific", "angular", "magnetic"))
        }
        factors = [in_units(DIMENSIONS[field], **OTHER_UNITS) for field in FIELDS for _ in range(sizes.get(field, 1))]
        factors = np.array(factors)
    else:
        quantity = {"accel": "specific_force", "mag": "magnetic_field"}.get(kind.name.partition(".")[0], "angular_rate")
        factors = in_units(DIMENSIONS[quantity], **OTHER_UNITS) if kind.refers_to == "input" else 1.0
    size = np.abs(before).max()
    assert size > 0
    np.testing.assert_allclose(after * factors, before, rtol=1e-9, atol=1e-11 * size)


@EVERY
def test_missing_field_is_named(kind):
    true, effect = stimulus((2,)), kind.make(kind.typical)
    quantity = "specific_force" if {"specific_force", "attitude"} & set(kind.needs) else "angular_rate"
    quantity = "magnetic_field" if "magnetic_field" in kind.needs else quantity
    for field in kind.needs:
        lacking = replace(true, **{field: None})
        if field in ("angular_acceleration", "temperature_rate"):  # else taken from the samples
            lacking = replace(lacking, time=None)
        with pytest.raises(InputError, match=rf"effect {re.escape(kind.name)} needs the {field.replace('_', ' ')},"):
            effect.act(lacking, quantity) if issubclass(kind, SetupEffect) else effect.term(lacking)


@pytest.mark.parametrize("name", ["accel.lever_arm", "gyro.lag", "accel.temperature_rate"])
def test_rates_of_change_are_taken_from_the_samples_of_a_path(name):
    """Parabolas through three neighbours, one-sided at the ends; of an instant there is nothing to take."""
    field, source = (
        ("temperature_rate", "temperature") if name.endswith("rate") else ("angular_acceleration", "angular_rate")
    )
    effect, true = CATALOGUE[name].make(CATALOGUE[name].typical), stimulus((2, 5))
    values, time = getattr(true, source), true.time
    # NumPy's differences of second order on uneven stamps
    rates = np.stack([np.gradient(np.asarray(values[i]), np.asarray(time[i]), axis=0) for i in range(2)])
    term = eqx.filter_jit(lambda true: effect.term(true))
    np.testing.assert_allclose(
        term(replace(true, **{field: None})), term(replace(true, **{field: rates})), rtol=1e-10, atol=1e-13
    )
    instant = replace(stimulus(()), **{field: None})
    with pytest.raises(InputError, match=f"the effect {name} needs the {field.replace('_', ' ')}"):
        effect.term(instant)
    single = replace(stimulus((1,)), **{field: None})
    assert np.all(np.isfinite(effect.term(single)))


@pytest.mark.parametrize("name", OF_A_PATH)
@pytest.mark.parametrize("shape", [(), (1,)])
def test_a_shift_in_time_needs_a_path(name, shape):
    with pytest.raises(InputError, match=f"the effect {name} needs a path"):
        CATALOGUE[name].make(1e-3).act(stimulus(shape), "angular_rate")


@pytest.mark.parametrize("name", SETUPS)
def test_reach_of_a_setup_effect(name):
    """How far around an instant it looks: the shift itself, for a clock the drift over the whole recording."""
    expected = {"setup.time_offset": 0.3, "setup.reference_delay": 0.3, "setup.clock_scale": 30.0}.get(name, 0.0)
    for sign in (1.0, -1.0):
        assert CATALOGUE[name].make(0.3 * sign).reach(100.0) == pytest.approx(expected, rel=1e-15)


def test_only_the_gyroscope_is_offset_in_time():
    true = stimulus((2,))
    assert CATALOGUE["setup.time_offset"].make(5.0).act(true, "specific_force") is true


def test_setup_effects_act_one_after_the_other():
    """The second acts on what the first has made of the stimulus: late by 1 s on a clock that runs fast by 25 %."""
    time = np.arange(9.0)
    true = Stimulus(angular_rate=np.outer(time, [1.0, -2.0, 3.0]), time=time)
    setup = tuple(
        CATALOGUE[name].make(size) for name, size in (("setup.reference_delay", 1.0), ("setup.clock_scale", 0.25))
    )
    acted = replace(Imu.nominal(), setup=setup).acted(true, "angular_rate").angular_rate
    early = slice(6)  # before the end, beyond which the path stays where it was
    np.testing.assert_allclose(acted[early], np.outer(time / 1.25 + 1, [1.0, -2.0, 3.0])[early], atol=1e-13)


def test_stimulus_says_what_its_fields_are():
    arrays = {field.name for field in dataclasses.fields(Stimulus) if not field.metadata.get("static")}
    assert arrays == {*FIELDS, "memory", "session_time"}
