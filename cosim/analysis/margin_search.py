"""The loss margin of a loop: how many packets may be lost in a row, and how far apart events may be.

Other guarantees than the scenario's own one are compared with it, too: their growth, and which of
them imply others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from typing import NamedTuple

from cosim.analysis.certificates import CertificateAnswer, answer_for
from cosim.analysis.margin_proof import MarginProof, margin_proof
from netem.core.clock import NS_PER_S
from netem.core.command_line import StopRequestError
from netem.core.errors import CallerError
from netem.core.number_checks import real_number, whole_number
from netem.core.number_format import at_least, at_most
from netem.guarantee.loss_guarantee import LossGuarantee, OutcomePattern, find_counterexample, outcome_letters
from netem.impairments.link_settings import LinkSettings
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import loss_process
from netem.tc_words import guarantee_words, settings_of
from noack.scenario.arrival_ties import late_inputs
from noack.scenario.scenario import Scenario
from noack.theory.random_losses.mean_square_growth import MeanSquareGrowth, growth_without_guarantee
from noack.theory.witnesses.loss_margin import ACCURACY, LossMargin, Stability

MOST_MANSD = 15
"""Largest number of losses in a row that is examined by default."""
_LARGEST_MANSD = 999
"""Largest number of losses in a row that may be examined."""
_LARGEST_EFFORT = 1e6
"""Largest factor of the work that may be asked for."""

_CAPS, _OTHERS, _PERIOD = "losses in a row", "the other guarantees", "the longest period"
_RANDOM, _CERTIFICATE = "random losses", "the certificate"
"""What is examined, in this order."""

MarginProgress = Callable[[str], None]
"""Receives what is examined next."""


class ComparedGuarantee(NamedTuple):
    """A guarantee, and what is known about the loop with it."""

    meaning: str
    """The guarantee in words."""
    stability: Stability


class GuaranteeComparison(NamedTuple):
    """Some guarantees, the scenario's own one first."""

    guarantees: tuple[ComparedGuarantee, ...] = ()
    relations: tuple[str, ...] = ()
    """Sentences; for each two guarantees, which one implies the other."""


def read_guarantee(words: str) -> LossGuarantee:
    """Read a guarantee from words, such as ``mansd 4 atmost 3 in 10``.

    Raises:
        CallerError: the words are wrong, have other parts, or do not limit consecutive losses.
    """
    settings = settings_of(str(words), ("mansd", "atmost", "recover"))
    if settings != LinkSettings(mansd=settings.mansd, constraints=settings.constraints):
        raise CallerError(
            f'guarantee "{words}": expected only mansd, atmost and recover, e.g. '
            f'"{" ".join(guarantee_words(settings)) or "mansd 4 atmost 3 in 10"}"'
        )
    guarantee = settings.guarantee
    if guarantee.longest_burst is None:
        raise CallerError(f'guarantee "{words}": needs a maximum of losses: mansd or atmost')
    return guarantee


def compare_guarantees(
    guarantees: Sequence[LossGuarantee], examine: Callable[[LossGuarantee], Stability]
) -> GuaranteeComparison:
    """Examine guarantees. One that implies another does not grow faster.

    Raises:
        CallerError: a guarantee has too many states to be compared.
    """
    beyond = {
        (i, j): find_counterexample(guarantees[i], guarantees[j])
        for i, j in permutations(range(len(guarantees)), 2)
    }
    stabilities = [examine(guarantee) for guarantee in guarantees]
    for (i, j), pattern in beyond.items():
        if pattern is None:
            stabilities[i] = stabilities[i].with_upper_of(stabilities[j])
            stabilities[j] = stabilities[j].with_lower_of(stabilities[i])
    meanings = [guarantee.meaning for guarantee in guarantees]
    relations = tuple(
        _relation((meanings[i], beyond[i, j]), (meanings[j], beyond[j, i]))
        for i, j in combinations(range(len(guarantees)), 2)
    )
    return GuaranteeComparison(tuple(map(ComparedGuarantee, meanings, stabilities)), relations)


def _relation(first: tuple[str, OutcomePattern | None], second: tuple[str, OutcomePattern | None]) -> str:
    """Return the relation of two guarantees, each with a pattern that the other one forbids."""
    (meaning, pattern), (other_meaning, other_pattern) = first, second
    if pattern is None and other_pattern is None:
        return f"“{meaning}” and “{other_meaning}” allow the same patterns"
    if pattern is None:
        return _implication(meaning, other_meaning, other_pattern or ())
    if other_pattern is None:
        return _implication(other_meaning, meaning, pattern)
    return (
        f"neither of “{meaning}” and “{other_meaning}” implies the other: only the first allows "
        f"{outcome_letters(pattern)}, only the second {outcome_letters(other_pattern)}"
    )


