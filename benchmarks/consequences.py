"""What errors do to navigation: budgets against draws and the polynomial, grades, NEES of increments, speed of draws.

A consumer unit is simulated and calibrated by hand; budgets, draws and increments take that calibration's covariance.
The polynomial is δp = ½ δb_a t² + ½ SF_a g t² + (1/6) g δb_g t³ of a level unit at rest. NEES: the error of
pre-integrated increments, squared in their covariance, over their degrees of freedom; one is right.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax

jax.config.update("jax_enable_x64", True)

from dataclasses import replace  # noqa: E402
from pathlib import Path  # noqa: E402

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from common import Table, arguments, finish, least  # noqa: E402
from jax.flatten_util import ravel_pytree  # noqa: E402

from jaximu import LocalGravity, calibrate, read_recording, simulate  # noqa: E402
from jaximu.data.preintegration import preintegrate_samples  # noqa: E402
from jaximu.estimation.problem import names_of  # noqa: E402
from jaximu.ground.rotation import conjugate, logarithm, multiply  # noqa: E402
from jaximu.model import BiasInstability, RandomWalk, White  # noqa: E402
from jaximu.model.sensor import Imu  # noqa: E402
from jaximu.navigation import increments, mechanise, mechanise_increments, noise_covariance, preintegrate  # noqa: E402
from jaximu.navigation.consequences import consequences, kind_of, position  # noqa: E402
from jaximu.navigation.estimator_noise import MeasuredErrors, ModelledErrors, estimator_noise, nees  # noqa: E402
from jaximu.navigation.trajectory import Place, level_driving, of_specification  # noqa: E402
from jaximu.recordings.readers import read_attitude  # noqa: E402
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, Specification, consumer_noise, draw_imu  # noqa: E402
from jaximu.simulation.protocols import HandHeld  # noqa: E402

GRAVITY = LocalGravity(9.80665, 5e-4)
PLACE = Place(45.0, 0.0, GRAVITY)
NOISE = {
    "accelerometer": {"N": np.full(3, ACCELEROMETER_DENSITY), "B": np.full(3, 3e-4), "K": np.full(3, 2e-5)},
    "gyroscope": {"N": np.full(3, GYROSCOPE_DENSITY), "B": np.full(3, 3e-5), "K": np.full(3, 1e-6)},
}
TIMES = (1.0, 10.0, 60.0, 600.0)
PROCESSES = {"N": White, "B": BiasInstability, "K": RandomWalk}


def calibrated():
    """A consumer unit with a g-sensitivity, calibrated from forty poses."""
    recording, _ = simulate(draw_imu(0), HandHeld(40, 4.0), consumer_noise(), seed=0)
    found = calibrate(recording, GRAVITY, effects=("gyro.g_sensitivity",))
    return replace(found, fit=None, observations=None, segmentations=())


def at(times, wanted):
    return int(np.argmin(np.abs(times - wanted)))


def by_draws(calibration, draws):
    """Every term of the budget by itself against draws of it alone, where it is above 1 % of the total."""
    path = level_driving(PLACE, TIMES[-1], rate=20.0)
    whole = consequences(calibration, path, NOISE, draws=0)
    total = position(whole.total)
    kinds = [kind_of(name, calibration.imu) for name in calibration.names]
    rows = {}
    for term, variances in whole.terms.items():
        own = np.array([kind == term for kind in kinds])
        part = calibration.covariance * np.outer(own, own)
        triad = term.split()[0]
        noise = {triad: {term[-1]: NOISE[triad][term[-1]]}} if not own.any() else {}
        part = part if own.any() else 1e-24 * calibration.covariance
        check = consequences(replace(calibration, covariance=part), path, noise, draws=draws).check
        drawn = position(check.sigma**2)
        rows[term] = [
            (float(position(variances)[row]), float(drawn[row] / position(variances)[row]))
            if position(variances)[row] > 0.01 * total[row] else None
            for row in (at(whole.times, time) for time in TIMES)
        ]  # fmt: skip
        print(term, rows[term], flush=True)
    return rows, [float(total[at(whole.times, time)]) for time in TIMES]


def polynomial():
    """The budget of a level unit at rest over the polynomial's, at times up to 20 minutes."""
    times = (1.0, 10.0, 60.0, 300.0, 600.0, 1200.0)
    document = {"rate": 20, "protocol": {"kind": "static", "duration": 1200}}
    path, _ = of_specification(Specification(document), PLACE)
    imu = draw_imu(0, 0.0, 0.0, 0.0)
    sigma = {("accelerometer", "bias"): 1e-3, ("accelerometer", "gain"): 1e-4, ("gyroscope", "bias"): 1e-5}
    names = tuple(name for name in names_of(imu) if (name.owner, name.part) in sigma and len(set(name.axes)) == 1)
    covariance = np.diag([sigma[name.owner, name.part] ** 2 for name in names])
    calibration = replace(calibrated(), imu=imu, names=names, covariance=covariance)
    noise = {"accelerometer": {"N": np.full(3, 1e-3)}, "gyroscope": {"N": np.full(3, 1e-4)}}
    found = consequences(calibration, path, noise, draws=0)
    g, rows = GRAVITY.value, {}
    level = {
        "accelerometer bias, level": ("accelerometer bias", 2, lambda t: 1e-3 * t**2 / 2),
        "accelerometer bias, up": ("accelerometer bias", None, lambda t: 1e-3 * t**2 / 2),
        "accelerometer scale, up": ("accelerometer scale", None, lambda t: g * 1e-4 * t**2 / 2),
        "gyroscope bias, level": ("gyroscope bias", 2, lambda t: g * 1e-5 * t**3 / 6),
        "accelerometer noise N, level": ("accelerometer white noise N", 2, lambda t: 1e-3 * np.sqrt(t**3 / 3)),
        "gyroscope noise N, level": ("gyroscope white noise N", 2, lambda t: g * 1e-4 * np.sqrt(t**5 / 20)),
    }
    for name, (term, axes, formula) in level.items():
        variances = found.terms[term]
        sigma_of = np.sqrt(variances[:, :2].mean(axis=1) if axes else variances[:, 2])
        rows[name] = [float(sigma_of[at(found.times, time)] / formula(time)) for time in times]
    return times, rows


