"""Random settings of a link, harsh ones above all."""

from hypothesis import strategies as st

from noack.config.impairments import (
    BernoulliLoss,
    Blackout,
    Corrupt,
    Delay,
    Duplicate,
    FourStateLoss,
    GilbertElliottLoss,
    LinkSettings,
    LossOf,
    PeriodicLoss,
    Rate,
    Reorder,
    ScriptedLoss,
    WorstCaseLoss,
)

probabilities = st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0])
correlations = st.sampled_from([0.0, 0.0, 0.7])
times_s = st.sampled_from([0.0, 1e-6, 0.0005, 0.004])

losses = st.one_of(
    st.builds(BernoulliLoss, probability=probabilities, correlation=correlations),
    st.builds(
        GilbertElliottLoss, good_to_bad=probabilities, bad_to_good=probabilities,
        loss_in_good=probabilities, loss_in_bad=probabilities,
    ),
    st.builds(
        FourStateLoss, p13=st.just(0.3), p31=st.just(0.4), p32=st.just(0.2), p14=st.just(0.1)
    ),
    st.builds(PeriodicLoss, period=st.integers(3, 9), burst=st.integers(0, 3)),
    st.builds(
        ScriptedLoss, lost=st.just((0, 1, 2, 5, 8, 9)), repeat_every=st.sampled_from([0, 11])
    ),
    st.just(WorstCaseLoss()),
)  # fmt: skip
delays = st.one_of(
    st.builds(
        Delay, delay_s=times_s, jitter_s=times_s, correlation=correlations,
        distribution=st.sampled_from(["uniform", "normal", "pareto", "paretonormal"]),
    ),
    st.builds(
        Delay, distribution=st.just("empirical"), samples_s=st.just((0.0, 0.001, 0.002, 0.009)),
    ),
)  # fmt: skip
impairments = st.one_of(
    st.builds(LossOf, loss=losses),
    delays,
    st.builds(Duplicate, probability=probabilities, correlation=correlations),
    st.builds(Corrupt, probability=st.sampled_from([0.0, 0.2, 0.8]), correlation=correlations),
    st.builds(Reorder, probability=probabilities, gap=st.integers(1, 4)),
    st.builds(
        Rate, rate_bps=st.sampled_from([5_000_000, 10**8, 10**9]), queue=st.sampled_from([1, 5, 50])
    ),
    st.just(Blackout(intervals_s=((0.0, 0.01), (0.02, 0.03)), every_s=0.05)),
)
settings = st.builds(
    LinkSettings,
    impairments=st.lists(impairments, max_size=5).map(tuple),
    mansd=st.sampled_from([None, 0, 1, 2, 5]),
    first_delivered=st.booleans(),
    limit=st.sampled_from([1, 20, 16_384]),
)
capped = st.builds(
    LinkSettings,
    impairments=st.lists(impairments, min_size=1, max_size=5).map(tuple),
    mansd=st.sampled_from([0, 1, 2, 5]),
    first_delivered=st.just(True),
    limit=st.sampled_from([1, 20, 16_384]),
)
