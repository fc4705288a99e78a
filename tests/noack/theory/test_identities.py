import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.theory.paper.error_bounds import MissedEvents, missed_sum

PERIOD_NS = 1_000_000
H = np.array([[-0.3, 1.0, 0.2], [-2.0, -0.1, 0.0], [0.5, 0.0, 0.4]])
GROWTH = max(float(np.linalg.norm(expm(H * t), 2)) for t in np.linspace(0, 13 * 0.4, 100))


@st.composite
def histories(draw: st.DrawFn) -> list[tuple[int, bool, int]]:
    """(periods since the measurement before, whether it is an event, newest update received)."""
    measurements, events, newest = [], 0, -1
    for _ in range(draw(st.integers(1, 12))):
        is_event = draw(st.booleans())
        events += is_event
        newest = max(newest, draw(st.integers(-1, events - 1)))  # includes packets out of order
        measurements.append((draw(st.integers(0, 400)), is_event, newest))
    return measurements


@given(histories(), st.integers(1, 12), st.integers(0, 2**32))
def test_the_sum_is_the_sum_of_the_propagated_jumps(
    history: list[tuple[int, bool, int]], at_once: int, seed: int
) -> None:
    waits, is_event, received = (np.array(column) for column in zip(*history, strict=True))
    t_ns = np.cumsum(waits) * PERIOD_NS
    events = np.where(is_event, np.cumsum(is_event) - 1, -1)
    e_s = np.random.default_rng(seed).uniform(-1, 1, (len(history), 3))
    missed = MissedEvents(H, PERIOD_NS)
    for first in range(0, len(history), at_once):
        part = slice(first, first + at_once)
        found = missed_sum(
            missed.take(t_ns[part], e_s[part], events[part], received[part]), *e_s[part].shape
        )
        for place, total in enumerate(found, first):
            expected = np.zeros(3)
            for then in np.flatnonzero(events[: place + 1] > received[place]):
                expected += expm(H * (t_ns[place] - t_ns[then]) * 1e-9) @ e_s[then]
            # Twelve terms with at most twelve roundings of about 1e-15 each, and their growth.
            np.testing.assert_allclose(total, expected, atol=1e-12 * GROWTH)
