"""What is certified for a scenario, as tables and in words.

:func:`certificate_document` begins with one sentence of guarantee; in its long form it has the constants,
the limits of the schedule and the assumptions, too; :func:`margin_document` has the margin of a
time-triggered loop, :func:`mean_cost_document` its mean cost under random losses.
"""

from collections.abc import Iterable, Iterator, Sequence

from cosim.analysis.certificates import IDEAL, SCHEDULE, Certificates
from cosim.analysis.constant_rows import PROVEN, constant_rows, covered_plants
from cosim.analysis.margin_search import MarginResult
from cosim.analysis.mean_cost import CostUnder, MeanCost
from cosim.analysis.tried_settings import TriedSettings
from cosim.output.document import Block, Document, Sentence, SentenceRole
from cosim.output.guarantee_sentence import guarantee_sentence
from cosim.output.result_tables import ResultTable, Tone
from cosim.output.run_document import assumption_table
from noack.core.linear_systems import Matrix
from noack.core.number_format import NONE, at_least, at_most, duration, duration_at_least, number
from noack.scenario.resolution import loop_of, policy_of
from noack.theory.certificates.assumptions import AssumptionStatus, assumptions
from noack.theory.certificates.certified_bounds import ScenarioCertificate, envelope_formula
from noack.theory.certificates.conditions import BOX, REGION
from noack.theory.certificates.network_limits import MOST_S
from noack.theory.certificates.scenario_certificates import outside_box
from noack.theory.witnesses.loss_margin import Stability

_MOST_BOUNDS = 6
"""Outputs whose bounds are printed without --verbose."""
_MORE = Sentence(
    role=SentenceRole.NOTE,
    text="--verbose shows every constant, limit and assumption, and the paper's theorems",
)


def certificate_document(
    results: Certificates, chosen: Certificates | None = None, *, verbose: bool = False
) -> Document:
    """Return what is guaranteed: a sentence and few lines, or with ``verbose`` all tables, too.

    Args:
        results: the certificates.
        chosen: those in a norm that noack chose instead.
        verbose: with all constants, limits and assumptions.
    """
    blocks: list[Block] = [_first_sentence(results), *_too_large(results)]
    blocks += _all_tables(results) if verbose else [*_few_lines(results), _MORE]
    if results.weight is not None and results.schedule.exists:
        blocks += _weight_lines(results, results.weight)
    if not (chosen or results).answer.is_certified:
        blocks.append(_advice(results))
    if chosen is not None and chosen.weight is not None:
        blocks += [
            _prose("With another norm, also in the trigger, there are certificates:"),
            *([next(certificate_tables(chosen))._replace(name="")] if verbose else _few_lines(chosen)),
            *_weight_lines(chosen, chosen.weight),
        ]
    data = results.to_json() | {"in_chosen_norm": chosen and chosen.to_json()}
    return Document(title=results.scenario.name, data=data, blocks=blocks)


def _all_tables(results: Certificates) -> Iterator[Block]:
    """Yield the constants, the limits of the schedule, and the assumptions."""
    tables = list(certificate_tables(results))
    yield from _on_nonlinear(results)
    yield tables[0] if tables else _prose(f"{_title(results)}: none")
    yield from _notes(results)
    if any(results.setpoint or ()) or results.follows_reference:
        yield _note(
            "x is the distance from the set-point, x − x_r. If the plant does not rest there, "
            "A x_r + B u_r is a disturbance: a step at the state."
        )
    yield from _about_rest(results)
    yield from tables[1:]
    if largest := _listed("as settings, the certificate is kept", results.largest_settings):
        yield _prose(largest)
    if (outside := outside_box(results.scenario)) is not None:
        yield _doubt("the box certificates do not cover this plant:", outside)
    yield _prose("assumptions of the certificates for the schedule:")
    yield assumption_table((results.schedule_region or results.schedule).assumptions)
    yield _prose("assumptions of the paper's theorems:")
    yield assumption_table(assumptions(results.scenario))
    yield from map(_prose, (*_in_words(results), *_stability_in_words(results)))


