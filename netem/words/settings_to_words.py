"""From settings to words: the inverse of :mod:`netem.words.words_to_settings`."""

import shlex

from netem.words.quantities import number_text, percent_text, rate_text, time_text
from netem.words.words_to_settings import SHAPES
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

_OVERHEAD = Rate.model_fields["overhead_bytes"].default
_QUEUE = Rate.model_fields["queue"].default
_LIMIT = LinkSettings.model_fields["limit"].default


def text_of(settings: LinkSettings, seed: int | None = None) -> str:
    """Return words that ``parse`` reads back to the same settings."""
    words = [impairment_text(impairment) for impairment in settings.impairments]
    if settings.mansd is not None:
        words.append(f"mansd {settings.mansd}")
    if settings.first_delivered:
        words.append("first")
    if settings.limit != _LIMIT:
        words.append(f"limit {settings.limit}")
    if seed is not None:
        words.append(f"seed {seed}")
    return " ".join(words)


def impairment_text(impairment: Impairment) -> str:
    """Return the words of one impairment."""
    match impairment:
        case LossOf():
            return f"loss {_loss_text(impairment.loss)}"
        case Duplicate() | Corrupt():
            return f"{impairment.kind} {_chance_text(impairment)}"
        case Reorder():
            gap = f" gap {impairment.gap}" if impairment.gap != 1 else ""
            return f"reorder {_chance_text(impairment)}{gap}"
        case Delay():
            return _delay_text(impairment)
        case Rate():
            return _rate_text(impairment)
        case Blackout():
            parts = (f"{time_text(a)}-{time_text(b)}" for a, b in impairment.intervals_s)
            every = "" if impairment.every_s is None else f" every {time_text(impairment.every_s)}"
            return f"blackout {','.join(parts)}{every}"


def _loss_text(loss: Loss) -> str:
    match loss:
        case NoLoss():
            return "none"
        case BernoulliLoss():
            return _chance_text(loss)
        case GilbertElliottLoss(mean_loss=float(share), mean_burst=float(length)):
            return f"burst {percent_text(share)} {number_text(length)}"
        case GilbertElliottLoss():
            p, r = loss.transitions
            return "gemodel " + _percents(
                (p, r, loss.loss_in_bad, loss.loss_in_good), (None, None, 1.0, 0.0)
            )
        case FourStateLoss():
            return "state " + _percents(
                (loss.p13, loss.p31, loss.p32, loss.p23, loss.p14), (None, None, 0.0, 1.0, 0.0)
            )
        case PeriodicLoss():
            begin = f" from {loss.first}" if loss.first else ""
            return f"periodic {loss.burst}/{loss.period}{begin}"
        case ScriptedLoss():
            every = f" every {loss.repeat_every}" if loss.repeat_every else ""
            return f"script {','.join(map(str, loss.lost)) or 'none'}{every}"
        case TraceLoss():
            return f"trace {shlex.quote(loss.file)}{'' if loss.repeat else ' once'}"
        case WorstCaseLoss():
            return "worst"


def _percents(shares: tuple[float, ...], defaults: tuple[float | None, ...]) -> str:
    """Percentages, without those at the end that are the defaults."""
    count = len(shares)
    while shares[count - 1] == defaults[count - 1]:
        count -= 1
    return " ".join(map(percent_text, shares[:count]))


def _chance_text(chance: BernoulliLoss | Duplicate | Corrupt | Reorder) -> str:
    correlation = f" {percent_text(chance.correlation)}" if chance.correlation else ""
    return percent_text(chance.probability) + correlation


def _delay_text(delay: Delay) -> str:
    words = ["delay", time_text(delay.delay_s)]
    shaped = delay.distribution in SHAPES and delay.distribution != "uniform"
    if delay.jitter_s or delay.correlation or shaped:
        words.append(time_text(delay.jitter_s))
    if delay.correlation:
        words.append(percent_text(delay.correlation))
    if shaped:
        words += ["distribution", delay.distribution]
    elif delay.file is not None:
        name = f"./{delay.file}" if delay.file in SHAPES else delay.file
        words += ["distribution", shlex.quote(name)]
    elif delay.samples_s is not None:
        words += ["samples", ",".join(map(time_text, delay.samples_s))]
    if delay.loss_correlation:
        words += ["lossrel", percent_text(delay.loss_correlation)]
    return " ".join(words)


def _rate_text(rate: Rate) -> str:
    words = ["rate", rate_text(rate.rate_bps)]
    cells = (rate.cell_bytes, rate.cell_overhead_bytes)
    if rate.overhead_bytes != _OVERHEAD or any(cells):
        words.append(str(rate.overhead_bytes))
    if any(cells):
        words.append(str(rate.cell_bytes))
    if rate.cell_overhead_bytes:
        words.append(str(rate.cell_overhead_bytes))
    if rate.queue != _QUEUE:
        words.append(f"queue {rate.queue}")
    return " ".join(words)
