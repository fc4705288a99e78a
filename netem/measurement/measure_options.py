"""The options of `measure` that are texts with units, read."""

import re
from collections.abc import Mapping
from decimal import Decimal

from netem.core.errors import CallerError
from netem.impairments.words import OWN_TIME_S
from netem.measurement.trace_sources import probe_period_ns

_RATE = re.compile(r"([0-9]+(?:\.[0-9]+)?)(k?)(?:hz)?", re.IGNORECASE)


def refuse(given: Mapping[str, object], reason: str) -> None:
    """Refuse the first option that has a value."""
    for option, value in given.items():
        if value is not None:
            raise CallerError(f"{option}: {reason}")


def period_ns(rate: str) -> int:
    """Return the period of a rate such as ``50hz`` or ``2khz``."""
    match = _RATE.fullmatch(rate)
    per_s = Decimal(match[1]) * (1000 if match[2] else 1) if match else Decimal(0)
    if not per_s:
        raise CallerError(f"--rate {rate}: expected a rate from 0.001hz to 20khz, e.g. 50hz")
    return probe_period_ns(float(1 / per_s))


def time_s(option: str, text: str | None) -> float | None:
    """Return a time such as ``60s``."""
    if text is None:
        return None
    try:
        return OWN_TIME_S.read(text)
    except ValueError:
        raise CallerError(f"{option} {text}: expected {OWN_TIME_S.expected}") from None


def share(text: str) -> float:
    """Return a share such as ``0.99`` or ``99%``."""
    percent = text.endswith("%")
    try:
        return float(text.removesuffix("%")) / (100 if percent else 1)
    except ValueError:
        raise CallerError(f"--share {text}: expected a share, e.g. 0.99 or 99%") from None
