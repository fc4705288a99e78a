"""One sentence of guarantee, in words and numbers of the outputs: the first line of every result."""

from collections.abc import Sequence

from cosim.analysis.certificates import Certificates, state_norm
from netem.core.number_format import counted
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import BOX

_MOST_OUTPUTS = 4
"""Outputs without an allowed error that the sentence names."""


def guarantee_sentence(results: Certificates) -> str | None:
    """Return what is guaranteed for a scenario, in one sentence; None without a certificate."""
    certificate = results.guaranteed
    if certificate is None:
        return None
    statements = _statements(results, certificate)
    plants = ", for every plant within the stated uncertainty" if certificate.scope == BOX else ""
    losses = although_lost(results.scenario)
    return f"{' and '.join(statements)}{_until(results)}{losses}{plants} (proved)"


def is_within_allowed(results: Certificates) -> bool:
    """Return whether bounds are proven, and those of all stated outputs are within their allowed errors."""
    certificate = results.guaranteed
    return certificate is not None and all(bound.is_met for bound in results.output_bounds(certificate))


def _until(results: Certificates) -> str:
    """Return up to when a guarantee about a reference holds; empty: for ever."""
    if results.jump_s is not None:
        return f", until the reference jumps at {results.jump_s:g} s"
    reference = loop_of(results.scenario).reference
    if reference is None or reference.is_constant:
        return ""
    return f", up to {results.scenario.horizon_s:g} s"


def _statements(results: Certificates, certificate: ScenarioCertificate) -> Sequence[str]:
    """Return what is said of stated outputs: of those with an allowed error, or of few; else of ‖x‖."""
    bounds, stated = results.output_bounds(certificate), results.scenario.outputs is not None
    asked = [bound for bound in bounds if bound.output.allowed is not None]
    if stated and (asked or len(bounds) <= _MOST_OUTPUTS):
        return [bound.statement for bound in asked or bounds]
    return [certificate.formula(state_norm(results), "x")]


def although_lost(scenario: Scenario) -> str:
    """Return which losses do not break a guarantee, as the end of a sentence."""
    network = scenario.network
    if network.constraints:
        return f", for every pattern of losses with {network.guarantee.meaning}"
    most = network.mansd
    packets = f"{counted(most, 'consecutive packet')} {'is' if most == 1 else 'are'} lost"
    if not most:
        return ", if no packet is lost"
    if not network.enforce_mansd:
        return f", as long as at most {packets}, which nothing enforces"
    return f", although up to {packets}"
