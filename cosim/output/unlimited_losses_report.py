"""What is certified without a limit on the losses, as tables and sentences."""

from collections.abc import Iterator

from rich.console import Console
from rich.table import Table

from noack.core.number_format import number
from noack.theory.random_losses.moments import UnlimitedLosses

_RARE = 1e-4
"""Rows are shown from this probability on, up to the first one that is exceeded less often."""
_MOMENT = {1: "mean", 2: "root mean square"}


def print_unlimited(
    console: Console, found: UnlimitedLosses | None, unpredictable: str | None
) -> None:
    """Print what holds although the network does not limit the losses."""
    if unpredictable is not None:
        console.print(f"[yellow]no statement without the guarantee:[/] {unpredictable}")
    if found is None:
        return
    likely = [one for one in found.bursts if one.probability < 1 - _RARE]
    if (
        shown := [one for one in likely if one.probability > _RARE]
        + [one for one in found.bursts if one not in likely][:1]
    ):
        table = Table(
            title="without the guarantee: a run's longest burst of losses, and the bounds that "
            f"hold as long as none is longer; runs of {found.horizon_s:g} s"
        )
        for heading in ("longest burst", "P(longer burst)", "events", "Δ", "X"):
            table.add_column(heading, justify="right")
        for one in shown:
            table.add_row(
                f"{one.most}", f"≤ {number(1 - one.probability, 3)}", f"≤ {one.events}",
                number(one.delta, 4), number(one.state, 4),
            )  # fmt: skip
        console.print(table)
    for sentence in sentences(found):
        console.print(sentence, markup=False, highlight=False)


def sentences(found: UnlimitedLosses) -> Iterator[str]:
    """Yield what is certified about moments, and almost surely."""
    p = f"{found.largest_probability:.4g}"
    losses = f"independent losses with probability {p}"
    if not found.is_independent:
        losses = f"losses with probability at most {p} given any past"
    for one in found.moments:
        decay = f" e^(−{one.rate_per_s:.3g}t)" if one.rate_per_s else ""
        yield (
            f"Without the guarantee, {losses}: at every time t, the {_MOMENT[one.order]} of ‖x‖ is "
            f"at most {one.state:.4g}{decay}, that of ‖e_c‖ at most "
            f"{one.controller_error:.4g}{decay}."
        )
    if found.void is not None:
        order = _MOMENT[len(found.moments) + 1]
        yield f"Without the guarantee no {order} is certified: {found.void}."
    if found.sure_rate_per_s is not None:
        yield f"x decays almost surely, at every rate below {found.sure_rate_per_s:.3g} /s."
    if found.paper_rate_per_s is not None:
        at = ", ".join(
            f"{_MOMENT[order]} at most {value:.4g}"
            for order, value in enumerate(found.at_events, start=1)
        )
        yield (
            f"Under the paper's conditions ‖e_c‖ e^(αt)/β at events has a {at}, and x decays "
            f"almost surely, at every rate below {found.paper_rate_per_s:.3g} /s."
        )
    if found.moments or found.bursts:
        yield (
            "These are statements about many runs: one run cannot violate a mean. The "
            "probabilities are bounds; a campaign shows the frequencies."
        )