def by_hand():
    """A minute of poses and turns by hand, 100 Hz."""
    document = {"rate": 100, "protocol": {"kind": "hand-held", "poses": 60, "pose_duration": 0.5, "turn_duration": 1.5,
                                          "displacement": 0.5}}  # fmt: skip
    return of_specification(Specification(document), PLACE)[0]


def drawn(system, shape, seed, known):
    """Draws (trials, samples, 3) of a noise process, from where it is on average or, if known, from zero."""
    rng = np.random.default_rng([*map(int, seed)])
    trials, samples = shape
    a, b, c, d, root = map(np.asarray, (system.transition, system.drive, system.output, system.through, system.root))
    state = (0.0 if known else 1.0) * np.einsum("asr,tar->tas", root, rng.standard_normal((trials, 3, root.shape[-1])))
    made = np.empty((samples, trials, 3))
    for row in made:
        pushed = rng.standard_normal((trials, 3, d.shape[-1]))
        row[:] = np.einsum("as,tas->ta", c, state) + np.einsum("am,tam->ta", d, pushed)
        state = np.einsum("ast,nat->nas", a, state) + np.einsum("asm,nam->nas", b, pushed)
    return np.moveaxis(made, 0, 1)


def increment_nees(calibration, trials):
    """Mean NEES of ΔR, Δv and Δp over 1, 5, 10 s against drawn errors: of increments as they are, with the
    calibration's part of the covariance and without; and of those of an estimator that knows its bias at the start,
    with N and a walk alone, before and after N is multiplied.
    """
    path = by_hand()
    imu, stimulus = calibration.imu, path.stimulus
    numbers, restore = ravel_pytree(imu)
    places = np.array([names_of(imu).index(name) for name in calibration.names])
    rng = np.random.default_rng(1)
    root = np.linalg.cholesky(calibration.covariance)
    bare = replace(stimulus, angular_acceleration=None, time=None, temperature=None, temperature_rate=None,
                   attitude=None, vibration_power=None, magnetic_field=None, current=None)  # fmt: skip
    found = {}

    @jax.jit
    def constant(change):
        """Mean over the path of what a changed unit makes of its rates and forces, (6,)."""
        force, rate = imu.recover(*restore(numbers.at[places].add(change)).respond(bare))
        apart = jnp.concatenate([rate - bare.angular_rate, force - bare.specific_force], axis=1)
        return jnp.average(apart, axis=0, weights=path.intervals)

    for seconds in (1, 5, 10):
        count = 100 * seconds
        intervals = np.full(count, 0.01)
        told = estimator_noise(ModelledErrors(calibration, path), NOISE, interval=seconds, lengths=(seconds,))
        systems = {(triad, term): PROCESSES[term](value).system(0.01)
                   for triad, terms in NOISE.items() for term, value in terms.items()}  # fmt: skip
        for triad, each in told.triads.items():
            white = np.full(3, each.white)
            systems[triad, "white"] = White(white).system(0.01)
            systems[triad, "more"] = White(white * each.multiplier[0]).system(0.01)
            systems[triad, "walk"] = RandomWalk(np.full(3, each.walk[0])).system(0.01)

        @jax.jit
        def trial(rate, force, change, noise, drift, bias, intervals=intervals, systems=systems):
            """Squared errors; noise, drift (S, 6): all of it, and all but what it was at the start."""
            unit = restore(numbers.at[places].add(change))
            truth = preintegrate_samples(rate, force, intervals)

            def error(added):
                felt = replace(bare, specific_force=force + added[:, 3:], angular_rate=rate + added[:, :3])
                got = preintegrate(imu, *unit.respond(felt), intervals)
                turned = logarithm(multiply(conjugate(truth.rotation), got.rotation))
                return got, jnp.concatenate(
                    [turned, got.velocity - truth.velocity, got.displacement - truth.displacement]
                )

            got, whole = error(noise)
            known = error(drift - bias)[1]
            slopes = got.parameters[:, places]
            spread = {term: 0.0 for term in ("N", "B", "K", "white", "more", "walk")}
            for triad, columns in (("gyroscope", slice(0, 3)), ("accelerometer", slice(3, 6))):
                for term in spread:
                    spread[term] += noise_covariance(None, got.reaction[..., columns], systems[triad, term])[1]
            sensors = spread["N"] + spread["B"] + spread["K"]
            cases = (
                (whole, sensors + slopes @ calibration.covariance @ slopes.T), (whole, sensors),
                (known, spread["white"] + spread["walk"]), (known, spread["more"] + spread["walk"]),
            )  # fmt: skip
            parts = [slice(3 * part, 3 * part + 3) for part in range(3)]
            return jnp.array([[e[part] @ jnp.linalg.solve(p[part, part], e[part]) / 3 for part in parts]
                              for e, p in cases])  # fmt: skip

        whole, departing = (
            {
                triad: sum(drawn(PROCESSES[term](value).system(0.01), (trials, count),
                                 (seconds, place, triad == "gyroscope"), known)
                           for place, (term, value) in enumerate(terms.items()))
                for triad, terms in NOISE.items()
            }
            for known in (False, True)
        )  # fmt: skip
        values = []
        for number in range(trials):
            first = int(rng.integers(0, len(path.intervals) - count))
            window = slice(first, first + count)
            noise, drift = (np.concatenate([each["gyroscope"][number], each["accelerometer"][number]], axis=1)
                            for each in (whole, departing))  # fmt: skip
            change = root @ rng.standard_normal(len(root))
            values.append(trial(stimulus.angular_rate[window], stimulus.specific_force[window], change, noise, drift,
                                constant(change)))  # fmt: skip
        mean, scatter = np.mean(values, axis=0), np.std(values, axis=0) / np.sqrt(trials)
        found[seconds] = {
            case: dict(zip(("rotation", "velocity", "displacement"), map(float, row), strict=True))
            for case, row in zip(("with", "without", "stated", "multiplied"), mean, strict=True)
        } | {
            "multiplier": {triad: float(each.multiplier[0]) for triad, each in told.triads.items()},
            "chance": (1.96 * scatter.max(axis=1)).tolist(),
        }
        print(seconds, found[seconds], flush=True)
    return found


