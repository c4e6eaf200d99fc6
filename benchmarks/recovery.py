"""Recovery of simulated units: error over the Cramér–Rao bound, and how often intervals cover the truth.

Units are simulated to recordings, segmented, and fitted in a batch from the nominal guess (unit gain, no bias). The
bound is the inverse Fisher information of the joint problem at the true model, with the true noise, over the true rests
and turns: nothing of what the segmentation found or the fit estimated enters it.
"""

import os
import time

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from common import Table, arguments, finish
from jax.flatten_util import ravel_pytree
from scipy.stats import binom

from jaximu.calibration.hand_held import fit_hand_held
from jaximu.data.poses import condense
from jaximu.data.poses_covariance import condition_covariance
from jaximu.estimation.covariance import inverse_cholesky
from jaximu.estimation.problem import names_of
from jaximu.ground.units import STANDARD_GRAVITY
from jaximu.model.sensor import Imu
from jaximu.recordings.segmentation import Segmentation, observed_poses, segment
from jaximu.simulation import ACCELEROMETER_DENSITY, GYROSCOPE_DENSITY, consumer_noise, draw_imu, simulate
from jaximu.simulation.protocols import HandHeld

jax.config.update("jax_enable_x64", True)


def stack(trees):
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def observe_alike(segmentations):
    """Observations of all units, padded to the shapes of the largest."""
    one_by_one = [observed_poses(found, STANDARD_GRAVITY) for found in segmentations]
    shapes = [(len(o.poses.mask), o.turns.interval.shape[1]) for o in one_by_one]
    bucket = tuple(np.max(shapes, axis=0).tolist())
    alike = (
        o if shape == bucket else observed_poses(found, STANDARD_GRAVITY, bucket=bucket)
        for o, shape, found in zip(one_by_one, shapes, segmentations, strict=True)
    )
    return stack(alike)


def true_noise(observations):
    """Put the simulated noise in place of the measured one."""
    poses, eye = observations.poses, jnp.eye(3)
    duration = jnp.where(poses.mask, poses.stop - poses.start, 1.0)[:, None, None]
    return eqx.tree_at(
        lambda o: (o.poses.accelerometer_covariance, o.poses.gyroscope_covariance, o.turns.noise),
        observations,
        (ACCELEROMETER_DENSITY**2 * eye / duration, GYROSCOPE_DENSITY**2 * eye / duration, GYROSCOPE_DENSITY**2 * eye),
    )


@eqx.filter_jit
def bounds(imus, observations, index):
    """Standard deviations (N, p) no unbiased estimate from these rests and turns can beat."""

    def one(imu, observations):
        observations = true_noise(observations)
        weights = inverse_cholesky(condition_covariance(imu, observations).dense().total(jnp.zeros(3)))
        flat, unravel = ravel_pytree(imu)

        def residual(free):
            model = unravel(flat.at[index].set(free))
            return weights @ condense(model, observations)[0](model)

        jacobian = jax.jacfwd(residual)(flat[index])
        return jnp.sqrt(jnp.diagonal(jnp.linalg.inv(jacobian.T @ jacobian)))

    return jax.lax.map(lambda pair: one(*pair), (imus, observations))


