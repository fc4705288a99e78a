"""The command of ``tc`` that comes nearest to settings, and what it leaves out."""

from collections.abc import Sequence
from typing import NamedTuple

from netem.words.quantities import percent_text, rate_text, time_text
from netem.words.settings_to_words import impairment_text
from netem.words.words_to_settings import SHAPES
from noack.config.impairments import (
    BernoulliLoss,
    Blackout,
    Delay,
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

_HEADERS_BYTES = 42
"""What tc counts beside the payload on an Ethernet device: the headers of Ethernet, IPv4, UDP."""
_FIXED_ORDER = ("duplicate", "loss", "corrupt", "delay", "reorder", "rate")
"""In which tc does what it does, whatever the order of the words."""


_LONGEST = 60
"""Of the words that are named as lacking."""


class TcCommand(NamedTuple):
    """What ``tc`` can do of settings."""

    words: str | None
    """After ``tc qdisc add dev DEVICE root netem``; None if it can do nothing of them."""
    lacks: tuple[str, ...]
    """The words that are left out, each with what tc lacks for it."""
    notes: tuple[str, ...]
    """What it does differently."""


def tc_command(settings: LinkSettings) -> TcCommand:
    """Return the words of tc's own netem that come nearest, and what they leave out."""
    kept: list[Impairment] = []
    lacks: list[str] = []
    wanted = [one for one in settings.impairments if _words(one)]
    for one in wanted:
        if isinstance(one, Delay) and one.loss_correlation:
            lacks.append(
                f"lossrel {percent_text(one.loss_correlation)} (a delay correlated with loss)"
            )
            one = one.model_copy(update={"loss_correlation": 0.0})
        what = _lacks(one, kept)
        if what:
            lacks.append(f"{_cut(impairment_text(one))} ({what})")
        else:
            kept.append(one)
    if settings.mansd is not None:
        lacks.append(f"mansd {settings.mansd} (a cap on successive losses)")
    if settings.first_delivered:
        lacks.append("first (that the first datagram of each flow is delivered)")
    if wanted and not kept:
        return TcCommand(None, tuple(lacks), ())
    words = " ".join([f"limit {settings.limit}", *map(_words, kept)])
    return TcCommand(words, tuple(lacks), _differences(kept))


def _lacks(impairment: Impairment, before: Sequence[Impairment]) -> str | None:
    """What tc lacks for this impairment, if it does what stands before it."""
    if any(one.kind == impairment.kind for one in before):
        return f"a second {impairment.kind}"
    match impairment:
        case LossOf(loss=PeriodicLoss() | ScriptedLoss() | TraceLoss()):
            return "losses by the datagrams' numbers"
        case LossOf(loss=WorstCaseLoss()):
            return "a worst case"
        case Blackout():
            return "blackouts"
        case Delay() if impairment.distribution not in SHAPES:
            return "such a table of delays"
        case Delay() if impairment.distribution != "uniform" and not (
            impairment.delay_s and impairment.jitter_s
        ):
            return "a distribution without a delay and a jitter"
        case Reorder() if not any(isinstance(one, Delay) and one.delay_s for one in before):
            return "reordering without a delay before it"
        case _:
            return None


def _words(impairment: Impairment) -> str:
    match impairment:
        case LossOf():
            return _loss_words(impairment.loss)
        case Rate():
            overhead_bytes = impairment.overhead_bytes - _HEADERS_BYTES
            cells = (impairment.cell_bytes, impairment.cell_overhead_bytes)
            numbers = (overhead_bytes, *cells) if any(cells) else (overhead_bytes,)
            return " ".join(["rate", rate_text(impairment.rate_bps), *map(str, numbers)])
        case Delay(distribution="uniform") if not impairment.jitter_s:
            return f"delay {time_text(impairment.delay_s)}"
        case _:
            return impairment_text(impairment)


def _loss_words(loss: Loss) -> str:
    match loss:
        case NoLoss():
            return ""
        case BernoulliLoss():
            correlation = f" {percent_text(loss.correlation)}" if loss.correlation else ""
            return f"loss random {percent_text(loss.probability)}{correlation}"
        case GilbertElliottLoss():
            shares = (*loss.transitions, loss.loss_in_bad, loss.loss_in_good)
            return f"loss gemodel {' '.join(map(percent_text, shares))}"
        case FourStateLoss():
            shares5 = (loss.p13, loss.p31, loss.p32, loss.p23, loss.p14)
            return f"loss state {' '.join(map(percent_text, shares5))}"
        case PeriodicLoss() | ScriptedLoss() | TraceLoss() | WorstCaseLoss():
            return "loss"


def _differences(impairments: Sequence[Impairment]) -> tuple[str, ...]:
    notes = []
    if any(getattr(one, "correlation", 0) for one in impairments) or any(
        isinstance(one, LossOf) and isinstance(one.loss, BernoulliLoss) and one.loss.correlation
        for one in impairments
    ):
        notes.append("its correlation changes the probability, or the spread, of what it is given")
    if any(isinstance(one, Delay) and "pareto" in one.distribution for one in impairments):
        notes.append("its table of the Pareto distribution ends at four times the jitter")
    if any(isinstance(one, Rate) for one in impairments):
        notes.append("its queue is the limit; its overhead is for an Ethernet device, with IPv4")
    order = [_FIXED_ORDER.index(one.kind) for one in impairments if one.kind in _FIXED_ORDER]
    if order != sorted(order):
        notes.append(f"its order is fixed: {', '.join(_FIXED_ORDER)}")
    return tuple(notes)


def _cut(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."
