"""Root mean squares, medians, tails of distributions: by SciPy's functions, as `scipy.stats` takes longer to load."""

import numpy as np
import scipy


def rms(values, axis=None):
    """Return the root mean square of numbers of any shape, over all of them or an axis."""
    return np.sqrt(np.square(values).mean(axis=axis))


def robust_sigma(errors, axis=None):
    """Return the standard deviation that normal errors (n, …) of their median size have."""
    return 1.4826 * np.median(np.abs(errors), axis=axis)


def chi2_sf(value, freedom):
    """Return the probability that χ² of so many degrees of freedom exceeds a value."""
    return scipy.special.gammaincc(np.asarray(freedom) / 2, np.maximum(value, 0.0) / 2)


def chi2_isf(probability, freedom):
    """Return the value that χ² of so many degrees of freedom exceeds with a probability."""
    return 2 * scipy.special.gammainccinv(np.asarray(freedom) / 2, probability)


def deviation_interval(freedom, confidence=0.95):
    """Return the ends (2, …) of the interval of a standard deviation, over its estimate with so many degrees."""
    tail = (1 - confidence) / 2
    return np.sqrt([freedom / chi2_isf(p, freedom) for p in (tail, 1 - tail)])


def noncentral_chi2_sf(value, freedom, noncentrality):
    """Return the probability that noncentral χ² exceeds a value: the power of a test."""
    return 1 - scipy.special.chndtr(value, freedom, noncentrality)


def normal_sf(value):
    """Return the probability that a standard normal number exceeds a value."""
    return scipy.special.ndtr(-np.asarray(value))


def normal_isf(probability):
    """Return the value that a standard normal number exceeds with a probability."""
    return -scipy.special.ndtri(probability)


def f_tails(value, first, second):
    """Return the probabilities that a ratio of variances of so many degrees of freedom lies below and above a value.

    An infinite second number stands for a variance that is known.
    """
    if np.isinf(second):
        return scipy.special.gammainc(first / 2, first * value / 2), scipy.special.gammaincc(
            first / 2, first * value / 2
        )
    return scipy.special.fdtr(first, second, value), scipy.special.fdtrc(first, second, value)


def chi2_median(freedom):
    """Return the median of χ² of so many degrees of freedom."""
    return 2 * scipy.special.gammaincinv(np.asarray(freedom) / 2, 0.5)


def gamma_mean_sf(value, count):
    """Return the probability that the mean of so many exponential numbers of mean one exceeds a value."""
    return scipy.special.gammaincc(count, count * np.asarray(value))


def kolmogorov_sf(values) -> tuple[float, float]:
    """Return Kolmogorov's distance of numbers from the standard normal law, and its p-value.

    The asymptotic law with Stephens's correction for few numbers (Journal of the Royal Statistical Society B 32, 1970).
    """
    ranked = scipy.special.ndtr(np.sort(values))
    count = len(ranked)
    distance = float(max((np.arange(1, count + 1) / count - ranked).max(), (ranked - np.arange(count) / count).max()))
    return distance, float(scipy.special.kolmogorov((np.sqrt(count) + 0.12 + 0.11 / np.sqrt(count)) * distance))


def student_cdf(value, freedom):
    """Return the probability that Student's t of so many degrees of freedom (infinite: normal) is at most a value."""
    freedom = np.asarray(freedom, float)
    few = scipy.special.stdtr(np.where(np.isinf(freedom), 1.0, freedom), value)
    return np.where(np.isinf(freedom), scipy.special.ndtr(value), few)


def student_two_sided(value, freedom):
    """Return the probability that Student's t (see `student_cdf`) is as far from zero as a value."""
    return 2 * student_cdf(-np.abs(value), freedom)


def student_isf(probability, freedom):
    """Return the value that Student's t of so many degrees of freedom (infinite: normal) exceeds with a probability."""
    freedom = np.asarray(freedom, float)
    few = -scipy.special.stdtrit(np.where(np.isinf(freedom), 1.0, freedom), probability)
    return np.where(np.isinf(freedom), normal_isf(probability), few)


def holm(p_values):
    """Return p-values (n,) with all n questions allowed for (Holm, Scandinavian Journal of Statistics 6, 1979)."""
    order = np.argsort(p_values)
    adjusted = np.ones(len(order))
    stepped = np.asarray(p_values, float)[order] * np.arange(len(order), 0, -1)
    adjusted[order] = np.maximum.accumulate(np.minimum(stepped, 1.0))
    return adjusted
