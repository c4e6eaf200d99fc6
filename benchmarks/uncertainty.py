"""Intervals of the corrected output (`Calibration.uncertainty_of`) against the truth, over many simulated units.

Each unit is drawn, recorded by hand with white noise and without slow drift, and fitted from the data sheet with its
scatter beyond the noise estimated, side by side (`jax.lax.map` of `jaximu.fit` in batches). Then the unit's exact
output is corrected by its fit: at rest with 200 directions up, and turning about six directions. An interval holds the
truth where the error along its worst direction is within 1.96 standard deviations. Shares are over units, each of
which counts once: errors at different inputs of one unit go together.
"""

import jax
import jax.numpy as jnp
import numpy as np
from common import Table, arguments, finish

import jaximu
from jaximu.data.poses import PosesAndTurns
from jaximu.estimation.problem import names_of
from jaximu.estimation.projection import output_error, sensitivity
from jaximu.ground.quantities import Z95
from jaximu.model.stimulus import Stimulus
from jaximu.recordings.segmentation import observed_poses, segment
from jaximu.simulation import consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld
from jaximu.simulation.protocols.positions import spiral

jax.config.update("jax_enable_x64", True)

GRAVITY, TOGETHER = 9.80665, 20
NOMINAL = jax.tree.map(np.asarray, jaximu.Imu.nominal())
UP, ABOUT = spiral(200), np.concatenate([np.eye(3), -np.eye(3)])
INPUTS = {
    "specific force at rest, 200 orientations": ("accelerometer", Stimulus(GRAVITY * UP)),
    "angular rate at rest": ("gyroscope", Stimulus(angular_rate=np.zeros((1, 3)))),
    "angular rate at 250 °/s about six directions": ("gyroscope", Stimulus(angular_rate=np.radians(250.0) * ABOUT)),
}


def data_of(seed: int, poses: int) -> PosesAndTurns:
    """Return the data of a simulated unit."""
    recording, _ = simulate(draw_imu(seed), HandHeld(poses, 2.0), consumer_noise(), rate=50.0, seed=seed)
    return PosesAndTurns.of(observed_poses(segment(recording), GRAVITY))


@jax.jit
def pulls(unit: jaximu.Imu, data: PosesAndTurns) -> tuple[dict[str, jax.Array], jax.Array]:
    """Return errors along the worst direction, in standard deviations, by input; and whether the fit converged."""
    fit = jaximu.fit(NOMINAL, data)
    places = np.array([names_of(NOMINAL).index(name) for name in fit.names], int)
    results = {}
    for name, (owner, stimulus) in INPUTS.items():
        slope = sensitivity(fit.imu, places, stimulus)[owner]
        error = output_error(fit.imu, unit, stimulus)[owner]
        values, vectors = jnp.linalg.eigh(slope @ fit.covariance @ jnp.swapaxes(slope, -1, -2))
        results[name] = jnp.sum(error * vectors[..., -1], axis=-1) / jnp.sqrt(values[..., -1])
    return results, fit.converged


def main(small: bool) -> None:
    """Run it with 24 poses, a gap of some 35° between neighbours."""
    count, poses, figures = (40 if small else 400), 24, {}
    table = Table(
        f"95 % intervals of the corrected output against the truth: {count} units, {poses} poses by hand, white noise, "
        "no slow drift",
        ["input", "intervals that hold the truth (95 % by units)", "error² over its variance"],
        "Goal: 93 to 97 %.",
    )
    units = jax.tree.map(lambda *leaves: np.stack(leaves), *map(draw_imu, range(count)))
    data = jaximu.stack([data_of(seed, poses) for seed in range(count)])
    results, converged = jax.lax.map(lambda pair: pulls(*pair), (units, data), batch_size=TOGETHER)
    assert np.all(converged)
    for name, pull in results.items():
        held = np.mean(np.abs(pull) <= Z95, axis=1)
        share, half = 100 * held.mean(), 100 * Z95 * held.std(ddof=1) / np.sqrt(count)
        ratio = float(np.mean(np.square(pull)))
        table.add(name, f"{share:.1f} % ({share - half:.1f} … {min(share + half, 100):.1f})", ratio)
        figures[name] = {"share": share, "half": half, "ratio": ratio}
    finish("uncertainty", [table], {"units": count, "poses": poses, **figures}, keep=not small)


if __name__ == "__main__":
    main(arguments(__doc__).small)
