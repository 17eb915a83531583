"""Quantiles of the chi-square distribution, the limits of all gates."""

from functools import cache

from scipy.special import gammaincinv


@cache
def quantile(probability: float, dof: int) -> float:
    """A quantile of chi-square, by the special function."""
    return 2.0 * float(gammaincinv(0.5 * dof, probability))
