import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from noack.theory.paper.error_bounds import ModelDifference

H = np.array([[-0.3, 1.0, 0.2], [-2.0, -0.1, 0.0], [0.5, 0.0, 0.4]])
GROWTH = max(float(np.linalg.norm(expm(H * t), 2)) for t in np.linspace(0, 13 * 0.4, 100))


@st.composite
def histories(draw: st.DrawFn) -> list[tuple[int, int | None]]:
    """(time since the last event, sequence number received then or None) of successive events."""
    steps = []
    for sequence in range(draw(st.integers(1, 12))):
        received = draw(st.none() | st.integers(0, sequence))  # includes packets out of order
        steps.append((draw(st.integers(0, 400_000_000)), received))
    return steps


@given(histories(), st.integers(0, 400_000_000), st.integers(0, 2**32))
def test_the_sum_is_the_sum_of_the_propagated_jumps(
    history: list[tuple[int, int | None]], after_ns: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    missed = ModelDifference(H)
    jumps: list[tuple[int, np.ndarray]] = []
    t_ns, newest = 0, -1
    for sequence, (wait_ns, received) in enumerate(history):
        t_ns += wait_ns
        missed.advance_to(t_ns)
        e_s = rng.uniform(-1, 1, 3)
        jumps.append((t_ns, e_s))
        missed.event(sequence, e_s)
        if received is not None:
            missed.received(received)
            newest = max(newest, received)
    t_ns += after_ns
    missed.advance_to(t_ns)
    expected = np.zeros(3)
    for then_ns, e_s in jumps[newest + 1 :]:
        expected += expm(H * (t_ns - then_ns) * 1e-9) @ e_s
    # Twelve terms with at most twelve roundings of about 1e-15 each, and their maximum growth.
    np.testing.assert_allclose(missed.total(), expected, atol=1e-12 * GROWTH)