def main() -> None:
    small = arguments(__doc__).small
    units = 60 if small else 500
    began = time.perf_counter()
    imus = [draw_imu(seed) for seed in range(units)]
    recordings, truths = zip(
        *(simulate(imu, HandHeld(), consumer_noise(), seed=seed) for seed, imu in enumerate(imus)), strict=True
    )
    simulated = time.perf_counter()
    found = [segment(recording) for recording in recordings]
    observations = observe_alike(found)
    segmented = time.perf_counter()
    exact = observe_alike([Segmentation(r, t.intervals, 0.0, {}, ()) for r, t in zip(recordings, truths, strict=True)])
    truth = stack(imus)
    nominal = stack([Imu.nominal()] * units)

    rest_true = np.mean([np.sum(np.diff(t.intervals, axis=1)) for t in truths])
    rest_found = np.mean([np.sum(np.diff(s.intervals, axis=1)) for s in found])
    lost = sum(len(t.intervals) - len(s.intervals) for s, t in zip(found, truths, strict=True))

    figures = {
        "units": units,
        "rest_found_share": float(rest_found / rest_true),
        "poses_lost": int(lost),
        "simulate_seconds_per_unit": (simulated - began) / units,
        "segment_seconds_per_unit": (segmented - simulated) / units,
    }
    tables = []
    summary = Table(
        f"Recovery of {units} simulated units (40 rests of 4 s, 39 turns of 1.5 s, 100 Hz, 100 µg/√Hz, 0.005 °/s/√Hz)",
        [
            "method",
            "RMSE / bound",
            "target",
            "same, detected rests",
            "95 % intervals cover",
            "target",
            "outside binomial bound",
        ],
        f"Rests found: {100 * rest_found / rest_true:.1f} % of the time at rest, {lost} of {40 * units} poses lost.",
    )
    detail = Table(
        "By parameter",
        ["parameter", *(f"{m}: {w}" for m in ("joint", "two-step") for w in ("RMSE / bound", "cover %"))],
    )
    low, high = binom.ppf([0.0005, 0.9995], units, 0.95) / units
    columns = []
    names: tuple[str, ...] = ()
    for method, target in (("joint", 1.05), ("two-step", 1.2)):
        started = time.perf_counter()
        fit = fit_hand_held(nominal, observations, method)
        seconds = time.perf_counter() - started
        names, index = fit.names, np.array([names_of(imus[0]).index(name) for name in fit.names])
        error = fit.values - np.asarray(jax.vmap(lambda imu: ravel_pytree(imu)[0])(truth))[:, index]
        bound = np.asarray(bounds(truth, exact, index))
        bound_detected = np.asarray(bounds(truth, observations, index))
        good = np.asarray(fit.converged) & np.asarray(fit.finite)
        covered = np.abs(error) <= 1.959964 * fit.sigmas()
        ratio = np.sqrt(np.mean(np.square(error / bound), axis=0))
        detected = np.sqrt(np.mean(np.square(error / bound_detected)))
        cover = covered.mean(axis=0)
        pooled = np.sqrt(np.mean(np.square(error / bound)))
        outside = [name for name, share in zip(names, cover, strict=True) if not low <= share <= high]
        summary.add(
            method, f"{pooled:.3f}", f"≤ {target}", f"{detected:.3f}", f"{100 * cover.mean():.2f} %", "93–97 %",
            ", ".join(outside) or "none",
        )  # fmt: skip
        columns += [ratio, cover]
        excess = np.asarray(fit.excess)
        figures[method] = {
            "converged": int(good.sum()),
            "rmse_over_bound": float(pooled),
            "rmse_over_bound_detected": float(detected),
            "rmse_over_bound_by_parameter": dict(zip(names, ratio.tolist(), strict=True)),
            "sigma_over_bound": float(np.mean(fit.sigmas() / bound)),
            "coverage": float(cover.mean()),
            "coverage_by_parameter": dict(zip(names, cover.tolist(), strict=True)),
            "coverage_bound_99.9": [float(low), float(high)],
            "outside_bound": outside,
            "mean_excess": excess.mean(axis=0).tolist(),
            "share_with_excess": (excess > 0).mean(axis=0).tolist(),
            "seconds_with_compilation": seconds,
        }
        print({k: v for k, v in figures[method].items() if "by_parameter" not in k})
    for row, name in enumerate(names):
        detail.add(name, f"{columns[0][row]:.3f}", f"{100 * columns[1][row]:.1f}",
                   f"{columns[2][row]:.3f}", f"{100 * columns[3][row]:.1f}")  # fmt: skip
    detail.note = f"99.9 % binomial bound of each coverage: {100 * low:.1f} to {100 * high:.1f} %."
    tables += [summary, detail]
    print(figures)
    finish("recovery", tables, figures, keep=not small)


if __name__ == "__main__":
    main()