def _few_lines(results: Certificates) -> Iterator[Sentence]:
    """Yield the bounds of the outputs and of ‖x‖, what they assume, and what would void them."""
    certificate = results.guaranteed
    if certificate is not None:
        bounds = results.output_bounds(certificate) if results.scenario.outputs else []
        for bound in [bound for bound in bounds if bound.output.allowed is not None][:_MOST_BOUNDS]:
            yield _prose(f"{bound.formula} ({_how_known(is_proven=bound.is_proven)})")
        if results.scenario.outputs:  # else the first sentence has it
            state = envelope_formula("‖x‖", certificate, "state").format(at_most(certificate.first("state")))
            yield _prose(f"{state} ({_how_known(is_proven=certificate.is_proven('state'))})")
        yield from _about_rest(results)
        apart_s = certificate.inter_event_s
        if apart_s is not None and apart_s < MOST_S:
            yield _prose(_apart_in_words(certificate, apart_s))
        assumed = [each.what for each in certificate.assumptions if each.verdict is AssumptionStatus.ASSUMED]
        yield _prose(f"assumed, and checked in each run: {'; '.join(assumed)}")
    if largest := _listed("the guarantee is kept", results.largest_settings):
        yield _prose(largest)
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
        return Sentence(text=text, role=SentenceRole.VERDICT, tone=Tone.GOOD, is_prose=True)
    why = results.answer.text.removeprefix("no certificate").lstrip(": ")
    text = f"no guarantee{f': {why}' if why else ''}"
    return Sentence(text=text, role=SentenceRole.VERDICT, tone=Tone.DOUBTFUL, is_prose=True)


def _too_large(results: Certificates) -> Iterator[Sentence]:
    """Yield for each output whose bound exceeds its allowed error what would have to change."""
    for name, advice in results.threshold_advice.items():
        yield _doubt(f"{name} may exceed its allowed error:", advice)


def _prose(text: str) -> Sentence:
    return Sentence(text=text, is_prose=True)


def _note(text: str) -> Sentence:
    return Sentence(text=text, role=SentenceRole.NOTE)


def _doubt(lead: str, text: str) -> Sentence:
    return Sentence(lead=lead, text=text, tone=Tone.DOUBTFUL, is_prose=True)


def _on_nonlinear(results: Certificates) -> Iterator[Sentence]:
    """Yield for which plant the certificates of a nonlinear one are."""
    if results.nonlinear is None:
        return
    region = results.schedule_region
    if region is None or not region.exists:
        why = "" if region is None else f": {region.void}"
        own = f". The plant itself has no certificate from its x(0){why}"
    else:
        own = ", except under “region”: that is certified for the plant itself"
    yield _doubt(
        "the plant is not linear",
        f"({results.nonlinear}): what follows is "
        f"certified for the linear plant ẋ = Âx + B̂u in its place{own}",
    )


def _advice(results: Certificates) -> Sentence:
    """Return that there is no certificate, and settings with which there is one."""
    advice = _listed("; there is one", results.helpful_settings)
    return _doubt(
        "no certificate for the schedule,",
        f"so no bound of ‖x‖{advice}; noack adversary shows what losses can do to it",
    )


def _listed(what: str, tried: Sequence[TriedSettings]) -> str:
    """Return settings that were tried as one text; empty if there are none."""
    if not tried:
        return ""
    return f"{what} with {', or with '.join(settings.text for settings in tried)}; each was tried alone"


def _weight_lines(chosen: Certificates, weight: Matrix) -> Iterator[Sentence]:
    """Yield what a norm bounds, and its lines for the scenario file."""
    if (bound := chosen.error_in_given_norm) is not None:
        yield _prose(
            "With W below in the trigger, the error in the scenario's own norm is bounded, too "
            f"(schedule, plant): ‖e_c‖ ≤ {at_most(bound)} {chosen.schedule.level}"
        )
    rows = ",\n".join(f"  {[float(f'{v:.6g}') for v in row]}" for row in weight)
    yield Sentence(text=f"for the scenario file, below [trigger]:\nweight = [\n{rows},\n]")


def _in_words(results: Certificates) -> Iterator[str]:
    """Yield sentences with the certified bounds for the scenario's schedule."""
    for level, certificate in results:
        first = certificate.first("state")
        if level != SCHEDULE or first is None:
            continue
        other_plants = "the scenario's plant" if results.nonlinear is None else "the model as the plant"
        plants = {BOX: "every plant of the box", REGION: REGION}.get(certificate.scope, other_plants)
        apart = ""
        spacing_s = certificate.inter_event_s
        if spacing_s is not None and spacing_s < MOST_S:  # else there is no second event
            apart = f" {_apart_in_words(certificate, spacing_s)}"
        meaning = certificate.conditions.guarantee.meaning
        losses = f"for every pattern of losses with {meaning}"
        if not results.scenario.network.enforce_mansd:
            losses = f"as long as there are {meaning}, which nothing enforces"
        yield (
            f"In words: for {plants}, under the assumptions above and {losses}: "
            f"{envelope_formula('‖x‖', certificate, 'state').format(at_most(first))} "
            f"({_how_known(is_proven=certificate.is_proven('state'))}).{apart}"
        )


