"""Hypothesis strategies for settings of a link: everything that is valid."""

from itertools import accumulate
from typing import Any

from hypothesis import strategies as st

from noack.config import impairments as imp

probabilities = st.floats(0, 1)
correlations = st.floats(0, 1, exclude_max=True)
times_s = st.floats(0, 3600)
counts = st.integers(1, 2**40)
files = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1).filter(
    lambda name: name not in ("uniform", "normal", "pareto", "paretonormal")
)


def _valid_gilbert_elliott(table: dict[str, Any]) -> bool:
    loss, burst = table.get("mean_loss"), table.get("mean_burst")
    return loss is None or loss / (1 - loss) <= burst


gilbert_elliott = st.one_of(
    st.fixed_dictionaries(
        dict.fromkeys(("good_to_bad", "bad_to_good", "loss_in_good", "loss_in_bad"), probabilities)
    ),
    st.fixed_dictionaries(
        {"mean_loss": st.floats(0, 1, exclude_max=True), "mean_burst": st.floats(1, 1e17)}
    ).filter(_valid_gilbert_elliott),
).map(lambda table: imp.GilbertElliottLoss(**table))


@st.composite
def four_states(draw: st.DrawFn) -> imp.FourStateLoss:
    pairs = st.tuples(probabilities, probabilities).filter(lambda pair: sum(pair) <= 1)
    (p31, p32), (p13, p14) = draw(pairs), draw(pairs)
    return imp.FourStateLoss(p13=p13, p31=p31, p32=p32, p23=draw(probabilities), p14=p14)


@st.composite
def periodic(draw: st.DrawFn) -> imp.PeriodicLoss:
    period = draw(counts)
    return imp.PeriodicLoss(
        period=period,
        burst=draw(st.integers(0, period)),
        first=draw(st.integers(0, 2**40)),
    )


@st.composite
def scripted(draw: st.DrawFn) -> imp.ScriptedLoss:
    lost = sorted(draw(st.sets(st.integers(0, 2**40 - 1), max_size=20)))
    least = lost[-1] + 1 if lost else 0
    return imp.ScriptedLoss(
        lost=tuple(lost), repeat_every=draw(st.one_of(st.just(0), st.integers(least, 2**40)))
    )


losses: st.SearchStrategy[imp.Loss] = st.one_of(
    st.just(imp.NoLoss()),
    st.builds(imp.BernoulliLoss, probability=probabilities, correlation=correlations),
    gilbert_elliott,
    four_states(),
    periodic(),
    scripted(),
    st.builds(imp.TraceLoss, file=files, repeat=st.booleans()),
    st.just(imp.WorstCaseLoss()),
)


@st.composite
def delays(draw: st.DrawFn) -> imp.Delay:
    shape = draw(st.sampled_from(["uniform", "normal", "pareto", "paretonormal", "empirical"]))
    table: dict[str, Any] = {"distribution": shape}
    if shape == "empirical" and draw(st.booleans()):
        samples_s = st.lists(st.floats(-3600, 3600), min_size=2, max_size=9)
        table["samples_s"] = tuple(draw(samples_s))
    elif shape == "empirical":
        table["file"] = draw(files)
    return imp.Delay(
        delay_s=draw(times_s),
        jitter_s=draw(times_s),
        correlation=draw(correlations),
        loss_correlation=draw(st.floats(-1, 1)),
        **table,
    )


@st.composite
def blackouts(draw: st.DrawFn) -> imp.Blackout:
    lengths = draw(st.lists(st.floats(1e-9, 1e4), min_size=2, max_size=8))
    times = list(accumulate(lengths))
    times = times[: len(times) // 2 * 2]
    every = st.none() | st.floats(max(times[-1], 1e-6), 1e6)
    return imp.Blackout(
        intervals_s=tuple(zip(times[::2], times[1::2], strict=True)), every_s=draw(every)
    )


rates = st.one_of(
    st.builds(
        imp.Rate,
        rate_bps=st.integers(10**8, 10**12),
        queue=st.integers(1, 1_000_000),
        overhead_bytes=st.integers(-65_535, 65_535),
    ),
    # Slow links, or many cells, with a queue that leaves in less than a century.
    st.builds(
        imp.Rate,
        rate_bps=st.integers(1, 10**8),
        queue=st.integers(1, 1000),
        overhead_bytes=st.integers(-65_535, 100),
        cell_bytes=st.integers(40, 65_535),
        cell_overhead_bytes=st.integers(0, 40),
    ),
)

impairments: st.SearchStrategy[imp.Impairment] = st.one_of(
    st.builds(imp.LossOf, loss=losses),
    st.builds(imp.Duplicate, probability=probabilities, correlation=correlations),
    st.builds(imp.Corrupt, probability=probabilities, correlation=correlations),
    delays(),
    st.builds(imp.Reorder, probability=probabilities, correlation=correlations, gap=counts),
    rates,
    blackouts(),
)


def _goes_together(chain: list[imp.Impairment]) -> bool:
    """Whether each delay that is correlated with loss has a loss before it."""
    scored = False
    for one in chain:
        if isinstance(one, imp.LossOf):
            scored = isinstance(one.loss, imp.BernoulliLoss | imp.GilbertElliottLoss)
        elif isinstance(one, imp.Delay) and one.loss_correlation and not scored:
            return False
    return True


settings: st.SearchStrategy[imp.LinkSettings] = st.builds(
    imp.LinkSettings,
    impairments=st.lists(impairments, max_size=5).filter(_goes_together).map(tuple),
    mansd=st.none() | st.integers(0, 1_000_000),
    first_delivered=st.booleans(),
    limit=st.integers(1, 1_000_000),
)


def words_can_say(settings: imp.LinkSettings) -> bool:
    """Whether each reorder has a delay before it; words refuse what does nothing."""
    delayed, reordered = False, False
    for one in settings.impairments:
        if isinstance(one, imp.Reorder) and (reordered or not delayed):
            return False
        delayed = delayed or isinstance(one, imp.Delay | imp.Rate)
        reordered = isinstance(one, imp.Reorder)
    return True
