"""Bursty losses: a two-state Markov chain (Gilbert, 1960; Elliott, 1963).

The chain starts in the good state and may change its state before each packet: good → bad with
probability p, bad → good with probability r. A packet is lost with probability 1 − k in the good
state and 1 − h in the bad. In the stationary chain the loss rate is

    (1 − k) r/(p + r) + (1 − h) p/(p + r).

With ``state = "link"`` all flows share one chain, which may change its state every ``step_s``: a
bad state concerns all of them at once. Whether a packet is lost is drawn for each packet.
"""

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from netem.core.clock import NS_PER_S
from netem.core.settings_section import Probability
from netem.impairments.clauses import Clause, Part
from netem.impairments.feature import Impairment, LossModel, Stage, StageTables
from netem.impairments.markov_chain import Chain, NotPredictableError
from netem.impairments.words import (
    NUMBER,
    OWN_TIME_S,
    PERCENT,
    brief_number,
    brief_percent,
    percent_text,
    time_text,
)

_COMMON = Part("step_s", OWN_TIME_S, "STEP", "common", "loss gemodel 1% 10% common 20ms", {"state": "link"})


class GilbertElliottLoss(LossModel):
    """Two-state Markov loss: a good and a bad state, each with its own loss probability.

    Either the probabilities of changing state, or ``mean_loss`` and ``mean_burst``.
    """

    model: Literal["gilbert_elliott"] = "gilbert_elliott"
    good_to_bad: Probability | None = None
    """Probability p of leaving the good state, per packet."""
    bad_to_good: Probability | None = None
    """Probability r of leaving the bad state, per packet."""
    loss_in_good: Probability = 0.0
    """Loss probability 1 − k in the good state."""
    loss_in_bad: Probability = 1.0
    """Loss probability 1 − h in the bad state."""
    mean_loss: Annotated[FiniteFloat, Field(ge=0, lt=1)] | None = None
    """Expected share of lost packets, instead of p and r."""
    mean_burst: Annotated[FiniteFloat, Field(ge=1)] | None = None
    """Mean number of consecutive losses, with mean_loss."""
    state: Literal["link"] | None = None
    """link: all flows share one state, which may change every step_s; the probabilities of changing
    state and mean_burst count these steps. By default each flow has its own, which may change with
    each of its packets."""
    step_s: Annotated[FiniteFloat, Field(ge=1e-6, le=1e6)] | None = None
    """Time between two steps of the link's state, for state = "link"."""

    clauses: ClassVar = (
        Clause(
            "gemodel",
            "loss gemodel 1% 10%",
            Part("good_to_bad", PERCENT, "P"),
            Part("bad_to_good", PERCENT, "R"),
            Part("loss_in_bad", PERCENT, "1-H"),
            Part("loss_in_good", PERCENT, "1-K"),
            _COMMON,
            complement=True,
        ),
        Clause(
            "burst",
            "loss burst 5% 3",
            Part("mean_loss", PERCENT, "MEAN_LOSS"),
            Part("mean_burst", NUMBER, "MEAN_BURST"),
            _COMMON,
            least=2,
        ),
    )
    gives_score: ClassVar = True

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.state is not None and self.step_s is None:
            raise ValueError('step_s: state = "link" needs it: how often the state may change')
        if self.state is None and self.step_s is not None:
            raise ValueError('step_s: it is for state = "link" only')
        chain = (self.good_to_bad, self.bad_to_good)
        means = (self.mean_loss, self.mean_burst)
        if (None in chain) == (None in means) or (None in chain and chain != (None, None)):
            raise ValueError("good_to_bad: give good_to_bad and bad_to_good, or mean_loss and mean_burst")
        if None in chain:
            if (self.loss_in_good, self.loss_in_bad) != (0.0, 1.0):
                raise ValueError(
                    "mean_loss: mean_loss and mean_burst go with loss_in_good 0 and loss_in_bad 1"
                )
            if self.transitions[0] > 1:
                raise ValueError(
                    "mean_burst: so much loss needs longer bursts, at least "
                    f"mean_loss/(1 − mean_loss) = {self._shortest_burst():.4g}"
                )
        elif means != (None, None):
            raise ValueError("mean_loss: goes instead of good_to_bad and bad_to_good")
        return self

    def _shortest_burst(self) -> float:
        loss = self.mean_loss or 0.0
        return loss / (1 - loss)

    @property
    def transitions(self) -> tuple[float, float]:
        """The probabilities p, r. A Gilbert chain has mean burst 1/r and loss rate p/(p + r)."""
        if self.mean_loss is not None and self.mean_burst is not None:
            return self._shortest_burst() / self.mean_burst, 1 / self.mean_burst
        return self.good_to_bad or 0.0, self.bad_to_good or 0.0

    def meaning(self) -> str:
        p, r = self.transitions
        per, unit = "per packet", "packets"
        if self.step_s is not None:
            per = f"per step of {time_text(self.step_s)}, for all flows at once,"
            unit = "steps"
        bad = f"the bad state begins with probability {brief_percent(p)} {per}"
        length = f" and lasts {brief_number(1 / r)} {unit} on average" if r else " and never ends"
        if (self.loss_in_good, self.loss_in_bad) == (0.0, 1.0):
            return f"loses all packets in the bad state; {bad}{length}"
        return (
            f"loses {brief_percent(self.loss_in_bad)} of the packets in the bad state and "
            f"{brief_percent(self.loss_in_good)} in the good state; {bad}{length}"
        )

    def stage(self, tables: StageTables) -> Stage:
        p, r = self.transitions
        numbers = {
            "good_to_bad": p,
            "bad_to_good": r,
            "loss_in_good": self.loss_in_good,
            "loss_in_bad": self.loss_in_bad,
            "share_bad": p / (p + r) if p + r > 0 else 0.0,
            "scored": int(tables.scored),
            "step_ns": round((self.step_s or 0.0) * NS_PER_S),
        }
        return Stage(self.model, numbers)

    def chains(self) -> Sequence[Chain]:
        if self.step_s is not None:
            raise NotPredictableError("losses in a common state depend on when packets arrive")
        p, r = self.transitions
        transitions = np.array([[1 - p, p], [r, 1 - r]])
        return (Chain(np.array([1.0, 0.0]), transitions, np.array([self.loss_in_good, self.loss_in_bad])),)

    def tc_lacks(self, earlier: Sequence[Impairment]) -> str:
        return "" if self.step_s is None else "a state that all flows share"

    def tc_text(self) -> str:
        shares = (*self.transitions, self.loss_in_bad, self.loss_in_good)
        return f"gemodel {' '.join(map(percent_text, shares))}"