GRADES = {  # accelerometer, gyroscope: standard deviations that a calibration leaves, the unit's own errors, N, B, K
    "consumer": {
        "bias": (3e-3, 2e-4), "scale": (3e-4, 1e-3), "misalignment": (3e-4, 1e-3), "g-sensitivity": 1e-5,
        "own": (2e-2, 1e-2, 1e-4), "N": (9.8e-4, 8.7e-5), "B": (3e-4, 3e-5), "K": (2e-5, 1e-6),
    },
    "tactical": {
        "bias": (1e-3, 5e-6), "scale": (1e-4, 1e-4), "misalignment": (1e-4, 1e-4), "g-sensitivity": 2e-7,
        "own": (2e-3, 2e-3, 2e-6), "N": (3e-4, 1.5e-5), "B": (5e-5, 2.4e-6), "K": (2e-6, 2e-8),
    },
    "navigation": {
        "bias": (2.5e-4, 2.4e-8), "scale": (2e-5, 5e-6), "misalignment": (1e-5, 1e-5), "g-sensitivity": 5e-10,
        "own": (2e-4, 2e-4, 5e-9), "N": (5e-5, 5.8e-7), "B": (3e-5, 1e-8), "K": (1e-6, 2e-11),
    },
}  # fmt: skip


def graded(calibration, grade):
    """The calibration with its correlations, its standard deviations those of a grade; the unit's errors too."""
    sizes = GRADES[grade]
    sigma = []
    for name in calibration.names:
        triad = int(name.owner == "gyroscope")
        kind = kind_of(name, calibration.imu).removeprefix(f"{name.owner} ")
        sigma.append(sizes[kind] if kind == "g-sensitivity" else sizes[kind][triad])
    stated = np.sqrt(np.diagonal(calibration.covariance))
    covariance = calibration.covariance / np.outer(stated, stated) * np.outer(sigma, sigma)
    scale, tilt, sensitivity = sizes["own"]
    rng = np.random.default_rng(7)

    def gain(lower):
        off = tilt * rng.standard_normal((3, 3)) * (1 - np.eye(3))
        return np.eye(3) + np.diag(scale * rng.standard_normal(3)) + (np.tril(off) if lower else off)

    imu = calibration.imu
    effect = replace(imu.gyroscope.effects[0], coefficients=sensitivity * rng.standard_normal(9))
    imu = replace(imu, accelerometer=replace(imu.accelerometer, gain=gain(True)),
                  gyroscope=replace(imu.gyroscope, gain=gain(False), effects=(effect,)))  # fmt: skip
    noise = {triad: {term: np.full(3, sizes[term][place]) for term in "NBK"}
             for place, triad in enumerate(("accelerometer", "gyroscope"))}  # fmt: skip
    return replace(calibration, imu=imu, covariance=covariance), noise


