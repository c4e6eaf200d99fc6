"""The gate of benchmarks/suite.py: what it calls a regression, and that it says so."""

import importlib.util
import json
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def suite(monkeypatch, tmp_path):
    """The script, with a baseline of the test's own and figures made up."""
    for name in ("JAX_PLATFORMS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC", "PJRT_NPROC"):
        monkeypatch.setenv(name, "")  # the script limits threads: put back afterwards
    monkeypatch.syspath_prepend(str(FOLDER))
    spec = importlib.util.spec_from_file_location("suite", FOLDER / "suite.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, "suite", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "BASELINE", tmp_path / "baseline.json")
    monkeypatch.setattr(module, "finish", lambda *_, **__: None)
    monkeypatch.setattr(module, "measured", {name: 2.0 for name in module.METRICS}, raising=False)
    monkeypatch.setattr(module, "measure", lambda profiles: dict(module.measured))
    return module


def test_what_a_regression_is(suite):
    baseline = {
        "low": {"value": 1.0, "unit": "u", "better": "lower", "tolerance": 0.2},
        "high": {"value": 50.0, "unit": "u", "better": "higher", "tolerance": 0.2},
    }
    assert suite.regressions({"low": 1.19, "high": 50 / 1.19}, baseline) == []
    assert suite.regressions({"low": 0.1, "high": 500.0}, baseline) == []  # better is no regression
    (said,) = suite.regressions({"low": 1.25, "high": 50.0}, baseline)
    assert said.startswith("low: 1.25 u, 25 % worse than 1")
    (said,) = suite.regressions({"low": 1.0, "high": 40.0}, baseline)
    assert said.startswith("high: 40 u, 25 % worse than 50")
    (said,) = suite.regressions({"low": 1.0}, baseline)
    assert said == "high: was not measured, the baseline has 50."
    (said,) = suite.regressions({"low": 1.0, "high": 50.0, "new": 3.0}, baseline)
    assert said.startswith("new: has no baseline")
    assert suite.regressions({"low": float("nan"), "high": 50.0}, baseline)


def test_update_then_gate(suite, capsys):
    assert suite.main(["--gate"]) == 1
    assert "no baseline" in capsys.readouterr().err
    assert suite.main(["--update"]) == 0
    written = json.loads(suite.BASELINE.read_text(encoding="utf-8"))
    assert set(written["metrics"]) == set(suite.METRICS) and written["machine"]["cores"]
    assert suite.main(["--gate"]) == 0
    suite.measured["command"] = 3.0
    del suite.measured["csv"]
    assert suite.main(["--gate"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2 and said[0].startswith("command: 3") and said[1].startswith("csv: was not measured")
    assert suite.main([]) == 0  # measuring alone judges nothing


def test_the_committed_baseline_is_of_these_metrics(suite):
    committed = json.loads((FOLDER / "baseline.json").read_text(encoding="utf-8"))["metrics"]
    assert set(committed) == set(suite.METRICS)
    for name, metric in suite.METRICS.items():
        assert committed[name]["value"] > 0
        assert (committed[name]["better"], committed[name]["unit"]) == (metric.better, metric.unit)
