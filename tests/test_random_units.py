"""Forty random units, every verb and chain among them: what a user gets is sound, whatever is asked of whichever unit.

Two thousand of them: benchmarks/results/random_units.md. A draw that fails is run again by
`python tests/random_units.py SEED`.
"""

import pytest
import random_units

SEEDS = (1, 2, 3)
"""Draws of few seconds, chosen so that every recipe is among them."""


@pytest.mark.parametrize("seed", SEEDS)
def test_a_random_unit(seed, tmp_path):
    draw = random_units.run_draw(seed, tmp_path / "draw")
    failures = [f"{failure.kind}: {failure.run}: {failure.text}" for failure in draw.failures]
    assert not failures, "\n".join([draw.line, "jaximu " + " ".join(draw.last), *failures])
