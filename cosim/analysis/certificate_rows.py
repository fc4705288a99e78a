"""The bounds of certificates as rows of a table."""

from collections.abc import Iterator, Sequence

from netem.core.number_format import NONE, at_least, at_most
from noack.theory.certificates.certified_bounds import Quantity, ScenarioCertificate
from noack.theory.certificates.conditions import BOX
from noack.theory.certificates.output_bounds import OutputBound

_QUANTITIES: dict[Quantity, str] = {"x": "‖x‖", "e_c": "‖e_c‖", "e_s": "‖e_s‖", "estimate": "‖x̂ − x‖"}
_VOID = "none"
Row = tuple[str, list[str]]
"""Label, and the value of each certificate."""


def covered_plants(certificate: ScenarioCertificate) -> str:
    """Return which plants a certificate covers: "box" or "plant"."""
    return "box" if certificate.scope == BOX else "plant"


def certificate_rows(
    certificates: Sequence[ScenarioCertificate],
    outputs: Sequence[Sequence[OutputBound]],
    state_norm: str = "‖x‖",
) -> Iterator[Row]:
    """Yield the rows. ``outputs``: the bounds of each certificate's outputs, without any none.

    ``state_norm``: the name of what bounds of the state are about.
    """
    if not any(certificate.exists for certificate in certificates):
        yield "certificate", [_VOID] * len(certificates)
        return
    for quantity, label in (_QUANTITIES | {"x": state_norm}).items():
        if any(certificate.has(quantity) for certificate in certificates):
            yield f"{label} ≤", [_bound(certificate, quantity) for certificate in certificates]
    for index in range(max(map(len, outputs), default=0)):
        bounds = [of_each[index] if index < len(of_each) else None for of_each in outputs]
        first = next(bound for bound in bounds if bound is not None)
        unit = f" in {first.output.unit}" if first.output.unit else ""
        values = [NONE if bound is None else _bound(bound.certificate, "x") for bound in bounds]
        yield f"{first.symbol}{unit} ≤", values
        if any(bound is not None and bound.certificate.is_smaller_in_limit for bound in bounds):
            yield "· in the end ≤", [NONE if b is None else at_most(b.ultimate) for b in bounds]
    yield "inter-event time in s ≥", [at_least(certificate.inter_event_s) for certificate in certificates]


def _bound(certificate: ScenarioCertificate, quantity: Quantity) -> str:
    if not certificate.exists:
        return _VOID
    return certificate.formula("", quantity).lstrip(" ≤") if certificate.has(quantity) else NONE