def _apart_in_words(certificate: ScenarioCertificate, apart_s: float) -> str:
    least, proven, known = (
        _limit(apart_s),
        certificate.proven,
        _how_known(is_proven=certificate.has_proven_inter_event_time),
    )
    exception = proven.exception if proven and certificate.has_proven_inter_event_time else ""
    return f"The inter-event time is at least {least}{f', {exception}' if exception else ''} ({known})."


def _how_known(*, is_proven: bool) -> str:
    return "proved" if is_proven else "computed"


def _stability_in_words(results: Certificates) -> Iterator[str]:
    """Yield what is known exactly about the stability of a time-triggered loop."""
    if (stability := results.stability) is None:
        return
    patterns = f"every loss pattern with {results.scenario.network.guarantee.meaning}"
    growth = f"growth per period {at_least(stability.lower)} to {at_most(stability.upper)}"
    text = {
        "stable": f"Proven stable for {patterns}: {growth}",
        "destabilised": f"Not stable: the pattern {stability.text} (D delivered, L lost), repeated, "
        f"destabilises the loop: {growth}",
        "undecided": f"Not decided whether the loop is stable for {patterns}: {growth} under the worst one",
    }[stability.verdict]
    yield f"{text}. This is without lateness; noack margin finds the limits."


def _title(results: Certificates) -> str:
    trigger = results.scenario.trigger
    norm = "‖W·‖" if trigger.weight is not None else "‖·‖"
    guarantee = results.paper.conditions.guarantee  # its longest burst counts all rules
    return (
        f"{results.scenario.name}: certified bounds, "
        f"{guarantee.meaning}; event: {trigger.description}; norm {norm}"
    )


def certificate_tables(results: Certificates) -> Iterator[ResultTable]:
    """Yield the constants of the certificates that exist, and the largest times of the schedule.

    Plants and conditions without a certificate have neither a column nor a row. Nothing is yielded
    if there is none.
    """
    columns = [(under, certificate) for under, certificate in results if certificate.exists]
    if not columns:
        return
    certificates = [certificate for _, certificate in columns]
    headings = ["", *(f"{under},\n{covered_plants(certificate)}" for under, certificate in columns)]
    printed = results.theorem_2 is not None
    headings += ["paper's\nTheorem 2"] if printed else []
    rows = [
        (label, *values, *([of_theorem] if printed else []))
        for label, values, of_theorem in constant_rows(
            certificates,
            results.theorem_2,
            policy_of(results.scenario).fading_per_s,
            [output.name for output in results.scenario.loop_outputs()],
        )
    ]
    yield ResultTable("certificates", _title(results), headings, rows)
    caption = (
        f"{results.scenario.name}: how far each setting of the {SCHEDULE} can go alone before "
        "the certificate is lost"
    )
    limits = [
        (scope, *map(_limit, limits)) for scope, limits in results.limits_by_scope.items() if any(limits)
    ]
    if limits:
        scheduled = results.scheduled
        times_s = (scheduled.sampling_s, scheduled.delay_s, scheduled.hold_s)
        present = (f"the {SCHEDULE} has", *map(duration, times_s))
        yield ResultTable("limits", caption, LIMIT_HEADINGS, [present, *limits])


def _notes(results: Certificates) -> Iterator[Sentence]:
    """Yield what the rows of the constants mean, and why there are no other certificates."""
    certificates = [certificate for _, certificate in results]
    if any(certificate.exists for certificate in certificates):
        are_proven = any(certificate.proven for certificate in certificates)
        proven = f"{PROVEN} proved: noack-check has verified it. The other numbers are computed, and"
        yield _note(f"{proven if are_proven else 'All numbers are computed, and'} not checked.")
        yield _note(
            "Each bound of a norm is multiplied by e^(−rate·t). paper: no sampling, no delay, "
            "no hold. schedule: the scenario's rates, plus the lateness that it allows. Its inter-event "
            "time can be the larger one: events are at measurements only. plant: the "
            "scenario's plant. box: every plant of the uncertainty box. undelivered updates: "
            "updates not yet delivered (lost or in flight), maximum. all arrived: the bound "
            "while every update has arrived. inter-event time: minimum."
        )
    if any(certificate.persistent_constants for certificate in certificates):
        yield _note(
            "The rows with + are added: they are the bounds from disturbances, noise, and the "
            "threshold's constant or floor. With noise or an observer, e_s and e_c are x_s − x̂ "
            "and x_c − x̂."
        )
    if any(certificate.other for certificate in certificates):
        yield _note(
            "More than one bound holds at all times. The table has the one that tends to the "
            "smallest value; all are in the words below."
        )
    reasons: dict[tuple[str, str], list[str]] = {}
    for under, certificate in results:
        if certificate.void and not certificate.exists:
            reasons.setdefault((certificate.scope, certificate.void), []).append(under)
    for (scope, why), conditions in reasons.items():
        yield _doubt("no certificate", f"({' and '.join(conditions)}, {scope}): {why}")
    yield from _unproven(results)
    if (box := results.helpful_box) is not None:
        yield _prose(f"the box has one{_listed('', [box])}")
    yield from _regions(results)
    policy = results.scenario.trigger.policy
    exists = results.schedule.exists  # else another norm is tried
    if exists and results.weight is None and policy == "decaying" and any(c.void for c in certificates):
        yield _prose("--weight chosen searches for a norm in which more is certified")


