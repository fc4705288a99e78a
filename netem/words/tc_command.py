"""The nearest ``tc`` command to a link's settings, and the settings that it leaves out."""

from typing import NamedTuple

from noack.core.errors import shortened
from noack.impairments.feature import Impairment
from noack.impairments.link_settings import LinkSettings
from noack.impairments.words import percent_text

_FIXED_ORDER = ("duplicate", "loss", "corrupt", "delay", "reorder", "rate")
"""tc applies its impairments in this order, whatever the order of the words."""
_LONGEST = 60
"""Words that are left out are cut to this number of characters."""


class TcCommand(NamedTuple):
    """The nearest settings that ``tc`` supports."""

    words: str | None
    """After ``tc qdisc add dev DEVICE root netem``; None if tc supports none of the settings."""
    lacks: tuple[str, ...]
    """The words that are left out, each with the missing tc feature."""
    notes: tuple[str, ...]
    """Differences in behaviour."""


def tc_command(settings: LinkSettings, named: LinkSettings | None = None) -> TcCommand:
    """Return the nearest words of tc's own netem, and the settings that they leave out.

    ``named`` are the same settings, with the names of files instead of their content.
    """
    supported: list[Impairment] = []
    lacks: list[str] = []
    pairs = zip(settings.impairments, (named or settings).impairments, strict=True)
    wanted = [(one, other.text()) for one, other in pairs if one.tc_text()]
    for one, words in wanted:
        if share := getattr(one, "loss_correlation", 0.0):
            lacks.append(f"lossrel {percent_text(share)} (a delay correlated with loss)")
        what = one.tc_lacks(supported)
        if any(other.kind == one.kind for other in supported):
            what = f"a second {one.kind}"
        if what:
            lacks.append(f"{shortened(words, _LONGEST)} ({what})")
        else:
            supported.append(one)
    if settings.mansd is not None:
        lacks.append(f"mansd {settings.mansd} (a cap on consecutive losses)")
    lacks += [f"{one.text()} (a constraint on losses)" for one in settings.constraints]
    if settings.first_delivered:
        lacks.append("first (that the first packet of each flow is delivered)")
    if wanted and not supported:
        return TcCommand(None, tuple(lacks), ())
    text = " ".join([f"limit {settings.limit}", *(one.tc_text() for one in supported)])
    notes = [note for one in supported for note in one.tc_notes()]
    order = [_FIXED_ORDER.index(one.kind) for one in supported if one.kind in _FIXED_ORDER]
    if order != sorted(order):
        notes.append(f"its order is fixed: {', '.join(_FIXED_ORDER)}")
    return TcCommand(text, tuple(lacks), tuple(dict.fromkeys(notes)))
