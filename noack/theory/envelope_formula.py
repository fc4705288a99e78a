"""A certificate's bound of a quantity as text."""

from typing import Literal

from noack.theory.certified_bounds import ScenarioCertificate


def envelope_formula(
    quantity: str,
    certificate: ScenarioCertificate,
    constant: Literal["delta", "overshoot", "state", "estimation_error"],
) -> str:
    """Return a certificate's bound of a quantity; ``{:.4g}`` stands for its first constant."""
    in_levels = constant in {"delta", "overshoot"}
    parts: list[str] = []
    one: ScenarioCertificate | None = certificate
    while one is not None and one.constants is not None:
        rate = one.constants.rate_per_s
        decay = f"e^(−{rate:.3g}t)" if rate else ""
        formula = f"{getattr(one.constants, constant):.4g}" if parts else "{:.4g}"
        formula += f" {level}" if (level := one.level if in_levels else decay) else ""
        if (late := one.floor_constants) is not None:
            unit = " ε" if in_levels else ""
            formula += f", from {one.floor_from_s:.4g} s on ≤ {getattr(late, constant):.4g}{unit}"
        if (rest := one.persistent_constants) is not None:
            formula += f" + {getattr(rest, constant):.4g}"
        parts.append(formula)
        one = one.other
    return f"{quantity} ≤ {' and ≤ '.join(parts)}"