def by_grade(calibration):
    """Position error by term, and what a simpler model costs, of three grades on the same level driving."""
    path = level_driving(PLACE, 600.0, rate=20.0)
    found = {}
    for grade in GRADES:
        unit, noise = graded(calibration, grade)
        whole = consequences(unit, path, noise, draws=0)
        rows = [at(whole.times, time) for time in (60.0, 600.0)]
        found[grade] = {
            "terms": {name: position(each)[rows].tolist() for name, each in whole.terms.items()},
            "calibration": position(whole.calibration)[rows].tolist(),
            "everything": position(whole.total)[rows].tolist(),
            "left out": {name: each[rows].tolist() for name, each in whole.left_out.items()},
        }
        print(grade, found[grade]["everything"], flush=True)
    return found


PUBLISHED = {  # of the ADIS16448, as the data set states it
    "gyroscope": {"N": np.full(3, 1.6968e-4), "K": np.full(3, 1.9393e-5)},
    "accelerometer": {"N": np.full(3, 2.0e-3), "K": np.full(3, 3.0e-3)},
}


def flights(folder):
    """EuRoC: NEES with the published noise, and with the multipliers that the other flight gave."""
    lengths = (0.1, 1.0, 5.0)
    sources, found = {}, {}
    for name in ("MH03", "V102"):
        recording = read_recording(folder / f"euroc/{name}.imu.txt")
        truth = read_attitude(folder / f"euroc/{name}.truth.txt")
        unit = Imu.nominal()  # as its factory calibrated it; biases are an estimator's states, and fitted
        sources[name] = MeasuredErrors.of(unit, recording, truth, LocalGravity(9.808, 1e-3))
        told = estimator_noise(sources[name], PUBLISHED, lengths=lengths)
        found[name] = {
            "lengths": told.lengths.tolist(), "notes": told.notes, "stretches": told.count,
            **{triad: {"multiplier": each.multiplier.tolist(), "low": each.low.tolist(), "high": each.high.tolist()}
               for triad, each in told.triads.items()},
        }  # fmt: skip
        print(name, found[name], flush=True)
    for name, other in (("MH03", "V102"), ("V102", "MH03")):
        for case in ("published", "other"):
            found[name][case] = [
                nees(sources[name], PUBLISHED, length, {
                    triad: 1.0 if case == "published" else found[other][triad]["multiplier"][place]
                    for triad in PUBLISHED
                })
                for place, length in enumerate(lengths)
            ]  # fmt: skip
    return found


