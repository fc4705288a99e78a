"""A result as JSON on standard output."""

import math
from json import dumps


def print_json(document: object) -> None:
    """Print the document of ``--json``; a number that is not finite becomes null."""
    print(dumps(_finite(document), indent=2, allow_nan=False))


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
