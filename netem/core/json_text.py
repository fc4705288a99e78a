"""JSON of others: one error for whatever is wrong, and only numbers that every program can hold."""

import json
import math


def parse_json(text: bytes | str) -> object:
    """Return the content of a JSON text (RFC 8259).

    Raises:
        ValueError: it is no JSON, is nested too deeply, or has a number that is not finite, or an
            integer that does not fit into 64 bits.
    """
    try:
        return json.loads(text, parse_constant=_refuse, parse_float=_finite, parse_int=_integer)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _refuse(text: str) -> float:
    raise ValueError(f"{text} is not a number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large")
    return value


def _integer(text: str) -> int:
    value = int(text)
    if not -(2**63) <= value < 2**63:
        raise ValueError(f"{text} is too large")
    return value