def numpy_loop(start, rates, forces, interval):
    """The same mechanisation as a loop over samples in NumPy, all draws at once: rates, forces (S, D, 3)."""
    q = np.tile(np.asarray(start.attitude), (rates.shape[1], 1))
    v = np.zeros((rates.shape[1], 3))
    phi, height = np.full(len(q), float(start.latitude)), np.full(len(q), float(start.height))
    longitude = np.zeros(len(q))

    def product(a, b):
        return np.stack([
            a[:, 0] * b[:, 0] - np.sum(a[:, 1:] * b[:, 1:], axis=1),
            a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0] + a[:, 2] * b[:, 3] - a[:, 3] * b[:, 2],
            a[:, 0] * b[:, 2] - a[:, 1] * b[:, 3] + a[:, 2] * b[:, 0] + a[:, 3] * b[:, 1],
            a[:, 0] * b[:, 3] + a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1] + a[:, 3] * b[:, 0],
        ], axis=1)  # fmt: skip

    def exponential(vector):
        half = np.linalg.norm(vector, axis=1, keepdims=True) / 2
        return np.concatenate([np.cos(half), np.sinc(half / np.pi) * vector / 2], axis=1)

    for rate, force in zip(rates, forces, strict=True):
        sine, cosine = np.sin(phi), np.cos(phi)
        root = 1 - 0.00669437999014 * sine**2
        across = 6378137.0 / np.sqrt(root)
        meridian = across * (1 - 0.00669437999014) / root
        gravity = 9.7803253359 * (1 + 0.00193185265241 * sine**2) / np.sqrt(root) * (1 - 2 * height / 6378137.0)
        earth = 7.292115e-5 * np.stack([0 * sine, cosine, sine], axis=1)
        moving = np.stack([-v[:, 1] / (meridian + height), v[:, 0] / (across + height),
                           v[:, 0] * sine / cosine / (across + height)], axis=1)  # fmt: skip
        vector, turning = rate * interval, (earth + moving) * interval
        pushed = force * interval + np.cross(vector, force * interval) / 2
        pushed = pushed + 2 * np.cross(q[:, 1:], np.cross(q[:, 1:], pushed) + q[:, :1] * pushed)
        before = v
        v = v + pushed - np.cross(turning, pushed) / 2 - np.cross(2 * earth + moving, v) * interval
        v[:, 2] -= gravity * interval
        mean = (before + v) / 2 * interval
        q = product(exponential(-turning), product(q, exponential(vector)))
        phi = phi + mean[:, 1] / (meridian + height)
        longitude = longitude + mean[:, 0] / ((across + height) * cosine)
        height = height + mean[:, 2]
    return v


