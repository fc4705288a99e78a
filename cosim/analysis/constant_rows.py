"""The constants of certificates as rows of a table: proven bounds, and computed ones where there are none."""

from collections.abc import Iterator, Sequence

from flint import arb

from noack.core.number_format import NONE, at_least, at_most
from noack.theory.certificates.certified_bounds import Constant, ScenarioCertificate
from noack.theory.certificates.conditions import BOX, REGION
from noack.theory.paper import Theorem2
from noack.theory.witnesses.outward import above
from noack_check.sentences import norm

PROVEN = "✓"
"""Behind a number that the checker has proven."""
_CONSTANTS: dict[str, Constant] = {"e_c": "delta", "e_s": "overshoot", "x": "state"}
_PERSISTENT = {
    "e_c": "delta",
    "e_s": "overshoot",
    "u − Kx": "input_error",
    "x": "state",
    "(x̂ − x)": "estimation_error",
}
"""Rows of the bounds that are added under disturbances, noise or an observer."""
_WEIGHTED = ("e_c", "e_s", "(x̂ − x)")
Row = tuple[str, list[str], str]
"""Label, the value of each certificate, the value of Theorem 2."""


def covered_plants(certificate: ScenarioCertificate) -> str:
    """Return which plants a certificate covers: "box", "region" or "plant"."""
    return {BOX: "box", REGION: "region"}.get(certificate.scope, "plant")


def constant_rows(
    certificates: Sequence[ScenarioCertificate],
    theorem: Theorem2 | None,
    theorem_rate: float,
    outputs: Sequence[str],
) -> Iterator[Row]:
    """Yield the rows; numbers that are proven are marked. ``outputs``: the names of the outputs."""
    if not any(c.exists for c in certificates):
        yield "certificate", ["void"] * len(certificates), NONE
        return
    delta_2 = state_2 = spacing_2 = NONE
    if theorem is not None:
        delta_2 = "(same)"
        state_2 = at_most(theorem.state_start + theorem.state_forced)
        spacing_2 = at_least(theorem.inter_event_s)

    def computed(name: str) -> list[str]:
        return [_computed(c, name) for c in certificates]

    def bound(output: str) -> list[str]:
        return [_bound(c, output) for c in certificates]

    unit = next((f"/{certificate.unit}" for certificate in certificates if certificate.unit), "")
    w = "W " if any(certificate.weighted for certificate in certificates) else ""
    yield "decay rate, 1/s", [_rate(c) for c in certificates], at_least(theorem_rate)
    yield "undelivered updates", computed("missing_events"), NONE
    yield f"Δ, bound of ‖{w}e_c‖{unit}", bound("e_c"), delta_2
    yield f"bound of ‖{w}e_s‖{unit}", bound("e_s"), "1"
    yield "bound of ‖u − Kx‖", computed("input_error"), NONE
    yield "· all arrived", computed("received_input_error"), NONE
    yield "X, bound of ‖x‖", bound("x"), state_2
    yield "inter-event time, s", [_apart(c) for c in certificates], spacing_2
    yield "loop gain (< 1)", computed("loop_gain"), NONE
    for quantity, name in _PERSISTENT.items():
        values = [_added(c, quantity, name) for c in certificates]
        if any(value not in (NONE, "void") for value in values):
            text = f"‖{w}{quantity}‖" if w and quantity in _WEIGHTED else f"‖{quantity.strip('()')}‖"
            yield f"+ without decay: {text}", values, NONE
    yield from _limits(certificates, outputs)
    floors = [None if _is_replaced(c) else c.floor_constants for c in certificates]
    if any(floors):
        from_s = [
            at_most(c.floor_from_s) if floor else NONE for c, floor in zip(certificates, floors, strict=True)
        ]
        yield "floor reached at, s", from_s, NONE
        for label, name in ((f"‖{w}e_c‖/ε", "delta"), ("‖x‖", "state")):
            values = [at_most(getattr(floor, name, None)) for floor in floors]
            yield f"bound of {label} from then on", values, NONE


def _is_replaced(certificate: ScenarioCertificate) -> bool:
    """Whether a column has the rate of proven bounds, which is not that of the computed ones."""
    proven, constants = certificate.proven, certificate.constants
    if proven is None:
        return False
    return (
        constants is None
        or proven.rate_per_s > constants.rate_per_s
        or certificate.floor_constants is not None
    )


def _rate(certificate: ScenarioCertificate) -> str:
    if certificate.proven is not None:
        return at_least(certificate.proven.rate_per_s) + PROVEN
    return "void" if certificate.constants is None else at_least(certificate.constants.rate_per_s)


def _computed(certificate: ScenarioCertificate, name: str) -> str:
    """Return a constant that is computed only; it holds with a lower rate, too."""
    if not certificate.exists:
        return "void"
    return NONE if _is_replaced(certificate) else at_most(getattr(certificate.constants, name))


def _bound(certificate: ScenarioCertificate, output: str) -> str:
    """Return the bound of an output that is multiplied by the decay, in units of the threshold."""
    if certificate.proven is None or output not in certificate.proven.bounds:
        return _computed(certificate, _CONSTANTS[output])
    bound, unit = certificate.proven.bounds[output], 1.0
    if output != "x" and certificate.unit:
        unit = certificate.beta if certificate.unit == "β" else certificate.floor
    size = bound.decaying if certificate.proven.rate_per_s else bound.decaying + bound.constant
    return at_most(above(arb(size) / arb(unit))) + PROVEN


def _added(certificate: ScenarioCertificate, output: str, name: str) -> str:
    """Return the bound of an output that is added to that with decay."""
    if not certificate.exists:
        return "void"
    proven = certificate.proven
    if proven is not None and output in proven.bounds:
        constant = proven.bounds[output].constant
        return at_most(constant) + PROVEN if constant and proven.rate_per_s else NONE
    if _is_replaced(certificate):
        return NONE
    return at_most(getattr(certificate.persistent_constants, name, None) or None)


def _apart(certificate: ScenarioCertificate) -> str:
    if not certificate.exists:
        return "void"
    mark = PROVEN if certificate.has_proven_inter_event_time else ""
    return at_least(certificate.inter_event_s) + mark


def _limits(certificates: Sequence[ScenarioCertificate], outputs: Sequence[str]) -> Iterator[Row]:
    """Yield a row for each output that has a bound in the limit t → ∞."""
    limits = [{} if c.proven is None else c.proven.limits for c in certificates]
    for output in dict.fromkeys(name for each in limits for name in each):
        values = [at_most(each[output]) + PROVEN if output in each else NONE for each in limits]
        yield f"bound of {norm(output, outputs)} in the limit", values, NONE
