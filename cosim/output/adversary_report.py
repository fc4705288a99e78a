"""The worst losses that the adversary found, beside the certified bounds."""

from collections.abc import Iterator, Mapping, Sequence

from cosim.analysis.adversary import Objective, WorstRun
from cosim.analysis.adversary.worst_disturbances import disturbance_bounds
from netem.core.clock import NS_PER_S
from netem.core.number_format import NONE, at_least, at_most, counted, duration, number
from netem.output.document import Block, Document, Sentence, SentenceRole
from netem.output.result_tables import ResultTable, Tone
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import network_delay_ns

_EXCEEDED = "exceeded"
_HEADINGS = ("", "no loss", "scenario's seed", "worst", "certified", "share used")


def adversary_document(
    results: Sequence[WorstRun],
    resolved: Scenario,
    certificate: ScenarioCertificate,
    shares: Mapping[str, float],
) -> Document:
    """Return the results and their loss patterns.

    Args:
        results: the worst run of each objective.
        resolved: the scenario.
        certificate: its bounds.
        shares: shares of their bounds that outputs reached, by the outputs' names.
    """
    data = {
        "scenario": resolved.name,
        "mode": resolved.mode,
        "policy": resolved.trigger.policy,
        "trigger": "sampled",
        "mansd": resolved.network.mansd,
        "guarantee": resolved.network.guarantee.meaning,
        "horizon_s": resolved.horizon_s,
        "certificate": certificate.to_json(),
        "worst": {worst.objective.value: worst.to_json() for worst in results},
        "outputs": {name: {"tightness": share} for name, share in shares.items()},
    }
    blocks: list[Block] = [
        _table(results, resolved, certificate),
        *(_prose(f"{name}: {_share_used(share)} of its bound was reached") for name, share in shares.items()),
        *(line for worst in results for line in _pattern(worst)),
        *_notes(results, resolved, certificate),
    ]
    return Document(title=resolved.name, data=data, blocks=blocks)


def _table(results: Sequence[WorstRun], resolved: Scenario, certificate: ScenarioCertificate) -> ResultTable:
    rows = []
    for worst in results:
        is_lower = worst.objective is Objective.INTER_EVENT
        certified = at_least(worst.certified) if is_lower else at_most(worst.certified)
        rows.append(
            (
                _quantity(worst.objective, certificate, weighted=resolved.trigger.weight is not None),
                *(number(value, 4) for value in (worst.lossless, worst.with_own_network, worst.value)),
                certified,
                _EXCEEDED if worst.breaches else _share_used(worst.tightness),
            )
        )
    guarantee = resolved.network.guarantee.meaning
    caption = f"{resolved.name}: worst losses found, {guarantee}, {resolved.horizon_s:g} s"
    return ResultTable("", caption, _HEADINGS, rows, tones={_EXCEEDED: Tone.BAD})


def _pattern(worst: WorstRun) -> Iterator[Block]:
    """Yield how the worst run was found, and its losses."""
    time_text = "" if worst.at_s is None else f"worst at {worst.at_s:.6f} s; "
    coverage = "all patterns searched" if worst.exact else "not all patterns searched"
    found = f"{time_text}{coverage} ({counted(worst.runs, 'run')})"
    outcome = "the loop diverges" if worst.diverges else found
    yield _prose(f"{worst.objective.value}: {outcome}")
    yield Sentence(text=f"  {worst.text}")


def _notes(
    results: Sequence[WorstRun], resolved: Scenario, certificate: ScenarioCertificate
) -> Iterator[Block]:
    """Yield what the values assume besides the losses, and what they mean."""
    if not resolved.network.enforce_mansd:
        text = "Nothing enforces this limit of the losses: the network may lose more"
        yield Sentence(text=text, tone=Tone.DOUBTFUL, is_prose=True)
    if not resolved.coverage.is_undisturbed:
        yield _note("Disturbances and noise are drawn from the seeds")
        if disturbance_bounds(resolved) is not None:
            yield _note("The worst error and state are for the worst signs of bounded ones that were found")
    if delay_ns := network_delay_ns(resolved, 0):
        longest = duration(delay_ns / NS_PER_S)
        yield _note(f"Every delivered update takes the longest delay that is certified, {longest}")
    if any(worst.tightness is not None for worst in results):
        yield _note("share used: of the certified bound, by the worst losses")
    if _is_shaped(certificate):
        yield _note("scaled: multiplied by bound(0) / bound(t)")
    if certificate.void is not None and not certificate.exists:
        yield _note(f"nothing is certified: {certificate.void}")
    else:
        yield _note("certified: proved for the scenario's schedule")
    yield _note("One letter per event: D delivered, L lost. --json prints their times")


def _prose(text: str) -> Sentence:
    return Sentence(text=text, is_prose=True)


def _note(text: str) -> Sentence:
    return Sentence(text=text, role=SentenceRole.NOTE)


def _share_used(share: float | None) -> str:
    return NONE if share is None else f"{100 * share:.4g} %"


def _quantity(objective: Objective, certificate: ScenarioCertificate, *, weighted: bool) -> str:
    rate = 0.0 if certificate.proven is None else certificate.proven.rate_per_s
    growth = f" e^({rate:.3g}t)" if rate else ""
    if _is_shaped(certificate):
        growth = ", scaled"
    error = "‖W e_c‖" if weighted else "‖e_c‖"
    return {
        Objective.ERROR: f"{error}{growth}",
        Objective.STATE: f"‖x‖{growth}",
        Objective.COST: "∫ ‖x‖² dt",
        Objective.INTER_EVENT: "inter-event time, s",
    }[objective]


def _is_shaped(certificate: ScenarioCertificate) -> bool:
    """Return whether the bounds are not c e^{−rt}."""
    return certificate.proven is not None and any(
        bound.decaying and bound.constant for bound in certificate.proven.bounds.values()
    )