def _implication(meaning: str, implied: str, beyond: OutcomePattern) -> str:
    return f"“{meaning}” implies “{implied}”, which also allows {outcome_letters(beyond)}"


_NOT_COMPARED = GuaranteeComparison()


def undecided_text(stability: Stability) -> str:
    """Return the bounds of an undecided growth."""
    lower, upper = stability.lower, stability.upper
    gap = f"gap {upper - lower:.2g}; a larger --effort may decide it"
    return f"growth between {at_least(lower, 6)} and {at_most(upper, 6)}, {gap}"


class LossCap(NamedTuple):
    """A limit of the losses in a row, with the stability of the loop under it."""

    mansd: int
    """At most this number of packets is lost in a row."""
    stability: Stability

    @property
    def settings(self) -> tuple[str, ...]:
        """The settings of a scenario that plays the pattern again and again, time-triggered.

        Raises:
            CallerError: the times between the updates of the pattern differ.
        """
        pattern = self.stability.pattern
        if not self.stability.is_periodic:
            raise CallerError(
                "--play: the times between the updates of the pattern differ, so no trigger "
                "policy transmits at them"
            )
        lost = [number for number, delivered in enumerate(pattern) if not delivered]
        script = f'{{model="scripted", lost={lost}, repeat_every={len(pattern)}}}'
        trigger = f'{{policy="periodic", period_s={self.stability.intervals_s[0]!r}}}'
        return f"network.mansd={self.mansd}", f"network.loss={script}", f"trigger={trigger}"

    @property
    def text(self) -> str:
        """The result in words."""
        bounds = f"growth per period {at_least(self.stability.lower)} to {at_most(self.stability.upper)}"
        return f"at most {self.mansd} lost in a row: {self.stability.verdict}, {bounds}"


class PeriodLimit(NamedTuple):
    """Two periods between which all patterns of the scenario's guarantee cease to be stable."""

    stable_s: float | None
    """A period that is proven stable; None: none was found."""
    unstable_s: float | None
    """The next longer period that was examined; it is not proven stable. None: none was found."""
    is_longest: bool
    """The period is the longest time between two updates; shorter times are possible."""
    stability: Stability | None
    """What is known about ``unstable_s``."""

    @property
    def text(self) -> str:
        """The limit in words."""
        apart = "updates at most" if self.is_longest else "an update every"
        if self.stability is None:
            return (
                f"proven stable for every loss pattern with {apart} {self.stable_s:g} s, the longest examined"
            )
        longer = f"{apart} {self.unstable_s:g} s: undecided, {undecided_text(self.stability)}"
        if self.stability.verdict == "destabilised":
            longer = f"{apart} {self.unstable_s:g} s: this pattern destabilises: {self.stability.text}"
        if self.stable_s is None:
            return f"no stable period was found; {longer}"
        return f"proven stable for every loss pattern with {apart} {self.stable_s:g} s; {longer}"


