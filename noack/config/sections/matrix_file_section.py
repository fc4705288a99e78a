"""A check for sections that may name a file of matrices."""

from collections.abc import Mapping
from typing import Any


def require_read(file: str | None, names: Mapping[Any, str] | None) -> None:
    """Raise ValueError if a section still names a file: loading a scenario replaces the name."""
    if file is not None:
        raise ValueError("file: it is read where a scenario file is loaded; give matrices here")
    if names is not None:
        raise ValueError("names: they are of arrays in a file; give file, too")
