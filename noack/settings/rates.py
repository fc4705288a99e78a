"""Rates of the loop's clocks: their periods are whole nanoseconds."""

from typing import Annotated

from pydantic import Field, FiniteFloat

from noack.core.clock import NS_PER_S

RateHz = Annotated[FiniteFloat, Field(gt=0, le=100_000)]
_LEAST_RATE_HZ = 1e-9
"""Lowest rate; its period in nanoseconds fits into 64 bits."""


def period_ns(rate_hz: float) -> int:
    """Return the period of a validated rate, a whole number of nanoseconds."""
    return round(NS_PER_S / rate_hz)


def require_whole_period(rate_hz: float, key: str) -> None:
    """Raise ValueError unless the rate's period is a whole number of nanoseconds."""
    if rate_hz < _LEAST_RATE_HZ:
        raise ValueError(f"{key}: must be at least {_LEAST_RATE_HZ:g}")
    whole_ns = period_ns(rate_hz)
    if whole_ns < 1 or abs(NS_PER_S / whole_ns - rate_hz) > 1e-12 * rate_hz:
        raise ValueError(
            f"{key}: the period must be a whole number of nanoseconds; "
            f"the nearest such rate is {NS_PER_S / max(whole_ns, 1)!r}"
        )
