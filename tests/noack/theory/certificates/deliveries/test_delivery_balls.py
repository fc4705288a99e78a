"""A return of the centres of balls, against least squares by hand."""

import math

import numpy as np
import pytest

from noack.theory.certificates.deliveries.delivery_balls import Ball, BallHistory


def test_the_return_of_a_decaying_rotation_is_the_best_one_by_hand() -> None:
    """For a delay m, least squares give κ = q^m cos φm, and a rest of |sin φm| ‖c(t)‖."""
    q, phi, size, times = 0.97, 2 * math.pi / 13.4, 0.01, np.arange(50)
    history = BallHistory.without_balls(len(times), 2)
    for time in times.tolist():
        centre = q**time * np.array([math.cos(phi * time), math.sin(phi * time)])
        history.add([Ball(centre, size, 0.0, size, 1.0, time)])
    delays = np.arange(5, 45)
    kappas = np.abs(q**delays * np.cos(phi * delays))
    rests = np.abs(np.sin(phi * delays)) * q**45 + size
    best = int((rests / (1 - kappas)).argmin())
    assert history.last_return(slice(45, 50)) == pytest.approx((kappas[best], rests[best]))


def test_centres_that_do_not_decay_do_not_return() -> None:
    history = BallHistory.without_balls(30, 1)
    history.add([Ball(np.array([1.01**time]), 0.0, 0.0, 0.0, 1.0, time) for time in range(30)])
    assert history.last_return(slice(25, 30)) is None