@dataclass(frozen=True)
class MarginResult:
    """The loss margin of a loop.

    ``print`` shows it in words; ``caps`` has the bounds for each number of losses in a row, ``period`` the
    longest period.
    """

    scenario: str
    mode: str
    between_updates: str
    """What the controller does between updates, in words."""
    mansd: int
    """The scenario's largest number of losses in a row."""
    guarantee: str
    shortest_s: float
    """The shortest time between two transmissions."""
    period_s: float
    """The longest time between two transmissions."""
    delay_s: float
    """Delay of an update in the network."""
    caps: tuple[LossCap, ...]
    """For 0, 1, 2, … losses in a row, up to the first number that destabilises, or the largest examined."""
    every_mansd: bool
    """The constraints of the network allow no more losses with a larger ``mansd``."""
    period: PeriodLimit | None
    """None if it was not searched for."""
    without_guarantee: MeanSquareGrowth | str
    """The growth under the scenario's losses if nothing limits them, or why it is not known."""
    certificate: CertificateAnswer | None = None
    """Whether the scenario has a certificate; None if this was not examined."""
    proof: MarginProof | None = None
    """What noack-check has proven of the largest stable number of losses and of the destabilising pattern."""
    effort: float = 1.0
    """Factor of the limits of the work for a decision."""
    compared: GuaranteeComparison = _NOT_COMPARED
    """The scenario's guarantee and others, if there are others."""
    ties: str = ""
    """Which order of an update and a tick is not known, in words."""
    late_inputs: str = ""
    """How late inputs may act in what is proven, in words."""
    missing: tuple[str, ...] = ()
    """What was not examined, in words, because the search was stopped."""

    @property
    def is_periodic(self) -> bool:
        """Whether the sensor is time-triggered: its period is the time between all updates."""
        return self.shortest_s == self.period_s

    @property
    def stable_mansd(self) -> int | None:
        """The largest number of losses in a row with which every pattern is stable; None: not even 0."""
        stable = [cap.mansd for cap in self.caps if cap.stability.verdict == "stable"]
        return max(stable, default=None)

    @property
    def destabilised(self) -> LossCap | None:
        """The smallest number of losses in a row with a destabilising pattern, if one was found."""
        last = self.caps[-1]
        return last if last.stability.verdict == "destabilised" else None

    @property
    def verdict(self) -> str:
        """The margin in words."""
        most = self.stable_mansd
        stable, parts = "stable" if self._is_unverified else "proven stable", []
        if most == self.caps[-1].mansd and self.every_mansd:
            parts = [f"{stable} for every loss pattern that the constraints allow, with any mansd ≥ {most}"]
        elif most is not None:
            parts = [f"{stable} for every loss pattern with at most {most} lost in a row"]
        parts += [
            f"{guarantee.meaning}: undecided, {undecided_text(guarantee.stability)}"
            for guarantee in self.compared.guarantees
            if guarantee.stability.verdict == "undecided"
        ]
        parts += [
            f"{cap.mansd} lost in a row: undecided, {undecided_text(cap.stability)}"
            for cap in self.caps  # of fewer losses all are stable
            if cap.stability.verdict == "undecided" and (most is None or cap.mansd > most)
        ]
        if (last := self.destabilised) is not None:
            parts.append(f"with {last.mansd} lost in a row this pattern destabilises: {last.stability.text}")
        return "; ".join(parts)

    def __repr__(self) -> str:
        """Return the verdicts."""
        period = [self.period.text] if self.period else []
        proof = [] if self.proof is None else self.proof.lines
        texts = [
            self.verdict,
            *self.condition_texts,
            *proof,
            *self.compared.relations,
            *period,
            self.random_text,
        ]
        return "\n".join([*texts, *self.certificate_texts])

    @property
    def condition_texts(self) -> list[str]:
        """What the verdict rests on: its verification, and what a live run may do at equal nominal times."""
        return [text for text in (self.unverified_text, self.ties, self.late_inputs) if text]

    @property
    def _is_unverified(self) -> bool:
        """Whether noack-check has not verified that the loop is stable with the largest number of losses."""
        caps = () if self.proof is None else self.caps
        verified = max((cap.mansd for cap in caps if "most" in cap.stability.entries), default=-1)
        return self.stable_mansd is not None and verified < self.stable_mansd

    @property
    def unverified_text(self) -> str:
        """What of the verdict noack-check has not verified, as a sentence; empty if it has verified all."""
        last, whats = self.destabilised, list[str]()
        if self._is_unverified:
            whats.append(f"that the loop is stable with at most {self.stable_mansd} lost in a row")
        if last is not None and (self.proof is None or "least" not in last.stability.entries):
            whats.append(f"that a pattern with {last.mansd} lost in a row destabilises it")
        if not whats:
            return ""
        return f"{' and '.join(whats)}: computed by noack with error bounds, not verified by noack-check"

    @property
    def random_text(self) -> str:
        """What holds for random losses without the guarantee, as a sentence."""
        growth = self.without_guarantee
        text = growth if isinstance(growth, str) else growth.text
        return f"if losses were only random, without the guarantee: {text}"

    @property
    def certificate_texts(self) -> tuple[str, ...]:
        """The answer of ``noack certify``, as a line; none if it was not examined."""
        if self.certificate is None:
            return ()
        return (f"noack certify --no-search, for {self.guarantee}: {self.certificate.text}",)

    def to_json(self) -> dict[str, object]:
        """Return all fields and the verdicts for JSON."""
        period: dict[str, object] | None = None
        if (limit := self.period) is not None:
            period = limit._asdict() | {"text": limit.text}
            del period["stability"]
            period["found"] = None if limit.stability is None else limit.stability.to_json()
        growth = self.without_guarantee
        return vars(self) | {
            "verdict": self.verdict,
            "stable_mansd": self.stable_mansd,
            "caps": [{"mansd": cap.mansd, **cap.stability.to_json()} for cap in self.caps],
            "compared": [
                {"guarantee": guarantee.meaning, **guarantee.stability.to_json()}
                for guarantee in self.compared.guarantees
            ],
            "relations": self.compared.relations,
            "period": period,
            "without_guarantee": growth if isinstance(growth, str) else growth._asdict(),
            "certificate": None if self.certificate is None else self.certificate._asdict(),
            "proof": None if self.proof is None else {"proven": self.proof.proven},
            "unverified": self.unverified_text,
        }


