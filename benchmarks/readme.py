"""Fill the README's table of figures, and the list of results here, from the files in `results/`.

`python benchmarks/readme.py` writes both; `tests/test_documents.py` fails where they differ from what it would write.
"""

import json
import re
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
RESULTS = HERE / "results"


def result(name: str) -> dict[str, Any]:
    """Return the figures of a benchmark as its last run kept them."""
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def share(hits: int, trials: int) -> str:
    """Return a rate in percent, with its count."""
    return f"{100 * hits / trials:.3g} % of {trials}"


def intervals(drift: str, source: str, group: str) -> str:
    """Return the shares of 95 % intervals by hand that hold, of both sensors."""
    table = result("intervals")
    shares = [
        table[f"24 poses by hand, {drift}, {source}, {triad}, {group}"][1] for triad in ("accelerometer", "gyroscope")
    ]
    return " and ".join(f"{100 * part:.0f} %" for part in shares)


def figures() -> list[tuple[str, str, str, str]]:
    """Return the figures that matter: what, measured, goal, and the table that they are from."""
    xsens, explained = result("xsens")["joint"], result("real_diagnosis")["imu_tk's Xsens"]["effects"][0]["improvement"]
    hidden, quiet = result("diagnosis"), result("false_alarms")["trials"]
    trials = result("diagnosis_trials")["trials"]
    lag = [each for each in trials if each["cell"].startswith("e: lag")]
    mistakes = result("mistakes")["mistakes"].values()
    fleet, start = result("fleet")["seconds_per_unit"], result("start")["cases"]
    units = result("thermal_histories")["units"]
    steady = sum(max(unit["left"]) <= 1.1 for unit in units)
    reference = [each["after"] for name, each in result("reference").items() if name.startswith("PSINS")]
    field = result("magnetometer_measured")["HMC5883L beside an MPU-6050"]["norm_spread"]
    found = hidden["one, k = 2: named first"]
    acceptance, outside = result("acceptance"), result("trials")
    guarded, bias = acceptance["guard_bands"]["guarded 0.05 known"], acceptance["gauge"]["accelerometer bias"]
    return [
        ("gravity carried over a turn that the fit left out, imu_tk's Xsens recording (imu_tk, all turns: 0.517°)",
         f"{xsens['angle_rms_held_out']:.3f}°", "≤ 0.517°", "xsens"),
        ("the same recording, diagnosed: χ² per condition left out, before and after",
         f"{explained['heldout_chi_squared_before']:.1f} → {explained['heldout_chi_squared_after']:.1f}", "≤ 1.1",
         "real_diagnosis"),
        ("an effect of twice its 90 % detection limit, ranked first, of 38 kinds", share(*found), "99 %",
         "diagnosis"),
        ("hidden effect of just the size that a diagnosis prints as its detection limit, noticed",
         share(*result("diagnosis_at_limit")["one, at the printed limit: detected"]), "90 %", "diagnosis_at_limit"),
        ("false alarms where nothing is hidden, over noise, rates and poses",
         share(sum(each["verdict"] != "adequate" for each in quiet), len(quiet)), "3 to 7 %", "false_alarms"),
        ("recordings with strong drift, outliers, sway, lag, jumps or lost samples, diagnosed rightly",
         f"{share(sum(each['right'] for each in trials), len(trials))} (lag alone: "
         f"{share(sum(each['right'] for each in lag), len(lag))})", "lag 97 %", "diagnosis_trials"),
        ("95 % intervals of `calibrate` that hold the bias's mean over the recording, both sensors, flicker",
         intervals("flicker", "the recording", "bias in the recording"), "93 to 97 %", "intervals"),
        ("the same after the recording, noise from half an hour at rest (with a random walk)",
         f"{intervals('flicker', 'half an hour at rest', 'bias after it')} "
         f"({intervals('random walk', 'half an hour at rest', 'bias after it')})", "93 to 97 %", "intervals"),
        ("everyday mistake put into a measured recording, named",
         share(sum(each["measured_named"] for each in mistakes), sum(each["measured"] for each in mistakes)), "95 %",
         "mistakes"),
        ("small recordings of what went wrong on other people's logs, answered rightly",
         f"{outside['right']} of {len(outside['trials'])}", "all", "trials"),
        ("rate error against fibre optics on the half not fitted (PSINS)",
         " and ".join(f"{each:.3f}" for each in reference) + " °/s", "< 0.040 °/s", "reference"),
        ("places of eight measured units on a board, against its drawing (18.9 mm a side)",
         f"{result('arrays')['board']['position_rms_mm']:.2f} mm rms", "", "arrays"),
        ("field strength of an HMC5883L on parts left out (as logged; algebraic ellipsoid)",
         f"{100 * field['after']:.2f} % ({100 * field['before']:.1f} %; {100 * field['algebraic']:.2f} %)", "",
         "magnetometer_measured"),
        ("any history of temperature: another recording within 1.1 times its noise once corrected",
         share(steady, len(units)), "95 of 100", "thermal_histories"),
        ("units exactly at a limit that pass, guarded, at a stated risk of 5 %",
         share(guarded["accepted"], guarded["count"]), "4.6 to 5.4 %", "acceptance"),
        ("accelerometer's bias: scatter over sessions in stated uncertainties; less what a session does to all units",
         f"{bias['observed_over_stated']:.1f}; {bias['within_session']:.2f}",
         "1", "acceptance"),
        ("joint fit of a unit in a fleet; speed-up over SciPy",
         f"{1e3 * fleet['jaximu, both triads']:.1f} ms, "
         f"{fleet['scipy, both triads'] / fleet['jaximu, both triads']:.1f} times", "20 times", "fleet"),
        ("`jaximu calibrate`, 51 000 rows, relative to importing JAX: compiled before; for the first time",
         f"{start['calibrate --json']['ratio']:.1f}; {start['calibrate --json, empty cache']['ratio']:.1f}", "1.3; 4",
         "start"),
    ]  # fmt: skip


def table() -> str:
    """Return the README's table."""
    lines = ["| figure | measured | goal | table |", "| --- | --- | --- | --- |"]
    lines += [
        f"| {what} | {value} | {goal} | [{name}](benchmarks/results/{name}.md) |"
        for what, value, goal, name in figures()
    ]
    return "\n".join(lines)


def listing() -> str:
    """Return a line for every table in `results/`: what it shows, when and at which commit it was measured."""
    lines = ["| table | shows | measured |", "| --- | --- | --- |"]
    for path in sorted(RESULTS.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        title = re.search(r"^\*\*(.+?)\*\*$", text, re.MULTILINE)
        when = re.search(r"^Measured\b.*?(\d{4}-\d\d-\d\d)", text, re.MULTILINE)
        commit = re.search(r", commit (\S+?),", text)
        assert title and when, path
        measured = when[1] + (f", {commit[1]}" if commit else "")
        lines.append(f"| [{path.stem}](results/{path.name}) | {title[1]} | {measured} |")
    return "\n".join(lines)


def filled(page: str, name: str, text: str) -> str:
    """Return a page with what stands between the marks of that name replaced."""
    start, stop = f"<!-- {name} -->\n", f"\n<!-- /{name} -->"
    before, _, rest = page.partition(start)
    _, mark, after = rest.partition(stop)
    assert mark, f"the page has no marks {name}"
    return before + start + text + stop + after


def pages() -> dict[Path, str]:
    """Return each page that is filled, as it should be."""
    asked = ((HERE.parent / "README.md", "figures", table()), (HERE / "README.md", "results", listing()))
    return {path: filled(path.read_text(encoding="utf-8"), name, text) for path, name, text in asked}


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
