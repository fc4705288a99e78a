"""The most important facts about a run, in a few lines."""

from collections import Counter
from typing import TYPE_CHECKING

from cosim.output.network_table import network_rows

if TYPE_CHECKING:
    from cosim.analysis.summary_model import RunSummary
    from cosim.api.runs import Run

_OF_NETWORK = 3


def run_facts(run: "Run") -> list[tuple[str, str]]:
    """Return what a run was, how it ended, and its results, as names and values."""
    found = run.summary
    ended = f"at {found.reached_s:g} s of {found.horizon_s:g} s: {run.reason}"
    verdicts = Counter(str(claim.verdict) for loop in found.loops for claim in loop.claims)
    is_one = len(found.loops) == 1
    return [
        ("run", f"{found.scenario}, {_mode(found)}, {found.kind}, M − 1 = {found.mansd}"),
        ("ended", ended),
        *(_of_loop(found) if is_one else network_rows(found)[:_OF_NETWORK]),
        ("claims", ", ".join(f"{n} {verdict}" for verdict, n in verdicts.items()) or "none"),
        ("directory", str(run.directory)),
    ]


def _mode(found: "RunSummary") -> str:
    if len(found.loops) > 1:
        return f"{len(found.loops)} loops"
    return "model-based" if found.loops[0].mode == "model" else "zero-order hold"


def _of_loop(found: "RunSummary") -> list[tuple[str, str]]:
    (loop,) = found.loops
    events = (
        f"{loop.events}; {loop.deliveries} received, {loop.drops} lost, "
        f"longest loss burst {loop.longest_loss_burst}"
    )
    norms = (loop.initial_state_norm, loop.final_state_norm)
    return [
        ("events", events),
        ("‖x‖", " → ".join("unknown" if norm is None else f"{norm:.3g}" for norm in norms)),
    ]
