"""What is estimated after a choice among models: its intervals allow for those that the data do not exclude."""

import numpy as np
import pytest
from scipy.stats import binom, norm

from jaximu.diagnosis.choice import _half_width, _numbers, open_choice
from jaximu.diagnosis.evidence import EffectBlock, Evidence, limit_noncentrality
from jaximu.diagnosis.selection import causes_of, select
from jaximu.ground.quantities import Z95

CONDITIONS, NUMBERS, DRAWS = 80, 4, 300


def questions(random: np.random.Generator) -> tuple[np.ndarray, list[EffectBlock]]:
    """A linear problem, and effects that its numbers imitate in good part."""
    jacobian = random.standard_normal((CONDITIONS, NUMBERS)) / np.sqrt(CONDITIONS)
    blocks = []
    for k in range(6):
        size = 1 + k % 3
        columns = random.standard_normal((CONDITIONS, size)) / np.sqrt(CONDITIONS)
        mixed = columns + 0.7 * jacobian @ random.standard_normal((NUMBERS, size))
        blocks.append(EffectBlock(f"effect {k}", mixed, np.ones(size)))
    return jacobian, blocks


def coverage(multiple: float) -> tuple[float, float, float]:
    """Share of 95 % intervals that hold, by the chosen model's covariance and by all models', and how many."""
    random = np.random.default_rng(5)
    jacobian, blocks = questions(random)
    law = Evidence(np.zeros(CONDITIONS), jacobian, blocks)
    alone, together, named = [], [], 0
    for draw in range(DRAWS):
        hidden = law.columns[:, law.place(draw % len(blocks))]
        direction = random.standard_normal(hidden.shape[1])
        length = multiple * np.sqrt(limit_noncentrality(hidden.shape[1])) / np.linalg.norm(hidden @ direction)
        signal = blocks[draw % len(blocks)].columns @ direction * length
        conditions = signal + random.standard_normal(CONDITIONS)
        evidence = Evidence(conditions, jacobian, blocks)
        evidence.null = law.null
        chosen = [blocks[cause.block].name for cause in select(evidence).causes]
        change, sigma = _numbers(evidence, [cause.block for cause in causes_of(evidence, chosen)])
        error = np.abs(change - evidence.inverse @ conditions)
        alone.append(error < Z95 * sigma)
        together.append(error < Z95 * np.sqrt(sigma**2 + open_choice(evidence, chosen)))
        named += chosen == [blocks[draw % len(blocks)].name]
    return float(np.mean(alone)), float(np.mean(together)), named / DRAWS


@pytest.mark.parametrize("multiple", [0.0, 1.0, 3.0])
def test_intervals_hold_whatever_the_tests_chose(multiple):
    """Hidden effects of so many detection limits. A draw's numbers err together: only draws count as independent."""
    alone, together, named = coverage(multiple)
    low, high = binom.ppf([0.005, 0.995], DRAWS, 0.95) / DRAWS
    assert low <= together <= high and alone < together
    assert named < 0.05 if multiple == 0.0 else named > 0.8


def test_below_the_limit_most_of_what_the_choice_leaves_open_is_allowed_for():
    """Where two in three hidden effects are missed, each of which moves every number here: the worst size."""
    alone, together, named = coverage(0.6)
    assert 0.2 < named < 0.5
    assert 1 - together < (1 - alone) / 2


def test_one_model_has_its_own_interval_and_a_mixture_that_of_all():
    sigmas = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(_half_width(np.ones(1), np.zeros((1, 3)), sigmas), Z95 * sigmas[0], rtol=1e-9)
    weights, centres, spread = np.array([0.7, 0.3]), np.array([[0.0], [4.0]]), np.array([[1.0], [0.5]])
    (half,) = _half_width(weights, centres, spread)
    random = np.random.default_rng(1)
    which = random.choice(2, 200_000, p=weights)
    drawn = centres[which, 0] + spread[which, 0] * random.standard_normal(len(which))
    assert np.mean(np.abs(drawn) < half) == pytest.approx(2 * norm.cdf(Z95) - 1, abs=0.002)
