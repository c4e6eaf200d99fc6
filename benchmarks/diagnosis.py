"""Effects hidden in recordings, and how often they are found: suites of nothing, one, two, ties, blind and outside.

The recordings come from `tests/hidden_effects.py`, which knows nothing of this library: physics at four times the
sample rate, written to Parquet files; the diagnosis sees the files. Sizes are multiples k of the detection limit by
noncentrality: the whitened length of what the effect does to this recording's conditions, the base parameters projected
off, is k times that which a test of as many degrees of freedom finds with 90 % power at 0.05/28. Protocol: 40 poses of
4 s, 100 Hz, white noise of 100 µg/√Hz and 0.005 °/s/√Hz, flicker of 20 µg and 5 °/h, 16 bits; the noise is fitted to an
hour at rest unless said. A recording that is refused counts as neither detected nor named, and is listed. `--small`
runs a tenth; `--limit` runs the suites at the limit alone, with a table of their own: at k = 1, and at the size that a
diagnosis prints as its detection limit, which is that of all questions together and anywhere on an effect's grid.
`--outside` runs those outside the catalogue alone, `--several` three at once and a strong one beside a weak one,
likewise.
"""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import tempfile
import time
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import jax
import numpy as np
from common import Table, arguments, finish, share
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import hidden_effects as hidden

from jaximu import LocalGravity, calibrate, read_recording
from jaximu.data.by_hand import RecordedByHand
from jaximu.diagnosis import diagnose
from jaximu.diagnosis.evidence import limit_noncentrality
from jaximu.diagnosis.experiment import Experiment
from jaximu.ground.errors import NotPossibleError
from jaximu.model.effects import CATALOGUE
from jaximu.noise.at_rest import fit_noise
from jaximu.recordings.segmentation import observed_poses

jax.config.update("jax_enable_x64", True)

GRAVITY = LocalGravity(hidden.GRAVITY, 0.0)
OUTSIDE_FREEDOM = 3
SEVERAL = ("three, k = 4", "strong and weak, k = 8 and 1.5")
LIMIT, AT_PRINTED = "one, k = 1", "one, at the printed limit"
TIE, SETTLED = "tie, k = 4", "tie with another recording, k = 4"
PRINTED = ("printed",)
NEARLY = "outside.odd_square"
"""ω|ω| has a cosine of 0.99 with gyro.cubic: beyond what the other suites ask."""


def sized(case, folder, noise, multiples):
    """The case with each hidden effect at so many detection limits, or None where it does nothing to this recording."""
    bare = case.with_size(0.0)
    plain = read_recording(bare.write(folder / "bare", ("fit",))["fit"])
    calibration = calibrate(plain, GRAVITY)
    (part,) = calibration.segmentations
    experiment = Experiment(RecordedByHand((part,), observed_poses(part, GRAVITY.value, noise=noise)), calibration.imu)
    state = experiment.fit()
    scales = {}
    for effect, multiple in zip(case.hidden, multiples, strict=True):
        loud = {each.name: 5.0 if each.name == effect.name else 0.0 for each in case.hidden}
        other = read_recording(case.with_size(loud).write(folder / "loud", ("fit",))["fit"])
        observations = observed_poses(replace(part, recording=other), GRAVITY.value, noise=noise)
        conditions = replace(experiment, data=RecordedByHand((part,), observations)).predict(state.imu)[0]
        change = state.weights @ (conditions - state.conditions) / 5.0
        basis = np.linalg.svd(state.evidence.jacobian, full_matrices=False)[0]
        length = np.linalg.norm(change - basis @ (basis.T @ change))
        if length < 1e-3:
            return None
        freedom = CATALOGUE[effect.name].size if effect.name in CATALOGUE else OUTSIDE_FREEDOM
        scales[effect.name] = multiple * np.sqrt(limit_noncentrality(freedom)) / length
    return case.with_size(scales)


def printed(case, folder, noise):
    """The detection limit that a diagnosis of the same recording without the effect states: the coefficients' norm."""
    bare = read_recording(case.with_size(0.0).write(folder / "bare", ("fit",))["fit"])
    return diagnose(bare, GRAVITY, static=noise).detection_limits[case.hidden[0].name][0]


def trial(task):
    """Hide, write, diagnose: what was hidden and what was said, a refusal included."""
    try:
        return diagnosed(task)
    except NotPossibleError as error:
        suite, seed, names, *_ = task
        return {"suite": suite, "seed": seed, "hidden": list(names), "verdict": "refused", "reason": str(error),
                "named": [], "rivals": [], "weak": [], "preflight": [], "blind": [], "p_value": None, "heldout": None,
                "gain_data": None, "seconds": 0.0}  # fmt: skip


