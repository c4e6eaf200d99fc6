"""How often a board's faults go to the unit, session or board that they belong to, over simulated boards.

Eight units in three sessions. Three units have a g-sensitivity of their own, one session a warm-up that all units
share, and the Earth turns below all of them, whose vertical part looks like a g-sensitivity that all have in common.
Most boards are drawn as estimates: recordings are simulated and diagnosed once, and the noise, drift and faults of each
board are drawn in their whitened conditions. `--whole` boards of fewer units go through all of it, from samples on.
`--measured`: eight units in four sessions that were measured (needs JAXIMU_DATA), in one run.
"""

import argparse
import copy
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import jax
import numpy as np
from common import Table, finish, share
from real_diagnosis import MIMU4444
from simulated_board import PATTERN, board

from jaximu import read_recording, wgs84_gravity
from jaximu.diagnosis import COMMON_DRIFT, attribute, diagnose
from jaximu.diagnosis.attribution import BoardRecording, common_drift, split
from jaximu.model.effects import CATALOGUE
from jaximu.model.effects.earth_rotation import EARTH_RATE

jax.config.update("jax_enable_x64", True)

UNITS, SESSIONS, SENSITIVE, DRAWS, LEVEL = 8, 3, 3, 200, 0.05
EFFECT, EARTH = "gyro.g_sensitivity", EARTH_RATE * np.sin(np.radians(59.35)) / 9.81
SIZES = {"g-sensitivity": 4e-4, "warm-up": 1e-3}
"""rad/s per m/s²; rad/s."""


BY_EYE = {
    "1": ("x jumps about by 20 from rest to rest", "x drifts by 65", "x drifts by 50", "x warms up by 20"),
    "2": ("x, y drift by 85", "x warms up by 40", "x, y drift by 50 and 30", "x warms up by 30"),
    "3": (
        "z falls by 90 at 40 to 90 s and by 40 at 190 s",
        "x, y drift; x lower by 95 after the fast phase",
        "z rises by 25 at 340 s",
        "z rises by 12 at 165 s",
    ),
    "4": (
        "z rises by 120 at 60 to 90 s and by 50 at 190 s",
        "all axes turn quicker at the end, by 40 to 70",
        "z falls by 40 at 340 s; one rest of y off by 40",
        "z falls by 20 at 185 s; y scatters",
    ),
    "5": ("x drifts by 95", "x warms up by 40", "x, z drift by 30", "x warms up by 45"),
    "6": ("x drifts by 155", "x warms up by 85, lower after the fast phase", "x drifts by 80", "x warms up by 50"),
    "7": (
        "y drifts by 115",
        "y drifts by 85; x lower by 95 after the fast phase",
        "y drifts by 40",
        "x, y warm up by 30",
    ),
    "8": ("x drifts by 90", "x drifts by 80", "x drifts, and jumps by 50 and 75", "x drifts by 100, and jumps by 40"),
}
"""The gyroscope's rate at rest over time, less what follows orientation, mdeg/s: by unit, seen in plots by a person."""


def templates():
    """Diagnose a plain recording of each session; the units of a board share its motion."""
    recordings = board(0, 1, SESSIONS, {}, [])
    return [
        BoardRecording.of(recording.name, "1", str(k), diagnose(recording, candidates=(EFFECT,)))
        for k, recording in enumerate(recordings)
    ]


def drawn_board(plain, seed, faults):
    """Recordings of a board, drawn, and what is true: the sensitive units and the session that warms up."""
    random = np.random.default_rng([seed, 540])
    sensitive = random.permutation(UNITS)[:SENSITIVE] if faults else []
    warm = int(random.integers(SESSIONS)) if faults else None
    matrices = {unit: SIZES["g-sensitivity"] * random.standard_normal(9) for unit in sensitive}
    parts = []
    for session, template in enumerate(plain):
        evidence, rests = template.evidence, template.rests
        columns = evidence.columns[:, evidence.place(template.block(EFFECT, {}))] / CATALOGUE[EFFECT].typical
        times = rests.times
        course = np.exp(-times / (0.3 * times[-1])) if session == warm else np.zeros(len(times))
        for unit in range(UNITS):
            loading = SIZES["warm-up"] * random.uniform(0.5, 1.5, 3) * random.choice([-1, 1], 3)
            drift = np.einsum("noi,oi->n", rests.reaction["gyroscope"], course[:, None] * loading)
            matrix = matrices.get(unit, np.zeros(9)) + faults * EARTH * np.eye(3).ravel()
            changed = copy.copy(evidence)
            changed.residual = evidence.off_base(random.standard_normal(len(drift)) + drift) + columns @ matrix
            parts.append(replace(template, unit=str(unit), session=str(session), evidence=changed))
    return parts, {str(unit) for unit in sensitive}, None if warm is None else str(warm)


def judged(parts, sensitive, warm):
    """Return the attributions that are true and those that are reported."""
    true = {(EFFECT, "unit", unit) for unit in sensitive}
    true |= {(EFFECT, "board", "")} if sensitive else set()
    true |= {(COMMON_DRIFT, "session", warm)} if warm is not None else set()
    reported, shared = set(), {}
    for session in {part.session for part in parts}:
        drift = common_drift([part for part in parts if part.session == session], DRAWS)
        if drift.p_value * SESSIONS < LEVEL:
            reported.add((COMMON_DRIFT, "session", session))
            shared[session] = np.stack([drift.times, drift.curve], axis=1)
    estimates = [part.estimate(EFFECT, {}, {}, shared.get(part.session)) for part in parts]
    shares = split(estimates, [part.unit for part in parts], [part.session for part in parts], LEVEL).parts
    reported |= {(EFFECT, part.belongs_to, label) for part in shares for label in part.values}
    return true, reported