def find_margin(
    resolved: Scenario,
    *,
    most_mansd: int = MOST_MANSD,
    accuracy: float = ACCURACY,
    with_period: bool = True,
    guarantees: Sequence[str] = (),
    effort: float = 1.0,
    progress: MarginProgress = lambda text: None,
    decided: Callable[[LossCap], None] = lambda cap: None,
    on_stop: Callable[[StopRequestError], None] | None = None,
) -> MarginResult:
    """Find the margin of a scenario's loop.

    Args:
        resolved: the resolved scenario; its trigger has a longest time between two events.
        most_mansd: largest number of losses in a row to examine.
        accuracy: wanted ratio of upper and lower bound, minus 1.
        with_period: whether to search for the longest period, too.
        guarantees: other guarantees to examine, in words such as ``mansd 4 atmost 3 in 10``.
        effort: factor of the limits of the work for a decision.
        progress: receives what is examined next.
        decided: receives the result for each number of losses in a row, as soon as it is known.
        on_stop: receives the request to stop, after which the result has what was decided until then;
            without it, or before a result without losses, the request is raised.

    Raises:
        CallerError: the loop is not covered, or a number is out of range.
        StopRequestError: see ``on_stop``.
    """
    most = whole_number("most", most_mansd, 0, _LARGEST_MANSD)
    _require_in_range(accuracy, effort)
    margin, network = LossMargin(resolved), resolved.network
    other_rules = network.guarantee.uncapped
    words_of_others = [guarantees] if isinstance(guarantees, str) else guarantees
    others_read = [read_guarantee(words) for words in words_of_others]

    def examine(guarantee: LossGuarantee, name: str = "") -> Stability:
        progress(name or guarantee.meaning)
        return margin.stability(guarantee, accuracy, effort=effort)

    caps: list[LossCap] = []
    every_mansd, compared = False, _NOT_COMPARED
    limit: PeriodLimit | None = None
    growth: MeanSquareGrowth | str = "not examined"
    certificate: CertificateAnswer | None = None
    proof: MarginProof | None = None
    missing = [_CAPS, *([_OTHERS] if others_read else []), *([_PERIOD] if with_period else [])]
    missing += [_RANDOM, _CERTIFICATE]
    try:
        # 0, 1, 2, … up to the first number that destabilises, or that the other rules imply.
        for mansd in range(most + 1):
            text = f"at most {mansd} lost in a row (up to {most})"
            caps.append(LossCap(mansd, examine(other_rules.capped(mansd), text)))
            decided(caps[-1])
            every_mansd = other_rules.longest_burst is not None and other_rules.longest_burst <= mansd
            if every_mansd or caps[-1].stability.verdict == "destabilised":
                break
        missing.remove(_CAPS)
        progress("a proof for noack-check")
        proof = margin_proof(margin, [cap.stability for cap in caps], resolved.loop_outputs(), network.mansd)
        if others_read:
            compared = compare_guarantees([network.guarantee, *others_read], examine)
            missing.remove(_OTHERS)
        if with_period:
            limit = find_longest_period(resolved, progress)
            missing.remove(_PERIOD)
        growth = _without_guarantee(resolved, progress)
        missing.remove(_RANDOM)
        progress(_CERTIFICATE)
        certificate = answer_for(resolved)
        missing.remove(_CERTIFICATE)
    except StopRequestError as stop:
        if on_stop is None or not caps:
            raise
        on_stop(stop)
    return MarginResult(
        scenario=resolved.name,
        mode=resolved.mode,
        between_updates=resolved.between_updates,
        mansd=network.mansd,
        guarantee=network.guarantee.meaning,
        shortest_s=margin.seconds(margin.shortest),
        period_s=margin.seconds(margin.longest),
        delay_s=float(margin.delay_ns / NS_PER_S),
        caps=_with_implied_bounds(caps),
        every_mansd=every_mansd,
        period=limit,
        without_guarantee=growth,
        certificate=certificate,
        proof=proof,
        effort=effort,
        compared=compared,
        ties=margin.ties,
        late_inputs=_of_late_inputs(resolved, margin),
        missing=tuple(f"{len(caps)} and more {_CAPS}" if what == _CAPS else what for what in missing),
    )


