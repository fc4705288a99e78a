"""The rate of a certificate is the one with the fastest decay, though not all are tried."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from noack.theory.bounds.certificate_terms import NoCertificateError
from noack.theory.certificates.persistent_bounds import choose_rate

_X0 = np.array([0.6, 0.8])


def _chosen(states: dict[float, float]) -> tuple[float, list[float]]:
    """Return the chosen rate and those that were tried, for bounds of ‖x‖ by rate in 1/s."""
    tried = list[float]()

    def solved(rate_per_s: float) -> tuple[Any]:
        tried.append(rate_per_s)
        if rate_per_s not in states:
            raise NoCertificateError("none")
        return (SimpleNamespace(state=states[rate_per_s], rate_per_s=rate_per_s),)

    chosen = choose_rate(solved, 1.0, _X0, _X0[:, None])
    return chosen[0].rate_per_s, tried


def test_rates_that_cannot_be_faster_are_not_tried() -> None:
    assert _chosen({0.7: 1.5, 0.4: 1.0, 0.2: 1.0, 0.05: 1.0}) == (0.7, [0.7])


def test_a_smaller_rate_with_a_much_smaller_bound_is_chosen() -> None:
    assert _chosen({0.7: 40.0, 0.4: 1.5, 0.2: 1.0, 0.05: 1.0}) == (0.4, [0.7, 0.4])


def test_rates_without_a_certificate_are_passed_over() -> None:
    assert _chosen({0.05: 3.0}) == (0.05, [0.7, 0.4, 0.2, 0.05])


def test_without_any_certificate_the_reason_is_raised() -> None:
    with pytest.raises(NoCertificateError):
        _chosen({})