def whole_board(seed):
    """The attributions that are true and those that are reported of a small board, from its samples on."""
    random = np.random.default_rng([seed, 541])
    unit, session = int(random.integers(3)), int(random.integers(2))
    recordings = board(seed, 3, 2, {unit: SIZES["g-sensitivity"]}, [session])
    attribution = attribute(recordings, PATTERN, candidates=(EFFECT, "gyro.bias_ramp"))
    true = {(EFFECT, "unit", str(unit + 1)), (COMMON_DRIFT, "session", str(session + 1))}
    reported = set()
    for finding in attribution.findings:
        labels = {"unit": finding.units, "session": finding.sessions, "board": ("",)}[finding.belongs_to]
        reported |= {(finding.name, finding.belongs_to, label) for label in labels}
    return true, reported


def measured():
    """Diagnose the measured board, and keep each recording's verdict and what belongs to what."""
    folder = Path(os.environ["JAXIMU_DATA"]) / "mimu4444"
    recordings = [read_recording(path, options=MIMU4444) for path in sorted(folder.glob("*.parquet"))]
    began = time.monotonic()
    attribution = attribute(recordings, PATTERN, wgs84_gravity(59.35))
    parts = attribution.recordings
    explained = sum(part.diagnosis["verdict"] != "unexplained" and part.chi2_heldout < 1.3 for part in parts)
    marks = "; *: the session's common drift taken off; †: what the other recordings say of the unit taken off"
    table = Table(
        "MIMU4444: what explains each recording, and χ² per condition on parts left out",
        ["unit", *(f"session {session}" for session in attribution.sessions)],
        f"{explained} of {len(parts)} explained with χ² below 1.3 (goal 28){marks}. One run, with the latitude, in "
        f"{time.monotonic() - began:.0f} s.",
    )
    for unit in attribution.units:
        table.add(
            unit,
            *(
                f"{', '.join(e['name'] for e in part.diagnosis['effects']) or part.diagnosis['verdict']} "
                f"({part.chi2_heldout:.2f}{' *' * part.without_drift}{' †' * bool(part.taken_off)})"
                + " and more, unexplained"
                * (part.diagnosis["verdict"] == "unexplained" and bool(part.named))
                for part in parts
                if part.unit == unit
            ),
        )
    seen = Table(
        "MIMU4444 by eye: how the gyroscope's rate at rest changes, less what follows orientation, mdeg/s",
        ["unit", *(f"session {session}" for session in attribution.sessions)],
        "Seen by a person in plots of the means at rest, which NumPy alone made.",
    )
    for unit, texts in BY_EYE.items():
        seen.add(unit, *texts)
    owners = Table("MIMU4444: what belongs to what", ["finding", "belongs to", "units", "sessions", "share", "p-value"])
    for finding in attribution.findings:
        owners.add(
            finding.name,
            finding.belongs_to,
            ", ".join(finding.units),
            ", ".join(finding.sessions),
            f"{100 * finding.share:.0f} %",
            f"{finding.p_value:.1g}",
        )
    figures = {"explained": explained, "recordings": [part.document() for part in parts]}
    finish("attribution_measured", [table, seen, owners], figures, script="attribution")


def main():
    """Draw boards with faults and without, and a few whole ones, and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="ten boards; results are not kept")
    parser.add_argument("--boards", type=int, default=100)
    parser.add_argument("--whole", type=int, default=0, help="small boards that are simulated and diagnosed as a whole")
    parser.add_argument("--measured", action="store_true", help="the measured board, and nothing else")
    options = parser.parse_args()
    if options.measured:
        return measured()
    count, began = 10 if options.small else options.boards, time.monotonic()
    plain = templates()
    studies = {
        "drawn, three sensitive units, a warm session, the Earth": [
            judged(*drawn_board(plain, k, True)) for k in range(count)
        ],
        "drawn, nothing but drift of each axis": [judged(*drawn_board(plain, 10**6 + k, False)) for k in range(count)],
        "whole, 3 units in 2 sessions": [whole_board(k) for k in range(options.whole)],
    }
    table = Table(
        "Whose fault it is: attributions of simulated boards, with 95 % bounds",
        [
            "boards",
            "count",
            "right, of those to find",
            "false, of those reported",
            "boards with a false one",
            "false ones",
        ],
        f"A g-sensitivity of {SIZES['g-sensitivity']:g} rad/s per m/s² in three units, a warm-up of "
        f"{SIZES['warm-up']:g} rad/s in one session, the Earth at 59.35°; {time.monotonic() - began:.0f} s in all.",
    )
    for name, answers in studies.items():
        if not answers:
            continue
        expected = sum(len(true) for true, _ in answers)
        total = sum(len(reported) for _, reported in answers)
        right = sum(len(true & reported) for true, reported in answers)
        false = [sorted({entry[:2] for entry in reported - true}) for true, reported in answers]
        wrong = sorted({" ".join(entry) for entries in false for entry in entries})
        table.add(
            name,
            len(answers),
            share(right, expected) if expected else "none",
            share(total - right, total) if total else "none",
            share(sum(map(bool, false)), len(answers)),
            ", ".join(wrong),
        )
    finish("attribution", [table], {"boards": count, "whole": options.whole}, keep=not options.small)


if __name__ == "__main__":
    main()
