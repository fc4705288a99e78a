"""What is certified for a scenario, as tables and in words.

:func:`certificate_document` begins with one sentence of guarantee; in its long form it has every bound, the
largest settings and the assumptions, too; :func:`margin_document` has the margin of a time-triggered loop,
:func:`mean_cost_document` its mean cost under random losses.
"""

from collections.abc import Iterable, Iterator, Sequence

from cosim.analysis.certificate_rows import certificate_rows, covered_plants
from cosim.analysis.certificates import IDEAL, SCHEDULE, Certificates, state_norm
from cosim.analysis.margin_search import MarginResult
from cosim.analysis.mean_cost import CostUnder, MeanCost
from cosim.analysis.settings_with_certificates import MOST_S, TriedSettings
from cosim.output.guarantee_sentence import although_lost, guarantee_sentence, is_within_allowed
from cosim.output.run_document import assumption_table
from cosim.simulation.sampled_loop import SampledLoop
from netem.core.errors import CallerError
from netem.core.number_format import at_least, at_most, duration_at_least, number
from netem.output.document import Block, Document, Sentence, SentenceRole
from netem.output.result_tables import ResultTable, Tone
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.assumptions import AssumptionStatus, other_sign, paper_assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import EQUATIONS, outside_box
from noack.theory.coverage import is_papers_loop
from noack.theory.witnesses.loss_margin import Stability

_MOST_BOUNDS = 6
"""Outputs whose bounds are printed without --verbose."""
_MORE = Sentence(
    role=SentenceRole.NOTE,
    text="--verbose shows every bound, the largest settings and the assumptions; --paper shows the paper's "
    "theorems",
)
_MEANING = (
    "t in s. paper: no sampling, no delay, no hold. schedule: the scenario's rates, plus the lateness that "
    "it allows. plant: the scenario's plant. box: every plant of the uncertainty box. Errors are in the "
    "trigger's norm; with noise or an observer e_s and e_c are x_s − x̂ and x_c − x̂."
)


def certificate_document(results: Certificates, *, verbose: bool = False, paper: bool = False) -> Document:
    """Return what is guaranteed: a sentence and few lines, or with ``verbose`` all tables, too.

    Args:
        results: the certificates.
        verbose: with every bound, the largest settings and the assumptions.
        paper: with the paper's assumptions and statements.
    """
    blocks: list[Block] = [_first_sentence(results), *_too_large(results)]
    blocks += _all_tables(results) if verbose else _few_lines(results)
    if paper or (verbose and results.scenario.certificate.paper):
        blocks += _paper(results)
    if verbose:
        blocks += map(_prose, (*_in_words(results), *_stability_in_words(results)))
    else:
        blocks.append(_MORE)
    if not results.answer.is_certified:
        blocks.append(_advice(results))
    return Document(title=results.scenario.name, data=results.to_json(), blocks=blocks)


def _all_tables(results: Certificates) -> Iterator[Block]:
    """Yield the bounds, the largest settings, and the assumptions."""
    if (table := certificate_table(results)) is not None:
        yield table
        yield Sentence(text=_MEANING, role=SentenceRole.NOTE)
    else:
        yield _prose(f"{_title(results)}: none")
    yield from _unproven(results)
    if (box := results.helpful_box) is not None:
        yield _prose(f"the box has one{_listed('', [box])}")
    yield from _regions(results)
    yield from _about_rest(results)
    if largest := _listed(
        "this plant still has a certificate, with larger bounds,", results.largest_settings
    ):
        yield _prose(largest)
    if (outside := outside_box(results.scenario)) is not None:
        yield _doubt("the box certificates do not cover this plant:", outside)
    yield _prose("assumptions of the certificates for the schedule:")
    yield assumption_table(results.schedule.assumptions)


def _paper(results: Certificates) -> Iterator[Block]:
    """Yield the paper's assumptions and statements, which are about a continuous trigger."""
    certificate = results.paper
    if not (certificate is not None and certificate.has("x")):
        yield _prose("under the paper's conditions, without sampling, delay and hold, no bound is proven")
    else:
        only = "only " if results.guaranteed is None else ""
        formula = certificate.formula(state_norm(results), "x")
        yield _prose(
            f"proved {only}under the paper's conditions, without sampling, delay and hold: {formula}"
        )
    yield _prose("assumptions of the paper's theorems:")
    yield assumption_table(paper_assumptions(results.scenario))
    if (theorem := results.theorem_2) is not None:
        yield _prose(
            f"the paper's Theorem 2, computed with the proven Δ = {at_most(theorem.delta)}: events are at "
            f"least {at_least(theorem.inter_event_s)} s apart, and "
            f"‖x‖ ≤ {at_most(theorem.state_start + theorem.state_forced)}"
        )


