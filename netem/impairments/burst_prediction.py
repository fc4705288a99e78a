"""The bursts of a link's losses without a guarantee: their mean, and the chance of a longer one.

This is the question by which people choose ``mansd``: how likely it is that more packets in a row
are lost within some number of packets.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from netem.impairments.loss_prediction import LossProcess
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.words import OWN_TIME_S

USUAL_PACKETS = 1000
"""Packets within which a longer burst is looked for, unless the user says otherwise."""
_USUAL_CAPS = (1, 2, 3, 4, 5, 6, 8, 10)
_MOST_PACKETS = 10**9
_COUNT = re.compile(r"[0-9]{1,10}")


@dataclass(frozen=True)
class BurstPrediction:
    """The bursts of consecutive losses among some packets."""

    packets: int
    mean_burst: float | None
    """Mean length of a burst; None: losses never end, or there are none."""
    chance: Mapping[int, float]
    """By ``mansd``: the probability that at least one burst is longer."""
    note: str = ""
    """Why nothing is known; else empty."""

    def to_json(self) -> dict[str, object]:
        """Return the prediction for JSON."""
        return {
            "packets": self.packets,
            "mean_burst": self.mean_burst,
            "chance_of_longer": {str(cap): chance for cap, chance in self.chance.items()},
            "note": self.note,
        }


def caps_with(cap: int | None) -> list[int]:
    """Return eight values of ``mansd``, among them the one in force if there is one."""
    if not cap or cap in _USUAL_CAPS:
        return list(_USUAL_CAPS)
    return sorted({*_USUAL_CAPS, cap} - {6})


def predict_bursts(process: LossProcess, caps: Iterable[int], packets: int) -> BurstPrediction:
    """Return the prediction for values of ``mansd``; what cannot be computed is left out, with a note."""
    chance: dict[int, float] = {}
    note = ""
    for cap in caps:
        try:
            chance[cap] = 1 - process.keeps(LossGuarantee((LongestBurst(cap),)), packets)
        except NotPredictableError as error:
            note = str(error)
    return BurstPrediction(packets, process.mean_burst(), chance, note)


def read_within(text: str, period_s: float | None) -> int:
    """Return the packets in ``600`` (packets) or ``10s`` (a time, of packets with this period).

    Raises:
        ValueError: one line; it is neither, or a time is given and no period.
    """
    if _COUNT.fullmatch(text):
        packets = int(text)
    else:
        try:
            time_s = OWN_TIME_S.read(text)
        except ValueError:
            raise ValueError("expected a number of packets, or a time, e.g. 600 or 60s") from None
        if period_s is None:
            raise ValueError("a time needs the sender's period: --period TIME, e.g. 20ms")
        packets = round(time_s / period_s) if period_s > 0 else 0
    if not 1 <= packets <= _MOST_PACKETS:
        raise ValueError(f"{packets} packets; expected 1 to {_MOST_PACKETS}")
    return packets


def chance_text(chance: float) -> str:
    """Return a probability in percent; near 0 and near 100 % a bound."""
    if chance <= 0:
        return "0%"
    if chance < 1e-5:
        return "<0.001%"
    if chance > 0.9999:
        return ">99.99%" if chance < 1 else "100%"
    if chance > 0.99:
        return f"{100 * chance:.{-math.floor(math.log10(100 * (1 - chance)))}f}%"
    return f"{100 * chance:.3g}%"
