"""The results of ``noack adversary``, as a table and as JSON."""

from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.tightness import Worst
from noack.config.scenario import Scenario
from noack.core.number_format import number
from noack.theory.scenario_certificates import ScenarioCertificate


def document(
    found: Sequence[Worst], resolved: Scenario, certificate: ScenarioCertificate
) -> dict[str, Any]:
    """Return the results as JSON."""
    return {
        "scenario": resolved.name,
        "mode": resolved.mode,
        "mansd": resolved.network.mansd,
        "horizon_s": resolved.horizon_s,
        "certificate": certificate.to_json(),
        "worst": {worst.objective.value: worst.to_json() for worst in found},
    }


def print_worst(
    console: Console, found: Sequence[Worst], resolved: Scenario, certificate: ScenarioCertificate
) -> None:
    """Print the results and their loss patterns."""
    table = Table(
        title=f"{resolved.name}: worst losses found, at most M − 1 = {resolved.network.mansd} "
        f"consecutive, {resolved.horizon_s:g} s"
    )
    for heading in ("", "no loss", "own seed", "worst", "certified", "worst / certified"):
        table.add_column(heading, justify="right" if heading else "left")
    for worst in found:
        values = (worst.lossless, worst.own, worst.value, worst.certified)
        table.add_row(
            _quantity(worst.objective, certificate),
            *(number(value, 4) for value in values),
            "[bold red]exceeded[/]" if worst.breaches else number(worst.tightness, 4),
        )
    console.print(table)
    for worst in found:
        at = "" if worst.at_s is None else f"at {worst.at_s:.6f} s; "
        how = "all patterns searched" if worst.exact else "not all patterns searched"
        speed = f"{worst.nodes:,} segments, {worst.nodes / worst.elapsed_s:,.0f}/s"
        console.print(f"{worst.objective.value}: {at}{how} ({speed})")
        console.print(f"  {worst.text}", soft_wrap=True, highlight=False)
    console.print("[dim]D delivered, · lost; --json prints the times of the events[/]")


def _quantity(objective: Objective, certificate: ScenarioCertificate) -> str:
    rate = certificate.alpha_per_s
    if certificate.constants is not None:
        rate = certificate.constants.rate_per_s
    symbol = "α" if rate == certificate.alpha_per_s else f"{rate:.3g}"
    growth = f" e^({symbol}t)" if rate else ""
    return {
        Objective.ERROR: f"Δ: ‖e_c‖{growth} / β",
        Objective.STATE: f"X: ‖x‖{growth}",
        Objective.COST: "∫ ‖x‖² dt",
        Objective.INTER_EVENT: "inter-event time, s",
    }[objective]