def _few_lines(results: Certificates) -> Iterator[Sentence]:
    """Yield the bounds of the outputs and of ‖x‖, and what they assume."""
    certificate = results.guaranteed
    if certificate is not None:
        bounds = results.stated_bounds(certificate)
        for bound in [bound for bound in bounds if bound.output.allowed is not None][:_MOST_BOUNDS]:
            yield _prose(f"{bound.formula} (proved)")
        if results.scenario.outputs:  # else the first sentence has it
            yield _prose(f"{certificate.formula(state_norm(results), 'x')} (proved)")
        if (box := results.schedule_box) is not None and not box.exists:
            yield _doubt("these are of this plant alone:", "nothing is proven for the stated uncertainty")
        yield from _about_rest(results)
        apart_s = certificate.inter_event_s
        if apart_s is not None and apart_s < MOST_S:
            yield _prose(_apart_in_words(certificate, apart_s))
        assumed = [each.what for each in certificate.assumptions if each.verdict is AssumptionStatus.ASSUMED]
        yield _prose(f"assumed, and checked in each run: {'; '.join(assumed)}")
    if (outside := outside_box(results.scenario)) is not None:
        yield _doubt("the stated uncertainty does not contain this plant:", outside)
    yield from map(_prose, _stability_in_words(results))


def _about_rest(results: Certificates) -> Iterator[Sentence]:
    """Yield where the loop rests under its loads, if that is not at 0."""
    if results.rest:
        rest = ", ".join(f"{name} = {number(value)}" for name, value in results.rest.items())
        yield _prose(f"x is the distance from where the loop rests under its load: {rest}")


def _first_sentence(results: Certificates) -> Sentence:
    """Return what is guaranteed, in one sentence."""
    text = guarantee_sentence(results)
    if text is not None:
        tone = Tone.GOOD if is_within_allowed(results) else Tone.DOUBTFUL
        return Sentence(text=text, role=SentenceRole.VERDICT, tone=tone, is_prose=True)
    why = results.answer.text.removeprefix("no certificate").lstrip(": ")
    if _is_stable(results):
        late = "" if results.stability is None else _lateness(results.stability.late)
        text = f"stable {late}{although_lost(results.scenario)} (proved); no bound: {why}"
        return Sentence(text=text, role=SentenceRole.VERDICT, tone=Tone.DOUBTFUL, is_prose=True)
    text = f"no guarantee{f': {why}' if why else ''}"
    return Sentence(text=text, role=SentenceRole.VERDICT, tone=Tone.DOUBTFUL, is_prose=True)


def _too_large(results: Certificates) -> Iterator[Sentence]:
    """Yield for each output whose bound exceeds its allowed error what would have to change."""
    for name, advice in results.threshold_advice.items():
        yield _doubt(f"{name} may exceed its allowed error:", advice)


def _prose(text: str) -> Sentence:
    return Sentence(text=text, is_prose=True)


def _doubt(lead: str, text: str) -> Sentence:
    return Sentence(lead=lead, text=text, tone=Tone.DOUBTFUL, is_prose=True)


def _advice(results: Certificates) -> Sentence:
    """Return that there is no certificate, and settings with which there is one."""
    parts = [f"so no bound of ‖x‖{', though the loop is stable' if _is_stable(results) else ''}"]
    if hint := other_sign(loop_of(results.scenario)):
        parts.append(hint)
    if not results.is_searched and is_papers_loop(results.scenario):  # a search covers no other loop
        parts.append("a search, noack certify without --no-search, may find one if none has failed yet")
    if settings := _listed("there is one", results.helpful_settings):
        parts.append(settings)
    if _is_searched_for_losses(results.scenario):
        parts.append("noack adversary shows what losses can do to this loop")
    return _doubt("no certificate for the schedule,", "; ".join(parts))


def _is_stable(results: Certificates) -> bool:
    """Return whether no loss pattern makes a time-triggered loop grow in the long run, as proven."""
    return results.stability is not None and results.stability.verdict == "stable"


def _is_searched_for_losses(resolved: Scenario) -> bool:
    """Return whether ``noack adversary`` covers a loop that has no certificate."""
    if not resolved.coverage.is_linear:
        return False
    try:
        SampledLoop(resolved)
    except CallerError:
        return False
    return True


def _listed(what: str, tried: Sequence[TriedSettings]) -> str:
    """Return settings that were tried as one text; empty if there are none."""
    if not tried:
        return ""
    alone = "; each was tried alone" if len(tried) > 1 else ""
    return f"{what} with {', or with '.join(settings.text for settings in tried)}{alone}"