def speed(draws, samples):
    """Processor time of draws of gains along a path of 60 s: by every sample, by increments of a second, by NumPy."""
    path = level_driving(PLACE, 60.0)
    rate, force = np.asarray(path.stimulus.angular_rate), np.asarray(path.stimulus.specific_force)
    imu = draw_imu(0, 0.0, 0.0, 0.0)
    changes = np.zeros((draws, 24))
    gains = np.array([name.part == "gain" for name in names_of(imu)])
    changes[:, gains] = 1e-3 * np.random.default_rng(0).standard_normal((draws, 18))
    units = jax.vmap(lambda change: ravel_pytree(imu)[1](ravel_pytree(imu)[0] + change))(changes)

    @jax.jit
    def by_samples(units):
        def one(unit):
            return unit.recover(force, rate)

        def some(units):
            forces, rates = jax.vmap(one)(units)
            lanes = jnp.broadcast_to(path.intervals, rates.shape[:2])
            return mechanise(path.start, *increments(rates, forces, lanes), path.intervals, len(rate)).velocity[:, -1]

        return jax.lax.map(some, jax.tree.map(lambda leaf: leaf.reshape(-1, 500, *leaf.shape[1:]), units))

    @jax.jit
    def by_increments(changes):
        stretches = jax.vmap(lambda f, w, h: preintegrate(imu, f, w, h))(
            force.reshape(60, -1, 3), rate.reshape(60, -1, 3), path.intervals.reshape(60, -1)
        )
        moved = stretches.moved(changes[:, None, :])
        end = mechanise_increments(path.start, moved.rotation, moved.velocity, moved.displacement, stretches.duration)
        return end.velocity[:, -1]

    samplewise, quick = np.asarray(by_samples(units)).reshape(-1, 3), np.asarray(by_increments(changes))
    seconds = {
        "every sample": least(lambda: jax.block_until_ready(by_samples(units)), 1),
        "increments of a second": least(lambda: jax.block_until_ready(by_increments(changes)), 3),
    }
    first = jax.jit(jax.vmap(lambda unit: unit.recover(force[:samples], rate[:samples])))
    forces, rates = map(np.asarray, first(units))
    rates, forces = np.moveaxis(rates, 0, 1).copy(), np.moveaxis(forces, 0, 1).copy()
    seconds["NumPy loop"] = least(lambda: numpy_loop(path.start, rates, forces, 0.01), 1) * len(rate) / samples
    spread = float(np.std(samplewise))
    return seconds, float(np.sqrt(np.mean((quick - samplewise) ** 2)) / spread)