def _with_implied_bounds(caps: Sequence[LossCap]) -> tuple[LossCap, ...]:
    """Return the results for 0, 1, 2, … losses in a row with what follows from each other.

    A larger number allows all patterns of a smaller one: the larger number has the smaller one's lower bound,
    and the smaller number has the larger one's upper bound.
    """
    bounds = [cap.stability for cap in caps]
    for i in range(1, len(caps)):
        bounds[i] = bounds[i].with_lower_of(bounds[i - 1])
    for i in reversed(range(1, len(caps))):
        bounds[i - 1] = bounds[i - 1].with_upper_of(bounds[i])
    return tuple(cap._replace(stability=stability) for cap, stability in zip(caps, bounds, strict=True))


def _of_late_inputs(resolved: Scenario, margin: LossMargin) -> str:
    """Return how late inputs may act in what is proven."""
    if margin.late:
        return f"an input may act up to {margin.late} steps of the plant late, anew each time"
    text = late_inputs(resolved)
    if not text and resolved.certificate.late_periods:
        text = "inputs are assumed to act on time: there are too many ticks in a period for other outcomes"
    return text


def _require_in_range(accuracy: float, effort: float) -> None:
    if not 1e-8 <= real_number("accuracy", accuracy) < 1:
        raise CallerError(f"accuracy {accuracy:g}: expected a number from 1e-8 to 1, e.g. 1e-4")
    if not 0 < real_number("effort", effort) <= _LARGEST_EFFORT:
        raise CallerError(f"effort {effort:g}: expected a factor of the work up to 1e6, e.g. 10")


def _without_guarantee(resolved: Scenario, progress: MarginProgress) -> MeanSquareGrowth | str:
    progress("random losses")
    try:
        return growth_without_guarantee(resolved, loss_process(resolved.network.link))
    except NotPredictableError as error:
        return f"not known: {error}"


def find_longest_period(resolved: Scenario, progress: MarginProgress = lambda text: None) -> PeriodLimit:
    """Find a stable period and an unstable one that is one measurement longer.

    From the scenario's period on, periods are doubled or halved until one is stable and one is not;
    then the interval between them is bisected. Stability need not be monotonic in the period, so
    nothing is said about periods that were not examined.
    """
    examined: dict[int, Stability] = {}

    def is_stable(steps: int) -> bool:
        progress(f"the longest period: {own_margin.seconds(steps):g} s")
        examined[steps] = LossMargin(resolved, steps).coarse_bounds()
        return examined[steps].verdict == "stable"

    own_margin = LossMargin(resolved)
    is_longest = own_margin.shortest < own_margin.longest
    measurement_ns = resolved.timing.measurement_period.exact
    longest = max(int(resolved.timing.horizon_ns / measurement_ns), own_margin.longest)
    shortest = min(int(own_margin.delay_ns / measurement_ns) + 1, own_margin.longest)
    if is_longest:  # below the policy's least time, all times between updates would be equal
        shortest = max(shortest, own_margin.shortest)
    stable, unstable = 0, 0
    steps = own_margin.longest
    while not stable or not unstable:
        if is_stable(steps):
            stable = steps
            if steps == longest:
                return PeriodLimit(own_margin.seconds(steps), None, is_longest, None)
            next_steps = min(2 * steps, longest)
        else:
            unstable = steps
            if steps == shortest:
                break
            next_steps = max(steps // 2, shortest)
        steps = next_steps
    while stable and unstable - stable > 1:
        steps = (stable + unstable) // 2
        stable, unstable = (steps, unstable) if is_stable(steps) else (stable, steps)
    return PeriodLimit(
        own_margin.seconds(stable) if stable else None,
        own_margin.seconds(unstable),
        is_longest,
        examined[unstable],
    )