def _in_words(results: Certificates) -> Iterator[str]:
    """Yield sentences with the bounds for the scenario's schedule."""
    for under, certificate in results:
        if under != SCHEDULE or not certificate.has("x"):
            continue
        apart, apart_s = "", certificate.inter_event_s
        if apart_s is not None and apart_s < MOST_S:  # else there is no second event
            apart = f" {_apart_in_words(certificate, apart_s)}"
        meaning = certificate.conditions.guarantee.meaning
        losses = f"for every pattern of losses with {meaning}"
        if not results.scenario.network.enforce_mansd:
            losses = f"as long as there are {meaning}, which nothing enforces"
        yield (
            f"In words: for {certificate.scope}, under the assumptions above and {losses}: "
            f"{certificate.formula(state_norm(results), 'x')} (proved).{apart}"
        )


def _apart_in_words(certificate: ScenarioCertificate, apart_s: float) -> str:
    exception = certificate.proven.exception if certificate.proven is not None else ""
    least = duration_at_least(apart_s)
    return f"The inter-event time is at least {least}{f', {exception}' if exception else ''} (proved)."


def _stability_in_words(results: Certificates) -> Iterator[str]:
    """Yield what is known exactly about the stability of a time-triggered loop."""
    stability = results.stability
    if stability is None or (stability.verdict == "undecided" and results.guaranteed is not None):
        return
    patterns = f"every loss pattern with {results.scenario.network.guarantee.meaning}"
    growth = f"growth per period {at_least(stability.lower)} to {at_most(stability.upper)}"
    text = {
        "stable": f"Proven stable for {patterns}: {growth}",
        "destabilised": f"Not stable: the pattern {stability.text} (D delivered, L lost), repeated, "
        f"destabilises the loop: {growth}",
        "undecided": f"Not decided whether the loop is stable for {patterns}: {growth} under the worst one",
    }[stability.verdict]
    yield f"{text}. This is {_lateness(stability.late)}; noack margin finds the limits."


def _lateness(steps: int) -> str:
    """Return how late inputs may act for what is proven of the growth."""
    if not steps:
        return "if nothing is late"
    return f"if inputs act at most {steps} step{'s' * (steps > 1)} of the plant late"


def _title(results: Certificates) -> str:
    trigger = results.scenario.trigger
    norm = "‖W·‖" if trigger.weight is not None else "‖·‖"
    guarantee = results.schedule.conditions.guarantee  # its longest burst counts all rules
    return f"{results.scenario.name}: {guarantee.meaning}; event: {trigger.description}; norm {norm}"


def certificate_table(results: Certificates) -> ResultTable | None:
    """Return the bounds of the certificates that exist; None if there are none.

    Plants and conditions without a certificate have no column.
    """
    columns = [(under, certificate) for under, certificate in results if certificate.exists]
    if not columns:
        return None
    headings = ["", *(f"{under},\n{covered_plants(certificate)}" for under, certificate in columns)]
    certificates = [certificate for _, certificate in columns]
    outputs = [results.stated_bounds(certificate) for certificate in certificates]
    rows = [
        (label, *values) for label, values in certificate_rows(certificates, outputs, state_norm(results))
    ]
    return ResultTable("certificates", _title(results), headings, rows)


def _regions(results: Certificates) -> Iterator[Sentence]:
    """Yield what a plant by its equations does not leave."""
    loop = loop_of(results.scenario)
    names = (*loop.state_names, *loop.input_names)
    for under, certificate in results:
        if certificate.scope != EQUATIONS or certificate.proven is None:
            continue
        entries = certificate.proven.entries(loop.n, loop.m)
        text = ", ".join(f"|{names[index]}| ≤ {at_most(sum(bound))}" for index, bound in entries.items())
        if text:
            yield Sentence(lead="region", text=f"({under}): {text}", tone=Tone.GOOD, is_prose=True)


def _unproven(results: Certificates) -> Iterator[Sentence]:
    """Yield why no bound is proven for some plants under some conditions."""
    names = {"ideal": IDEAL, "schedule": SCHEDULE, "own": "plant", "box": "box", "region": "plant"}
    reasons: dict[str, list[str]] = {}
    for plants, conditions, reason in results.unproven:
        reasons.setdefault(reason, []).append(f"{names[conditions]}, {names[plants]}")
    for reason, columns in reasons.items():
        yield _doubt("nothing is proven", f"({'; '.join(columns)}): {reason}")


_MARGIN_TONES = {"stable": Tone.GOOD, "destabilised": Tone.BAD, "undecided": Tone.DOUBTFUL}


def _growth(growth: Stability) -> tuple[str, str]:
    return at_least(growth.lower, decimals=9), at_most(growth.upper, decimals=9)


