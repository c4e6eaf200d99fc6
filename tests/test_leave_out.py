"""What is left out is predicted as a fit to all other rows would predict it, noise that they share included."""

import numpy as np
import pytest

from jaximu.estimation.leave_out import further, leave_out, orthonormal


def whitening(covariance):
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


def drawn(seed: int, count: int = 30, size: int = 3):
    random = np.random.default_rng(seed)
    root = np.tril(0.3 * random.normal(size=(count, count))) + 2 * np.eye(count)
    return root @ root.T, random.normal(size=(count, size)), random.normal(size=count)


def by_hand(covariance, columns, output, rows):
    """Generalised least squares of all other rows, then the conditional mean of the rows given their residuals."""
    others = np.setdiff1d(np.arange(len(output)), rows)
    inverse = np.linalg.inv(covariance[np.ix_(others, others)])
    spread = np.linalg.inv(columns[others].T @ inverse @ columns[others])
    numbers = spread @ columns[others].T @ inverse @ output[others]
    share = covariance[np.ix_(rows, others)] @ inverse
    error = output[rows] - columns[rows] @ numbers - share @ (output[others] - columns[others] @ numbers)
    slope = columns[rows] - share @ columns[others]
    own = covariance[np.ix_(rows, rows)] - share @ covariance[np.ix_(others, rows)]
    return numbers, error, own + slope @ spread @ slope.T


def test_it_is_the_fit_to_all_other_rows():
    covariance, columns, output = drawn(1)
    weights = whitening(covariance)
    parts = [np.arange(5), np.array([3, 17, 29])]
    for part in leave_out(weights, weights @ columns, weights @ output, parts):
        numbers, error, spread = by_hand(covariance, columns, output, part.rows)
        np.testing.assert_allclose(part.numbers, numbers, rtol=1e-8)
        np.testing.assert_allclose(part.errors, error, rtol=1e-8)
        np.testing.assert_allclose(part.covariance, spread, rtol=1e-8)
        np.testing.assert_allclose(part.chi_squared, error @ np.linalg.solve(spread, error), rtol=1e-8)
        assert not part.blind


def test_what_is_known_beforehand_counts_as_rows_that_stay():
    covariance, columns, output = drawn(2)
    weights = whitening(covariance)
    known = np.diag([0.1, 2.0, 30.0])
    rows = np.arange(10, 20)
    (part,) = leave_out(weights, np.vstack([weights @ columns, known]), np.append(weights @ output, [0, 0, 0]), [rows])
    whole = np.block([[covariance, np.zeros((30, 3))], [np.zeros((3, 30)), np.linalg.inv(known @ known)]])
    numbers, error, spread = by_hand(whole, np.vstack([columns, np.eye(3)]), np.append(output, [0, 0, 0]), rows)
    np.testing.assert_allclose(part.numbers, numbers, rtol=1e-8)
    np.testing.assert_allclose(part.errors, error, rtol=1e-8)
    np.testing.assert_allclose(part.covariance, spread, rtol=1e-8)


def test_what_the_others_do_not_determine_is_not_predicted():
    covariance, columns, output = drawn(3)
    weights = whitening(covariance)
    level = np.zeros(30)
    level[:6] = 1.0  # of the rows that are left out alone
    design = np.column_stack([columns, level])
    (part,) = leave_out(weights, weights @ design, weights @ output, [np.arange(30) < 6])
    assert part.blind and part.directions.shape == (6, 5)
    np.testing.assert_allclose(part.directions.T @ level[:6], 0.0, atol=1e-6)
    (moved,) = leave_out(weights, weights @ design, weights @ (output + 7 * level), [np.arange(30) < 6])
    np.testing.assert_allclose(moved.errors, part.errors, atol=1e-6)


@pytest.mark.parametrize("strength", [0.1, 1.0, 1e3])
def test_further_numbers_change_what_was_predicted_as_a_fit_with_them_would(strength):
    covariance, columns, output = drawn(4)
    weights, more = whitening(covariance), strength * np.random.default_rng(5).normal(size=(30, 4))
    whole, scored = np.arange(4, 15), np.arange(11) > 2
    (part,) = leave_out(weights, weights @ columns, weights @ output, [whole])
    basis, added = orthonormal(weights @ columns), weights @ more
    pull, step = further(weights, basis, weights @ output, added)
    errors, spread = part.beside(pull[whole], step)
    design = np.vstack([weights @ np.hstack([columns, more]), np.eye(7)[3:]])
    (anew,) = leave_out(weights, design, np.append(weights @ output, np.zeros(4)), [whole])
    np.testing.assert_allclose(errors, anew.errors, rtol=1e-7)
    np.testing.assert_allclose(spread, anew.covariance, rtol=1e-6)
    some = anew.only(scored)
    np.testing.assert_allclose(some.covariance, spread[np.ix_(scored, scored)], rtol=1e-6)
    white = np.linalg.solve(np.linalg.cholesky(some.covariance), some.errors)
    assert some.chi_squared == pytest.approx(white @ white, rel=1e-6)
