"""What CONTRIBUTING.md shows is a whole effect: its file, run as it stands, is simulated, described and removed."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaximu.cli import main
from jaximu.effects import CATALOGUE
from jaximu.formats import read_recording
from jaximu.sensor import Stimulus, Triad

PAGE = Path(__file__).parents[1] / "CONTRIBUTING.md"


def test_the_new_effect_of_the_contributing_page(monkeypatch, tmp_path, capsys):
    found = re.search(r"<!-- new-effect -->\n```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found
    assert len([line for line in found[1].splitlines() if line.strip()]) <= 10
    scope: dict = {"__name__": "quartic"}
    exec(found[1], scope)
    (kind,) = scope["EFFECTS"]
    monkeypatch.setitem(CATALOGUE, kind.name, kind)

    assert main(["effects", kind.name]) == 0
    assert kind.formula in capsys.readouterr().out
    triad = Triad(jnp.eye(3), jnp.zeros(3), (kind.make(10 * kind.typical),), "angular_rate", "rad/s")
    rate = jnp.array([2.0, -3.0, 4.0])
    output = triad.respond(Stimulus(angular_rate=rate))
    np.testing.assert_allclose(output - rate, 1e-4 * np.array([16.0, 81.0, 256.0]))
    np.testing.assert_allclose(triad.recover(output), rate, atol=1e-9)
    spec = '[protocol]\nkind = "hand-held"\nposes = 3\npose_duration = 1\n[effects."gyro.quartic"]\ncoefficients = {}\n'
    for size in (0, 1e-3):
        (tmp_path / "spec.toml").write_text(spec.format(size))
        assert main(["simulate", str(tmp_path / "spec.toml"), "-o", str(tmp_path / f"{size}.parquet")]) == 0
    plain, flawed = (read_recording(tmp_path / f"{size}.parquet").gyroscope.values for size in (0, 1e-3))
    np.testing.assert_allclose(flawed - plain, 1e-3 * plain**4, atol=1e-12)
