"""`jaximu check` on simulated units: false alarms where nothing moved, and what it says where one parameter did.

Each unit is recorded twice (24 poses by hand, 50 Hz), its noise known from half an hour at rest; the second recording
is checked against the calibration from the first. A parameter that moved did so by six times what both calibrations
together leave open.
"""

from dataclasses import replace

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from common import Table, arguments, finish  # noqa: E402
from scipy.stats import binomtest  # noqa: E402

from jaximu import LocalGravity, calibrate  # noqa: E402
from jaximu.diagnosis import check  # noqa: E402
from jaximu.noise.at_rest import fit_noise  # noqa: E402
from jaximu.simulation import consumer_noise, draw_imu, simulate  # noqa: E402
from jaximu.simulation.protocols import HandHeld, Static  # noqa: E402

GRAVITY = LocalGravity(9.80665, 0.0)
PLACES = (("accelerometer", "bias", (1,)), ("accelerometer", "gain", (2, 2)), ("gyroscope", "gain", (0, 0)),
          ("gyroscope", "gain", (1, 2)))  # fmt: skip
TIMES = 6.0


def recorded(imu, seed: int):
    """Return one of a unit's recordings."""
    return simulate(imu, HandHeld(24, 3.0), consumer_noise(), rate=50.0, seed=seed)[0]


def moved(imu, calibration, place):
    """Return the unit with one parameter moved, and the parameter's name."""
    triad, field, index = place
    name = f"{triad}.{field}[{','.join(map(str, index))}]"
    sigma = float(np.sqrt(np.diag(calibration.covariance))[calibration.names.index(name)])
    values = np.array(getattr(getattr(imu, triad), field))
    values[index] += TIMES * np.sqrt(2.0) * sigma
    return replace(imu, **{triad: replace(getattr(imu, triad), **{field: values})}), name


def main():
    """Check all units and keep the table."""
    options = arguments(__doc__)
    still, shifted = (12, 8) if options.small else (200, 80)
    found = {"nothing": [], "one parameter": []}
    for seed in range(still + shifted):
        imu = jax.tree.map(np.asarray, draw_imu(seed))
        noise = fit_noise(simulate(imu, Static(1800.0), consumer_noise(), rate=50.0, seed=10_000 + seed)[0])
        calibration = calibrate(recorded(imu, 2 * seed + 1), GRAVITY, static=noise)
        name = None
        if seed >= still:
            imu, name = moved(imu, calibration, PLACES[seed % len(PLACES)])
        said = check(calibration, recorded(imu, 2 * seed + 2), GRAVITY, static=noise)
        found["nothing" if name is None else "one parameter"].append((name, said))

    table = Table(
        "An old calibration checked against a new recording", ["moved", "claim", "rate, 95 % bounds", "units"]
    )
    figures = {}

    def add(what: str, claim: str, hits: list[bool]) -> None:
        low, high = binomtest(sum(hits), len(hits)).proportion_ci()
        table.add(what, claim, f"{np.mean(hits):.1%} ({low:.1%} … {high:.1%})", len(hits))
        figures[f"{what}: {claim}"] = [int(sum(hits)), len(hits)]

    add("nothing", "not valid (goal 5 %)", [said.verdict != "valid" for _, said in found["nothing"]])
    one = found["one parameter"]
    add("one parameter", "not valid", [said.verdict != "valid" for _, said in one])
    add("one parameter", "shifted", [said.verdict == "shifted" for _, said in one])
    add(
        "one parameter", "this one among those that moved", [name in {s.name for s in said.moved} for name, said in one]
    )
    finish("check", [table], figures, keep=not options.small)


if __name__ == "__main__":
    main()