def _regions(results: Certificates) -> Iterator[Sentence]:
    """Yield what a nonlinear plant does not leave."""
    loop = loop_of(results.scenario)
    names = (*loop.state_names, *loop.input_names)
    for under, certificate in results:
        if certificate.scope != REGION or not certificate.exists:
            continue
        if certificate.proven is not None:
            entries, mark = certificate.proven.entries(loop.n, loop.m), ", ✓"
            limits = {names[index]: sum(bound) for index, bound in entries.items()}
        else:
            assert certificate.region is not None
            limits, mark = dict(zip(names, certificate.region.x + certificate.region.u, strict=True)), ""
        text = ", ".join(f"|{name}| ≤ {at_most(limit)}" for name, limit in limits.items())
        yield Sentence(lead="region", text=f"({under}{mark}): {text}", tone=Tone.GOOD, is_prose=True)


def _unproven(results: Certificates) -> Iterator[Sentence]:
    """Yield why no bound is proven for some plants under some conditions."""
    names = {"ideal": IDEAL, "schedule": SCHEDULE, "own": "plant", "box": "box", "region": "region"}
    reasons: dict[str, list[str]] = {}
    for plants, conditions, reason in results.unproven:
        reasons.setdefault(reason, []).append(f"{names[conditions]}, {names[plants]}")
    for reason, columns in reasons.items():
        yield _doubt("nothing is proven", f"({'; '.join(columns)}): {reason}")


LIMIT_HEADINGS = ("", "sampling period", "delay of updates", "age of inputs")


def _limit(value_s: float | None) -> str:
    if value_s is None:
        return NONE
    if value_s <= 0:
        return "none"
    return f"≥ {MOST_S:g} s" if value_s >= MOST_S else duration_at_least(value_s)


_MARGIN_TONES = {"stable": Tone.GOOD, "destabilised": Tone.BAD, "undecided": Tone.DOUBTFUL}


def _growth(growth: Stability) -> tuple[str, str]:
    return at_least(growth.lower, decimals=9), at_most(growth.upper, decimals=9)


def margin_document(margin: MarginResult) -> Document:
    """Return the bounds for each M, and the verdicts."""
    proof = [] if margin.proof is None else margin.proof.lines
    texts = [margin.verdict, *proof, *margin.compared.relations]
    if margin.period is not None:
        texts.append(f"for {margin.guarantee}: {margin.period.text}")
    note = "D delivered, L lost, repeated. Below 1: every pattern is stable."
    if not margin.is_periodic:
        note += " In brackets: the time to the next update."
    if margin.certificate is not None and not margin.certificate.is_certified:
        note += " A loop without a certificate may be stable."
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
    """Yield the bounds of the growth for each M, and for guarantees that are compared."""
    delay = f", updates delayed by {margin.delay_s:g} s" if margin.delay_s else ""
    times = f"with an update every {margin.period_s:g} s"
    if not margin.is_periodic:
        times = f"with updates {margin.shortest_s:g} to {margin.period_s:g} s apart"
    yield ResultTable(
        "margin",
        f"{margin.scenario}: growth of the worst loss pattern per {margin.period_s:g} s, "
        f"{times}, {margin.between_updates}{delay}",
        ("M", "M − 1", "at least", "at most", "verdict"),
        [(str(m), str(m - 1), *_growth(growth), growth.verdict) for m, growth in margin.caps],
        left=[4],
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
        "in mean square; z: the loop's state, x, x_c and the inputs in use."
    )
    blocks.append(Sentence(text=note, role=SentenceRole.NOTE))
    return Document(title=cost.scenario, data=cost.to_json(), blocks=blocks)


def mean_cost_tables(costs: MeanCost) -> Iterator[ResultTable]:
    """Yield the moments and costs with and without the guarantee."""
    both = (costs.with_guarantee, costs.without_guarantee)
    known = [cost for cost in dict.fromkeys(both) if isinstance(cost, CostUnder)]
    mode = "model-based" if costs.mode == "model" else "zero-order hold"
    title = f"{costs.scenario}: moments and cost, with an update every {costs.period_s:g} s, {mode}"
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