def margin_document(margin: MarginResult) -> Document:
    """Return the bounds for each number of losses in a row, and the verdicts."""
    proof = [] if margin.proof is None else margin.proof.lines
    texts = [margin.verdict, *margin.condition_texts, *proof, *margin.compared.relations]
    if margin.period is not None:
        texts.append(f"for {margin.guarantee}: {margin.period.text}")
    note = "D delivered, L lost, repeated. Below 1: every pattern is stable."
    if not margin.is_periodic:
        note += " In brackets: the time to the next update."
    if margin.certificate is not None and not margin.certificate.is_certified:
        note += " A loop without a certificate may be stable; a search, noack certify, may find one."
    return Document(
        title=margin.scenario,
        data=margin.to_json(),
        blocks=[
            *margin_tables(margin),
            *(Sentence(text=text) for text in (*texts, margin.random_text, *margin.certificate_texts)),
            Sentence(text=note, role=SentenceRole.NOTE),
        ],
    )


def margin_tables(margin: MarginResult) -> Iterator[ResultTable]:
    """Yield the bounds of the growth for each number of losses in a row, and for compared guarantees."""
    delay = f", updates delayed by {margin.delay_s:g} s" if margin.delay_s else ""
    times = f"with an update every {margin.period_s:g} s"
    if not margin.is_periodic:
        times = f"with updates {margin.shortest_s:g} to {margin.period_s:g} s apart"
    yield ResultTable(
        "margin",
        f"{margin.scenario}: growth of the worst loss pattern per {margin.period_s:g} s, "
        f"{times}, {margin.between_updates}{delay}",
        ("lost in a row", "growth at least", "growth at most", "verdict"),
        [(str(mansd), *_growth(growth), growth.verdict) for mansd, growth in margin.caps],
        left=[3],
        tones=_MARGIN_TONES,
    )
    if margin.compared.guarantees:
        rows = [
            (meaning, *_growth(growth), growth.text, growth.verdict)
            for meaning, growth in margin.compared.guarantees
        ]
        title = f"{margin.scenario}: the scenario's guarantee, and others"
        headings = ("guarantee", "at least", "at most", "worst pattern", "verdict")
        yield ResultTable("guarantees", title, headings, rows, left=[4], tones=_MARGIN_TONES)


def mean_cost_document(cost: MeanCost) -> Document:
    """Return the moments and costs with and without the guarantee."""
    unknown = {name: getattr(cost, name) for name in ("with_guarantee", "without_guarantee")}
    blocks: list[Block] = [*mean_cost_tables(cost)]
    blocks += [
        Sentence(text=reason, lead=f"{name.replace('_', ' the ')}:", tone=Tone.DOUBTFUL)
        for name, reason in unknown.items()
        if isinstance(reason, str)
    ]
    note = (
        "The cost is ∫ xᵀQx + uᵀRu dt, between the samples, too; u: of the controller. "
        "Rms: stationary, what the loop tends to from any start, over time. Growth below 1: stable "
        "in mean square; z: the loop's state, x, x_c and the inputs in use. All numbers are computed, not "
        "proved."
    )
    blocks.append(Sentence(text=note, role=SentenceRole.NOTE))
    return Document(title=cost.scenario, data=cost.to_json(), blocks=blocks)


def mean_cost_tables(costs: MeanCost) -> Iterator[ResultTable]:
    """Yield the moments and costs with and without the guarantee."""
    both = (costs.with_guarantee, costs.without_guarantee)
    known = [cost for cost in dict.fromkeys(both) if isinstance(cost, CostUnder)]
    mode = "model-based" if costs.mode == "model" else "zero-order hold"
    title = f"{costs.scenario}: computed moments and cost, with an update every {costs.period_s:g} s, {mode}"
    headings = ["", *(cost.guarantee for cost in known)]
    rows = [("growth of √E‖z‖² per period", *(f"{cost.growth:.6g}" for cost in known))]

    def add(label: str, values: Iterable[float | None], unit: str = "") -> None:
        rows.append((label, *("∞" if value is None else number(value, 6) + unit for value in values)))

    for rms, names, suffix in (
        ("state_rms", costs.state_names, ""),
        ("state_rms_at_transmissions", costs.state_names, " at transmissions"),
        ("input_rms", costs.input_names, ""),
    ):
        for i, name in enumerate(names):
            add(f"rms of {name}{suffix}", (getattr(cost.stationary, rms)[i] for cost in known))
    add("mean cost, stationary", (cost.stationary.cost_per_s for cost in known), " /s")
    costs_until = [cost.horizon_cost for cost in known]
    until = ["not known: too many periods" if cost is None else number(cost, 6) for cost in costs_until]
    rows.append((f"mean cost from x(0) until {costs.horizon_s:g} s", *until))
    transients = (cost.transient_cost for cost in known)
    add("mean cost from x(0), without disturbances and noise", transients)
    yield ResultTable("cost", title, headings, rows)
