"""The claims of the paper's text, each with a verdict from the draws.

A claim is confirmed if it holds in at least 95 % of the draws, both in the base ensemble and in
every variation of a setting that the paper does not specify. It is partly confirmed if it holds in
at least half of the draws of the base ensemble. Otherwise it is not confirmed.
"""

from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.studies.campaign.metrics import quartiles
from cosim.studies.paper.paper_campaign import BASE, EXACT_MODEL, OTHER_EXAMPLES, WIDE_BOX
from cosim.studies.paper.paper_results import Results, number, percent
from noack.core.linear_systems import Vector

CONFIRMED_FROM, PARTLY_FROM = 0.95, 0.5
_FIG_2, _FIG_3 = "Section V, on Fig. 2", "Section V, on Fig. 3"


class PaperVerdict(StrEnum):
    """The verdict on a claim."""

    CONFIRMED = "confirmed"
    PARTLY = "partly"
    NOT_CONFIRMED = "not confirmed"


class PaperClaim(NamedTuple):
    """A claim with its verdict."""

    where: str
    """Place in the paper."""
    gist: str
    verdict: PaperVerdict
    why: str
    """The numbers that support the verdict."""


Flags = NDArray[np.bool_]
Column = Callable[[str], Vector]
"""Returns a column of a variation by the column's name."""


class Judgement(NamedTuple):
    """The share of draws in which a statement holds."""

    base: float
    least: float
    """The smallest share among the variations of settings that the paper does not specify."""
    least_in: str

    @property
    def verdict(self) -> PaperVerdict:
        """The verdict by the rule in the module's docstring."""
        if min(self.base, self.least) >= CONFIRMED_FROM:
            return PaperVerdict.CONFIRMED
        return PaperVerdict.PARTLY if self.base >= PARTLY_FROM else PaperVerdict.NOT_CONFIRMED

    def __str__(self) -> str:
        least = f" (least: {percent(self.least)}, {self.least_in})"
        return f"in {percent(self.base)} of the draws{'' if self.least == self.base else least}"

    @property
    def sentence(self) -> str:
        """The text of the judgement, with a capital letter."""
        return str(self)[0].upper() + str(self)[1:]


def judge(results: Results, holds: Callable[[Column], Flags]) -> Judgement:
    """Return the shares of draws in which a statement holds: base, and smallest variation.

    ``holds`` returns one truth value per draw from a variation's columns.
    """
    shares = {
        name: float(holds(partial(results.column, variation=name)).mean())
        for name in results.variations if name not in OTHER_EXAMPLES
    }  # fmt: skip
    least_in = min(shares, key=shares.__getitem__)
    return Judgement(shares[BASE], shares[least_in], least_in)


def claims(results: Results) -> Iterator[PaperClaim]:
    """Return all claims of the paper's text about its example, in the order of the text."""
    yield from _mb_et(results)
    yield from _zoh_et(results)
    yield from _inter_event(results)


def _mb_et(results: Results) -> Iterator[PaperClaim]:
    median = partial(_median, results)
    fewer = judge(results, lambda c: c("model.deliveries") < c("model.events"))
    yield PaperClaim(
        _FIG_2, "Because of dropouts, x_c is updated less often than x_s.", fewer.verdict,
        f"{fewer.sentence}. Medians: {median('model.events')} updates of x_s, "
        f"{median('model.deliveries')} of x_c.",
    )  # fmt: skip
    often = judge(results, lambda c: c("model.gap_median_s") < c("model.reception_median_s"))
    yield PaperClaim(
        _FIG_2, "Transmissions are more frequent than receptions.", often.verdict,
        f"{often.sentence}. Median intervals: {median('model.gap_median_s')} s between "
        f"broadcasts, {median('model.reception_median_s')} s between receptions.",
    )  # fmt: skip
    most = judge(results, lambda c: c("model.deliveries") < 0.5 * c("model.events"))
    loss = results.evidence["loss"]
    yield PaperClaim(
        _FIG_2, "Most of the transmitted packets are lost.", most.verdict,
        f"{most.sentence}. This is put in, not found: with M = 5 most packets are lost if and only "
        "if the loss probability, which the paper does not give, is above "
        f"{number(loss['half'])}; never more than {percent(loss['most'])} are.",
    )  # fmt: skip
    larger = judge(results, lambda c: c("model.controller_error") > 1 + 1e-9)
    yield PaperClaim(
        "Section III", "In general ‖e_c‖ grows larger than ‖e_s‖.", larger.verdict,
        f"{larger.sentence}. ‖e_c‖ reaches {median('model.controller_error')} times the "
        "threshold in the median; ‖e_s‖ reaches it once, by definition.",
    )  # fmt: skip
    settled = judge(results, lambda c: np.isfinite(c("model.settled_1_s")))
    yield PaperClaim(
        "Abstract, Theorem 2", "MB-ET stabilises the uncertain system.", settled.verdict,
        f"‖x‖ settles below 1 % of ‖x(0)‖ {settled}; the latest at "
        f"{number(results.column('model.settled_1_s').max())} s. Largest ‖x‖ at 40 s: "
        f"{number(results.column('model.final_norm').max())}.",
    )  # fmt: skip
    both = judge(results, lambda c: np.isfinite(c("model.settled_1_s") + c("zoh.settled_1_s")))
    yield PaperClaim(
        "Abstract", "No acknowledgement messages are needed.", both.verdict,
        "Nothing goes from the controller to the sensor in the simulated loop, and both loops "
        f"settle {both}.",
    )  # fmt: skip


