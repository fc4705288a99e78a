"""The threshold βe^{−αt}: sampling, delay, held inputs, and losses in bursts and windows.

The loops and their simulation are those of the tests (scipy's matrix exponential on a grid). The
losses are all patterns of six updates that the guarantee allows, repeated; random ones; and those
found by changing single outcomes of the worst run, as long as that makes it worse.
"""

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np

from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.terms import Constants, NoCertificateError
from tests.noack.theory.broken_certificates import MUTANTS
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.loops import (
    Flags,
    Steps,
    System,
    Trace,
    allowed,
    networks,
    random_system,
    simulate,
    times_s,
)

_REPEATED = 6
_OBJECTIVES = ("controller_error", "state")
_ROUNDS = 2
"""Rounds of changes of the worst run, for each of the objectives."""
_CHANGED = 32
"""Number of its first updates whose outcomes are changed."""


def bounds_of(found: Constants, beta: float) -> Bounds:
    """The constants that are compared, with the reciprocal of the inter-event time."""
    return {
        "e_s": found.overshoot * beta,
        "e_c": found.delta * beta,
        "x": found.state,
        "u − Kx": found.input_error,
        "1/δ": 1 / (found.inter_event_s or 1e-300),
    }


def certified_by(certify: Callable[[System], Constants]) -> Callable[[System], Bounds | None]:
    """The bounds of a certificate; None if there is none."""

    def bounds(system: System) -> Bounds | None:
        try:
            return bounds_of(certify(system), system.beta)
        except (NoCertificateError, NotDecayingError):
            return None

    return bounds


def search(
    system: System,
    rng: np.random.Generator,
    run: Callable[[System, Flags, Steps], Trace] = simulate,
    worst_of: Callable[[System, Trace], dict[str, float]] | None = None,
) -> Observed:
    """Simulate repeated, random and improved patterns of losses.

    ``run`` simulates outcomes and delays, ``worst_of`` returns what is compared with the bounds.
    """
    worst_of = worst_of or _worst
    repeated = np.array(list(product([False, True], repeat=_REPEATED)))
    times = -(-system.events // _REPEATED)
    lost = allowed(np.tile(repeated, times)[:, : system.events], system)
    at_random, delays = networks(int(rng.integers(2**32)), system)
    outcomes = np.concatenate([~np.unique(lost, axis=0), at_random])
    slowest = np.full((len(outcomes) - len(delays), system.events), system.delay_steps)
    delays = np.concatenate([slowest, delays])
    trace = run(system, outcomes, delays)
    runs, worst = len(outcomes), worst_of(system, trace)
    pairs = np.arange(_CHANGED)
    for _ in range(_ROUNDS):
        best = np.repeat([_best(system, trace, name) for name in _OBJECTIVES], _CHANGED)
        outcomes, delays = outcomes[best], delays[best]
        for first in range(0, len(best), _CHANGED):
            outcomes[first + pairs, pairs] ^= True
        outcomes = ~allowed(~outcomes, system)
        trace = run(system, outcomes, delays)
        runs += len(outcomes)
        worst = {name: max(value, worst[name]) for name, value in worst_of(system, trace).items()}
    return Observed(runs, worst)


def _best(system: System, trace: Trace, objective: str) -> int:
    growth = np.exp(system.alpha * times_s(system))
    return int((growth * getattr(trace, objective)).max(axis=1).argmax())


def _worst(system: System, trace: Trace) -> dict[str, float]:
    growth = np.exp(system.alpha * times_s(system))
    signals = {
        "e_s": trace.sensor_error, "e_c": trace.controller_error, "x": trace.state,
        "u − Kx": trace.input_error,
    }  # fmt: skip
    scaled = {name: float((growth * values).max()) for name, values in signals.items()}
    return scaled | {"1/δ": 1 / trace.inter_event_s}


DECAYING = Kind(
    "decaying", random_system, certified_by(System.certify), search,
    {
        name: Broken(certified_by(certify), partial(random_system, **where))
        for name, (certify, where) in MUTANTS.items()
    },
)  # fmt: skip