def diagnosed(task):
    """Hide, write, diagnose: what was hidden and what was said; None where the effect does nothing."""
    suite, seed, names, multiples, options, known = task
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        case = hidden.draw_case(seed, names, **options)
        noise = fit_noise(read_recording(case.write(folder, ("static",))["static"]))
        if multiples == PRINTED:
            case = case.with_size(printed(case, folder, noise) / case.hidden[0].size)
        elif names and multiples[0]:
            case = sized(case, folder, noise, multiples)
            if case is None:
                return None
        files = case.write(folder / "case", ("fit", "heldout"))
        recording, heldout = (read_recording(files[each]) for each in ("fit", "heldout"))
        heldout = None if suite == TIE else heldout  # which would settle it
        found = diagnose(recording, GRAVITY, static=noise if known else None, heldout=heldout)
    gain = found.gain
    return {
        "suite": suite,
        "seed": seed,
        "hidden": list(names),
        "verdict": found.verdict,
        "named": [each.name for each in found.effects],
        "rivals": [list(each.rivals) for each in found.effects],
        "weak": [each.weak for each in found.effects],
        "preflight": [each.name for each in found.preflight],
        "blind": sorted(set(names) & set(found.not_observable)),
        "p_value": found.p_value,
        "heldout": None if gain is None else [gain.before.chi_squared, gain.after.chi_squared, gain.after.count],
        "gain_data": None if gain is None else gain.data,
        "seconds": time.perf_counter() - started,
    }