def main() -> None:
    small = arguments(__doc__).small
    calibration = calibrated()
    figures = {}
    seconds, apart = speed(1000 if small else 10_000, 60)
    figures["speed"] = seconds | {"velocity_apart": apart}
    print(figures["speed"], flush=True)
    times, rows = polynomial()
    figures["polynomial"] = {"times": times, "ratio": rows}
    curve = Table(
        "Position error of a level unit at rest over the polynomial's",
        ["term", *(f"{time:g} s" for time in times)],
        "Goal: within 5 % where the polynomial holds. It knows neither Schuler's oscillation (84 minutes), which holds "
        "level errors back, nor that gravity falls with height, which lets an error upward run away, nor the Earth's "
        "rotation.",
    )
    for name, values in rows.items():
        curve.add(name, *(f"{value:.3f}" for value in values))
    trials = 60 if small else 1000
    figures["nees"] = increment_nees(calibration, trials)
    named = ("rotation", "velocity", "displacement")
    increments_table = Table(
        "NEES of pre-integrated rotation, velocity and displacement, each over its three degrees of freedom",
        ["over", "with the calibration's part", "without it", "estimator: N and a walk alone",
         "estimator: N times (gyroscope, accelerometer)"],
        f"{trials} stretches of motion by hand, errors drawn from the calibration's covariance and from noise N, B and "
        f"K. Goal: 0.9 to 1.1; by chance up to ±{figures['nees'][1]['chance'][0]:.2f} with the calibration's part, and "
        f"±{max(each['chance'][3] for each in figures['nees'].values()):.2f} multiplied. The estimator knows its "
        "biases at the start of a stretch, and nothing of scale, misalignment and g-sensitivity but N that is "
        "multiplied for it, by "
        "what is expected without any truth.",
    )  # fmt: skip
    for length, each in figures["nees"].items():
        cells = [", ".join(f"{each[case][name]:.3g}" for name in named) for case in ("with", "without", "stated",
                 "multiplied")]  # fmt: skip
        cells[-1] += f" ({each['multiplier']['gyroscope']:.2f}, {each['multiplier']['accelerometer']:.2f})"
        increments_table.add(f"{length} s", *cells)
    figures["grades"] = by_grade(calibration)
    grades = Table(
        "Position error (1σ, m) of three grades on the same level driving, after 60 s and 600 s",
        ["term", *GRADES],
        "One unit with the correlations of one calibration by hand; what is left uncertain of it, its own errors and "
        "its noise are sized by grade. Last rows: what leaving a part of the model out costs, in metres for this unit.",
    )
    figure = figures["grades"]
    whole = {grade: {**each["terms"], "calibration, all together": each["calibration"], "everything":
             each["everything"], **{f"left out: {name}": value for name, value in each["left out"].items()}}
             for grade, each in figure.items()}  # fmt: skip
    for term in whole["consumer"]:
        grades.add(term, *(", ".join(f"{value:.3g}" for value in whole[grade][term]) for grade in GRADES))
    tables = []
    if folder := os.environ.get("JAXIMU_DATA"):
        figures["flights"] = flights(Path(folder))
        measured = Table(
            "EuRoC flights: NEES of ΔR and Δv against the tracker, noise as published and multiplied",
            ["flight, over", "multipliers of its own: gyroscope", "accelerometer", "published: ΔR, Δv",
             "with the other flight's multipliers: ΔR, Δv"],
            "The unit as its factory calibrated it, its biases fitted over the flight. Multipliers (95 % intervals) "
            "are each for its length. The tracker's own errors count as the unit's; MH03's attitude rests on this very "
            "unit, that of V102 on cameras.",
        )  # fmt: skip
        for name, each in figures["flights"].items():
            for place, length in enumerate(each["lengths"]):
                own = [f"{each[triad]['multiplier'][place]:.3g} ({each[triad]['low'][place]:.2g} to "
                       f"{each[triad]['high'][place]:.2g})" for triad in ("gyroscope", "accelerometer")]  # fmt: skip
                cells = [f"{each[case][place]['rotation']:.3g}, {each[case][place]['velocity']:.3g}"
                         for case in ("published", "other")]  # fmt: skip
                measured.add(f"{name}, {length:g} s", *own, *cells)
        tables.append(measured)
    draws = 100 if small else 1000
    terms, total = by_draws(calibration, draws)
    figures["draws"] = {"terms": terms, "total": total, "draws": draws}
    budget = Table(
        f"Position error by term (1σ, m) on level driving (20 Hz), and {draws} draws of the term alone over it",
        ["term", *(f"{time:g} s" for time in TIMES)],
        "Left blank below 1 % of the total. Goal: within 5 %. By chance a ratio is off by up to "
        f"{196 / np.sqrt(2 * 2 * draws):.1f} % (95 %, two directions).",
    )
    for term, cells in terms.items():
        budget.add(term, *("" if cell is None else f"{cell[0]:.3g} ({cell[1]:.3f})" for cell in cells))
    budget.add("everything", *(f"{value:.3g}" for value in total))
    fast = Table(
        f"{1000 if small else 10_000} draws of the gains along 60 s at 100 Hz, processor time",
        ["way", "seconds", "NumPy loop over it"],
        "NumPy: a loop over samples, all draws at once, 60 samples measured and scaled up; goal: a tenth. Velocities "
        f"by increments and by every sample differ by {100 * apart:.2g} % (rms) of their scatter.",
    )
    for way, each in seconds.items():
        fast.add(way, each, seconds["NumPy loop"] / each)
    finish("consequences", [budget, curve, increments_table, grades, *tables, fast], figures, keep=not small)


if __name__ == "__main__":
    main()