def _zoh_et(results: Results) -> Iterator[PaperClaim]:
    median = partial(_median, results)
    settled = judge(results, lambda c: np.isfinite(c("zoh.settled_1_s")))
    yield PaperClaim(
        _FIG_3, "ZOH-ET stabilises the system, too.", settled.verdict,
        f"‖x‖ settles below 1 % of ‖x(0)‖ {settled}; the latest at "
        f"{number(results.column('zoh.settled_1_s').max())} s.",
    )  # fmt: skip
    later = judge(results, lambda c: c("zoh.settled_5_s") > c("model.settled_5_s"))
    finer = judge(results, lambda c: c("zoh.settled_1_s") > c("model.settled_1_s"))
    verdict = max((later, finer), key=lambda one: list(PaperVerdict).index(one.verdict)).verdict
    yield PaperClaim(
        _FIG_3, "With ZOH the system takes longer to settle.", verdict,
        f"To 5 % of ‖x(0)‖ {later}, to 1 % {finer}. "
        f"Medians: {median('zoh.settled_5_s')} s against {median('model.settled_5_s')} s to 5 %, "
        f"{median('zoh.settled_1_s')} s against {median('model.settled_1_s')} s to 1 %. "
        "A tendency; a single pair of runs, such as Fig. 2 and 3, may show either.",
    )  # fmt: skip
    more = judge(results, lambda c: _all_larger(c, "zoh", "model", "events", "deliveries"))
    ratio = quartiles(results.column("zoh.events") / results.column("model.events"))
    yield PaperClaim(
        _FIG_3, "With ZOH the number of updates increases.", more.verdict,
        f"{more.sentence}: {number(ratio.median)} times as many transmissions in the median "
        f"({number(ratio.lower)} to {number(ratio.upper)} between the quartiles).",
    )  # fmt: skip


def _inter_event(results: Results) -> Iterator[PaperClaim]:
    median = partial(_median, results)
    longer = judge(results, lambda c: _all_larger(c, "model", "zoh", "gap_median_s", "gap_min_s"))
    yield PaperClaim(
        "Section II, Section VI", "MB-ET extends the inter-event times.", longer.verdict,
        f"{longer.sentence}. Medians of the shortest: {median('model.gap_min_s')} s against "
        f"{median('zoh.gap_min_s')} s; of the median ones: {median('model.gap_median_s')} s "
        f"against {median('zoh.gap_median_s')} s.",
    )  # fmt: skip
    medians = [
        quartiles(results.column("model.gap_median_s", name)).median
        for name in (EXACT_MODEL, BASE, WIDE_BOX)
    ]
    ordered = medians[0] > medians[1] > medians[2]
    yield PaperClaim(
        "Section II", "MB-ET does so especially when the model is close to the system.",
        PaperVerdict.CONFIRMED if ordered else PaperVerdict.NOT_CONFIRMED,
        f"Medians of the median inter-event time: {number(medians[0])} s with an exact model (no "
        f"event after t_0), {number(medians[1])} s in the paper's box, {number(medians[2])} s in "
        "a box five times as wide.",
    )  # fmt: skip
    observed = results.column("model.gap_min_s")
    certified = results.column("inter_event_s", table="certified")
    printed = results.column("inter_event_s", table="printed")
    positive = judge(results, lambda c: c("model.gap_min_s") > 0)
    respected = (observed >= certified).all() and (observed[: len(printed)] >= printed).all()
    yield PaperClaim(
        "Abstract, Theorem 2", "A positive minimum inter-event time exists.",
        positive.verdict if respected else PaperVerdict.NOT_CONFIRMED,
        f"MB-ET: no two events are closer than {number(1e3 * observed.min())} ms in any draw of "
        f"the base. Certified per draw: {_range(1e3 * certified)} ms. Theorem 2 as printed, "
        f"with the certified Δ ({len(printed)} draws): {_range(1e3 * printed)} ms. "
        "No draw falls below either.",
    )  # fmt: skip


def _all_larger(column: Column, mode: str, other: str, *measures: str) -> Flags:
    larger = [column(f"{mode}.{m}") > column(f"{other}.{m}") for m in measures]
    return np.asarray(np.all(larger, axis=0))


def _median(results: Results, name: str) -> str:
    return number(quartiles(results.column(name)).median)


def _range(values: Vector) -> str:
    return f"{number(values.min())} to {number(values.max())}"
