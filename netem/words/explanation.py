"""What settings mean, in plain words."""

from netem.rule_program import program_of
from netem.rules.delay import quantile_ns
from netem.words.quantities import number_text, percent_text, rate_text, time_text
from noack.config.impairments import (
    BernoulliLoss,
    Blackout,
    Corrupt,
    Delay,
    Duplicate,
    FourStateLoss,
    GilbertElliottLoss,
    Impairment,
    LinkSettings,
    Loss,
    LossOf,
    NoLoss,
    PeriodicLoss,
    Rate,
    Reorder,
    ScriptedLoss,
    TraceLoss,
    WorstCaseLoss,
)

_NOTEWORTHY = 1e-4
"""Share of delays that are cut at 0. A normal distribution has no end, so that some always are."""


def meaning_of(impairment: Impairment) -> str:
    """Say what an impairment does."""
    match impairment:
        case LossOf():
            return _loss(impairment.loss)
        case Duplicate():
            return f"sends {_share(impairment)} of the datagrams twice{_likeness(impairment)}"
        case Corrupt():
            return f"flips one bit in {_share(impairment)} of the datagrams{_likeness(impairment)}"
        case Reorder():
            return _reorder(impairment)
        case Delay():
            return _delay(impairment)
        case Rate():
            return _rate(impairment)
        case Blackout():
            return _blackout(impairment)


def settings_meaning(settings: LinkSettings) -> list[tuple[str, str]]:
    """Say what the cap and the other settings do: their words, and their meaning."""
    found = []
    if settings.mansd is not None:
        found.append((
            f"mansd {settings.mansd}",
            f"the cap: at most {settings.mansd} successive datagrams of a flow are not delivered; "
            "the next one passes, whatever the impairments say",
        ))  # fmt: skip
    if settings.first_delivered:
        found.append((
            "first",
            "the first datagram of each flow is delivered, whatever the impairments say; this is "
            "no cap on the later ones",
        ))  # fmt: skip
    if any(isinstance(one, Delay | Rate) for one in settings.impairments):
        found.append((
            f"limit {settings.limit}",
            f"at most {settings.limit} datagrams are delayed at once; more are dropped",
        ))  # fmt: skip
    return found


def _loss(loss: Loss) -> str:
    match loss:
        case NoLoss():
            return "loses nothing"
        case BernoulliLoss() if loss.correlation:
            return f"loses {_share(loss)} of the datagrams{_likeness(loss)}"
        case BernoulliLoss():
            return f"loses {_share(loss)} of the datagrams, each independently"
        case GilbertElliottLoss():
            return _gilbert_elliott(loss)
        case FourStateLoss():
            return (
                "loses by a Markov chain of four states: bursts begin with probability "
                f"{_brief(loss.p13)} and end with {_brief(loss.p31)}; within one, delivery begins "
                f"with {_brief(loss.p32)} and ends with {_brief(loss.p23)}; single losses come "
                f"with {_brief(loss.p14)}"
            )
        case PeriodicLoss():
            begin = f", from number {loss.first} on" if loss.first else ""
            return f"loses {loss.burst} of every {loss.period} datagrams of a flow, in a row{begin}"
        case ScriptedLoss():
            numbers = ", ".join(map(str, loss.lost[:8])) + (", ..." if len(loss.lost) > 8 else "")
            again = f", and again every {loss.repeat_every}" if loss.repeat_every else ""
            return f"loses the datagrams {numbers or '(none)'} of each flow{again}"
        case TraceLoss():
            return f"loses what {loss.file} marks with a 1{', once' if not loss.repeat else ''}"
        case WorstCaseLoss():
            return "loses everything that the cap lets it lose"


def _gilbert_elliott(loss: GilbertElliottLoss) -> str:
    p, r = loss.transitions
    bad = f"bad times begin with probability {_brief(p)} per datagram"
    length = f" and last {_figure(1 / r)} datagrams on average" if r else " and never end"
    if (loss.loss_in_good, loss.loss_in_bad) == (0.0, 1.0):
        return f"loses all datagrams in bad times; {bad}{length}"
    return (
        f"loses {_brief(loss.loss_in_bad)} of the datagrams in bad times and "
        f"{_brief(loss.loss_in_good)} in good ones; {bad}{length}"
    )


def _delay(delay: Delay) -> str:
    text = f"holds each datagram back by {time_text(delay.delay_s)}"
    if delay.file is not None:
        text += f" and what {delay.file} says"
    elif delay.samples_s is not None:
        low, high = min(delay.samples_s), max(delay.samples_s)
        text += (
            f" and between {time_text(low)} and {time_text(high)} more, as "
            f"{len(delay.samples_s)} observed delays are distributed"
        )
    elif delay.jitter_s and delay.distribution == "uniform":
        text += f" ± {time_text(delay.jitter_s)}, all of which is as likely"
    elif delay.jitter_s:
        text += f", with a standard deviation of {time_text(delay.jitter_s)} ({delay.distribution})"
    below = _share_below_zero(delay)
    if below >= _NOTEWORTHY:
        text += f"; what would be below 0 is 0 ({percent_text(float(f'{below:.2g}'))} of the draws)"
    if delay.correlation:
        text += f"; successive ones alike by {_brief(delay.correlation)}"
    if delay.loss_correlation:
        text += f"; correlated with the loss before it by {_brief(delay.loss_correlation)}"
    return text


def _share_below_zero(delay: Delay) -> float:
    """Share of the drawn delays that would be below 0."""
    if delay.file is not None:
        return 0.0
    alone = delay.model_copy(update={"correlation": 0.0, "loss_correlation": 0.0})
    program = program_of(LinkSettings(impairments=(alone,)), 0)
    wait = program.waits[0]
    low, high = 0.0, 1.0
    for _ in range(50):  # quantiles ascend
        middle = (low + high) / 2
        if wait.constant_ns + quantile_ns(wait, program.reals, middle) < 0:
            low = middle
        else:
            high = middle
    return low


def _reorder(reorder: Reorder) -> str:
    if reorder.gap == 1:
        which = f"{_share(reorder)} of the datagrams"
    else:
        which = f"every {reorder.gap}th datagram"
        if reorder.probability < 1:
            which += f", with probability {_share(reorder)},"
    return f"sends {which} at once, ahead of those that are delayed{_likeness(reorder)}"


def _rate(rate: Rate) -> str:
    text = (
        f"lets {rate_text(rate.rate_bps)} per second through, one after the other, each with "
        f"{rate.overhead_bytes} bytes beside its payload; {rate.queue} may wait, more are dropped"
    )
    if rate.cell_bytes:
        text += f"; in cells of {rate.cell_bytes} + {rate.cell_overhead_bytes} bytes"
    return text


def _blackout(blackout: Blackout) -> str:
    parts = [f"{time_text(begin)} to {time_text(end)}" for begin, end in blackout.intervals_s[:4]]
    more = ", ..." if len(blackout.intervals_s) > 4 else ""
    every = "" if blackout.every_s is None else f", every {time_text(blackout.every_s)}"
    return f"lets nothing through from {', '.join(parts)}{more} after the start{every}"


def _share(chance: BernoulliLoss | Duplicate | Corrupt | Reorder) -> str:
    return _brief(chance.probability)


def _likeness(chance: BernoulliLoss | Duplicate | Corrupt | Reorder) -> str:
    if not chance.correlation:
        return ""
    return f"; successive ones alike by {_brief(chance.correlation)}"


def _brief(share: float) -> str:
    """A share in percent, with six digits."""
    return percent_text(float(f"{share:.6g}"))


def _figure(number: float) -> str:
    return number_text(float(f"{number:.4g}"))