def tasks(small):
    """Every suite's trials. Effects are drawn evenly over those observable in the protocol."""
    share = 10 if small else 1
    found = []

    def add(suite, count, draw, multiples=(), known=True, **options):
        for number in range(max(count // share, 2)):
            seed = 1000 * (1 + len({task[0] for task in found} | {suite})) + number
            names = draw(np.random.default_rng([seed, 77]))
            options_now = dict(options) if options else {"temperature": bool(number % 2)}
            found.append((suite, seed, names, multiples, options_now, known))

    everything = hidden.observable(True)
    add("nothing", 400, lambda rng: ())
    add("nothing, noise from the poses", 60, lambda rng: (), known=False)
    for multiple, count in ((2.0, 60), (4.0, 60)):
        add(f"one, noise from the poses, k = {multiple:g}", count, lambda rng: (str(rng.choice(everything)),),
            (multiple,), known=False, temperature=True)  # fmt: skip
    for multiple, count in ((2.0, 160), (4.0, 60)):
        add(f"one, k = {multiple:g}", count, lambda rng: (str(rng.choice(everything)),), (multiple,), temperature=True)
    add("two, k = 3", 60, lambda rng: tuple(map(str, rng.choice(everything, 2, replace=False))), (3.0, 3.0),
        temperature=True)  # fmt: skip
    for multiple, count in ((4.0, 40), (8.0, 40)):
        strange = [name for name in hidden.OUTSIDE if name != NEARLY]
        add(f"outside, k = {multiple:g}", count, lambda rng, names=strange: (str(rng.choice(names)),), (multiple,),
            temperature=True)  # fmt: skip
    add("outside, all but a cubic, k = 8", 10, lambda rng: (NEARLY,), (8.0,), temperature=True)
    add("blind", 10, lambda rng: (str(rng.choice(hidden.BLIND)),), (0.0,))
    ties = [tie for tie in hidden.TIES if not tie.inner]
    add(TIE, 20, lambda rng: ties[int(rng.integers(len(ties)))].hidden, (4.0,), temperature="linear")
    add(LIMIT, 60, lambda rng: (str(rng.choice(everything)),), (1.0,), temperature=True)
    # at the size that is printed, which nine of ten should pass
    add(AT_PRINTED, 100, lambda rng: (str(rng.choice(everything)),), PRINTED, temperature=True)
    add(SETTLED, 20, lambda rng: ties[int(rng.integers(len(ties)))].hidden, (4.0,), temperature="linear")
    for suite, multiples in zip(SEVERAL, ((4.0,) * 3, (8.0, 1.5)), strict=True):
        add(suite, 40, lambda rng, each=multiples: tuple(map(str, rng.choice(everything, len(each), replace=False))),
            multiples, temperature=True)  # fmt: skip
    return found


def judge(suite, results):
    """Figures of a suite: hits and trials of each claim."""
    claims = defaultdict(list)
    for each in results:
        truth, named = set(each["hidden"]), each["named"]
        sets = [{name, *rivals} for name, rivals in zip(named, each["rivals"], strict=True)]
        detected = each["verdict"] not in ("adequate", "refused")
        if suite.startswith(("nothing", "blind")):
            claims["adequate"].append(each["verdict"] == "adequate")
            if suite == "blind":
                claims["said to be not observable"].append(bool(each["blind"]))
        elif suite.startswith("one"):
            claims["detected"].append(detected)
            claims["named first"].append(bool(named) and named[0] in truth)
            claims["in the set"].append(bool(sets) and bool(truth & sets[0]))
            claims["named alone"].append(each["verdict"] == "effects" and len(named) == 1 and named[0] in truth)
        elif suite.startswith("two"):
            claims["exact pair"].append(each["verdict"] == "effects" and set(named) == truth)
            claims["pair within the sets"].append(
                len(sets) == 2 and all(any(name in each_set for each_set in sets) for name in truth)
            )
            claims["at least one right"].append(bool(truth & set(named)))
        elif suite in SEVERAL:
            claims["first, one of them"].append(bool(sets) and bool(truth & sets[0]))
            claims["all named, and nothing else"].append(set(named) == truth)
            claims["all within the sets"].append(
                len(sets) == len(truth) and all(any(name in each_set for each_set in sets) for name in truth)
            )
            claims["a wrong name, none of whose rivals is right"].append(any(not truth & each_set for each_set in sets))
            claims["unexplained"].append(each["verdict"] == "unexplained")
        elif suite.startswith("outside"):
            claims["unexplained"].append(each["verdict"] == "unexplained")
            claims["a wrong single name"].append(each["verdict"] == "effects" and len(named) == 1)
        elif suite.startswith("tie"):
            wanted = next(set(tie.hidden) | set(tie.twins) for tie in hidden.TIES if set(tie.hidden) == truth)
            claims["truth in name or its rivals"].append(bool(sets) and bool(truth & sets[0]))
            if suite == TIE:
                claims["all of the tie declared"].append(bool(sets) and wanted <= sets[0])
            else:
                claims["truth named"].append(named == list(each["hidden"]))
    return {claim: (int(sum(hits)), len(hits)) for claim, hits in claims.items()}


def main():
    """Run all suites in two processes and keep the table."""
    options = arguments(__doc__, limit="the suites at the detection limit alone", outside="those outside the catalogue",
                        several="those of several effects, weak ones among them")  # fmt: skip
    chosen = {"_at_limit": options.limit, "_outside": options.outside, "_several": options.several}
    alone = next((name for name, wanted in chosen.items() if wanted), "")
    suites = {"": "", "_at_limit": (LIMIT, AT_PRINTED), "_outside": "outside", "_several": SEVERAL}[alone]
    todo = [each for each in tasks(options.small) if each[0].startswith(suites)]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        done = [each for each in pool.map(trial, todo, chunksize=4) if each is not None]
    table = Table("Effects hidden by an outside simulator", ["suite", "claim", "rate, 95 % bounds", "trials"])
    worst = Table("One effect hidden, by effect", ["effect", "trials", "named first", "in the set", "taken for"])
    figures = {}
    for suite in dict.fromkeys(task[0] for task in todo):
        results = [each for each in done if each["suite"] == suite]
        for claim, (hits, count) in judge(suite, results).items():
            table.add(suite, claim, share(hits, count), count)
            figures[f"{suite}: {claim}"] = [hits, count]
        sizes = [1 + len(each["rivals"][0]) for each in results if each["named"]]
        if suite.startswith("one") and sizes:
            table.add(suite, "mean size of the set", f"{np.mean(sizes):.2f}", len(sizes))
            figures[f"{suite}: size of the set"] = float(np.mean(sizes))
        held = [each["heldout"] for each in results if each["heldout"] and each["gain_data"] == "another recording"
                and each["verdict"] == "effects"]  # fmt: skip
        if suite.startswith("one") and held:
            before, after = (np.median([each[place] / each[2] for each in held]) for place in (0, 1))
            inside = [chi2.ppf(0.005, each[2]) < each[1] < chi2.ppf(0.995, each[2]) for each in held]
            table.add(suite, "held-out χ²/dof, median", f"{before:.2f} → {after:.2f}", len(held))
            table.add(suite, "held-out χ² inside its 99 % interval", share(sum(inside), len(inside)), len(inside))
            figures[f"{suite}: held-out"] = [float(before), float(after), int(sum(inside)), len(inside)]
    by_effect = defaultdict(list)
    for each in done:
        if each["suite"].startswith("one"):
            by_effect[each["hidden"][0]].append(each)
    for name, results in sorted(
        by_effect.items(), key=lambda item: np.mean([e["named"][:1] == [item[0]] for e in item[1]])
    ):
        first = sum(each["named"][:1] == [name] for each in results)
        inside = sum(bool(each["named"]) and name in {each["named"][0], *each["rivals"][0]} for each in results)
        wrong = Counter(each["named"][0] if each["named"] else each["verdict"] for each in results
                        if each["named"][:1] != [name])  # fmt: skip
        worst.add(
            name, len(results), first, inside, ", ".join(f"{other} ({count})" for other, count in wrong.most_common(3))
        )
    figures["seconds a trial"] = float(np.median([each["seconds"] for each in done]))
    figures["trials"] = done
    for each in done:
        if each["verdict"] == "refused":
            print(f"{each['suite']}, seed {each['seed']}, {', '.join(each['hidden'])}: {each['reason']}")
    tables = [table, worst] if by_effect else [table]
    finish(f"diagnosis{alone}", tables, figures, keep=not options.small, script="diagnosis")


if __name__ == "__main__":
    main()
