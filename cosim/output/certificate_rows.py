"""The constants of certificates as rows of a table."""

from collections.abc import Callable, Iterator, Sequence

from noack.core.number_format import NONE, number
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import BOX
from noack.theory.paper.theorems import Theorem2

_PERSISTENT = {
    "‖e_c‖": "delta", "‖e_s‖": "overshoot", "‖u − Kx‖": "input_error", "‖x‖": "state",
    "‖x̂ − x‖": "estimation_error",
}  # fmt: skip
"""Rows of the bounds that are added under disturbances, noise or an observer."""


def plants_of(certificate: ScenarioCertificate) -> str:
    """Return which plants a certificate covers: "box" or "plant"."""
    return "box" if certificate.scope == BOX else "plant"


def constant_rows(
    certificates: Sequence[ScenarioCertificate], theorem: Theorem2 | None, theorem_rate: float
) -> Iterator[tuple[str, list[str], str]]:
    """Yield rows: label, the value of each certificate, the value of Theorem 2."""

    def row(value: Callable[[ScenarioCertificate], float | None]) -> list[str]:
        return [number(value(c), 4) if c.constants else "void" for c in certificates]

    def constant(name: str) -> list[str]:
        return row(lambda c: getattr(c.constants, name))

    def after(name: str, which: str) -> list[str]:
        return row(lambda c: getattr(getattr(c, which), name, None))

    delta_2 = state_2 = spacing_2 = NONE
    if theorem is not None:
        delta_2 = "(same)"
        state_2 = number(theorem.state_start + theorem.state_forced, 4)
        spacing_2 = number(theorem.inter_event_s, 4)
    if not any(c.constants for c in certificates):
        yield "certificate", ["void"] * len(certificates), NONE
        return
    yield "decay rate, 1/s", constant("rate_per_s"), number(theorem_rate, 4)
    yield "updates outstanding", constant("missing_events"), NONE
    unit = next((f"/{one.unit}" for one in certificates if one.unit), "")
    yield f"Δ, bound of ‖e_c‖{unit}", constant("delta"), delta_2
    yield f"bound of ‖e_s‖{unit}", constant("overshoot"), "1"
    yield "bound of ‖u − Kx‖", constant("input_error"), NONE
    yield "· no update missing", constant("received_input_error"), NONE
    yield "X, bound of ‖x‖", constant("state"), state_2
    yield "inter-event time, s", row(lambda c: c.inter_event_s), spacing_2
    yield "loop gain (< 1)", constant("loop_gain"), NONE
    if any(c.persistent_constants for c in certificates):
        for label, name in _PERSISTENT.items():
            if any(getattr(c.persistent_constants, name, None) for c in certificates):
                yield f"+ without decay: {label}", after(name, "persistent_constants"), NONE
    if any(c.floor_constants for c in certificates):
        yield "floor reached at, s", row(lambda c: c.floor_from_s), NONE
        yield "bound of ‖e_c‖/ε from then on", after("delta", "floor_constants"), NONE
        yield "bound of ‖x‖ from then on", after("state", "floor_constants"), NONE
