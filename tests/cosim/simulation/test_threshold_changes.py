"""The threshold of a run whose α and β change: βe^(−∫α dt), without a jump when α changes."""

import numpy as np

import noack

CHANGES = [  # (from when on, β, α)
    (0.0, 0.5, 0.25),
    (2.001, 0.5, 3.0),  # between two measurements
    (3.0, 0.5, 0.1),
    (4.0, 1.5, 0.1),
    (4.5, 0.75, 0.4),
]


def expected(t_s: float) -> float:
    """β of the time, and e^(−α times of each α until then)."""
    ends = [*(begin for begin, _, _ in CHANGES[1:]), np.inf]
    exponent = sum(
        alpha * max(min(t_s, end) - begin, 0.0) for (begin, _, alpha), end in zip(CHANGES, ends, strict=True)
    )
    return float([beta for begin, beta, _ in CHANGES if begin <= t_s][-1] * np.exp(-exponent))


def test_a_change_of_alpha_counts_from_the_change_and_beta_sets_the_level() -> None:
    settings = {"trigger.beta": CHANGES[0][1], "trigger.alpha_per_s": CHANGES[0][2], "horizon_s": 6.0}
    changes = [
        {"at_s": begin, "set": {"trigger.beta": beta, "trigger.alpha_per_s": alpha}}
        for begin, beta, alpha in CHANGES[1:]
    ]
    run = noack.simulate(noack.load("lane_following", {**settings, "changes": changes}))
    samples = run.samples()
    t_s, threshold = (np.asarray(samples[name]) for name in ("t_s", "threshold"))
    sampled = np.flatnonzero(threshold > 0)
    assert len(sampled) > 2900
    np.testing.assert_allclose(threshold[sampled], [expected(t) for t in t_s[sampled]], rtol=1e-12)
    assert run.replay().bit_exact


def test_a_forecast_of_the_threshold_is_continued_likewise() -> None:
    """A rate that goes to nearly 0 at 1 s, instead of back to the threshold of the start."""
    rule = {
        "policy": "self_triggered", "beta": 0.5, "alpha_per_s": 2.0, "growth_per_s": 0.0,
        "mismatch_per_s": 0.0, "disturbance_per_s": 1.0, "shortest_s": 0.002, "longest_s": 1.0,
    }  # fmt: skip
    changes = [{"at_s": 1.0, "set": {"trigger.alpha_per_s": 1e-9}}]
    run = noack.simulate(
        noack.load("lane_following", {"trigger": rule, "horizon_s": 3.0, "changes": changes})
    )
    samples = run.samples()
    t_s, events = np.asarray(samples["t_s"]), np.asarray(samples["event"]) >= 0
    intervals = np.diff(t_s[events & (t_s > 1.2)])
    # The error grows by 1 per second up to 0.5 e^−2.
    np.testing.assert_allclose(intervals, 0.5 * np.exp(-2.0), atol=0.002)
