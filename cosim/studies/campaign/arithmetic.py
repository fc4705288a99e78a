"""Code, libraries and arithmetic of a process: results depend on them bit by bit."""

import json
import platform
from collections.abc import Mapping
from functools import cache
from hashlib import blake2b
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from scipy.linalg import expm

from netem.core.errors import shortened
from noack.core.core_library import OWN

_PACKAGES = ("noack", "numpy", "scipy")
_CODE = ("noack", "netem", "cosim", "plant_server", "sensor_node", "controller_node")
_NO_CODE_OF_RUNS = ("cli", "output", "studies")


@cache
def arithmetic() -> Mapping[str, str]:
    """Return names with values; if all values are equal, the results are equal bit by bit.

    ``rounding`` is a digest of computations on fixed matrices, because libraries select their
    instructions by the processor.
    """
    return {
        **{name: _version(name) for name in _PACKAGES},
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "noack's code": _code(),
        "noack's core": OWN.sources,
        "machine": platform.machine(),
        "rounding": _rounding(),
    }


def difference(stored: object, running: object, key: str = "") -> str | None:
    """Return the first difference as text; None if there is none."""
    if isinstance(stored, dict) and isinstance(running, dict):
        names: list[object] = sorted(stored.keys() | running.keys())
        pairs = [(stored.get(name), running.get(name)) for name in names]
    elif isinstance(stored, list) and isinstance(running, list):
        if len(stored) != len(running):
            return f"{key} has {len(stored)} entries there, {len(running)} here"
        names, pairs = list(range(len(running))), list(zip(stored, running, strict=True))
    else:
        texts = [shortened(_text(value), 60) for value in (stored, running)]
        return None if stored == running else f"{key} is {texts[0]} there, {texts[1]} here"
    keys = (f"{key}.{name}".removeprefix(".") for name in names)
    differences = (difference(*pair, inner_key) for pair, inner_key in zip(pairs, keys, strict=True))
    return next(filter(None, differences), None)


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _code() -> str:
    digest = blake2b(digest_size=8)
    for package in _CODE:
        root = Path(str(find_spec(package).origin)).parent  # type: ignore[union-attr]
        for path in sorted(root.rglob("*.py")):
            name = path.relative_to(root)
            if package != "cosim" or name.parts[0] not in _NO_CODE_OF_RUNS:
                digest.update(path.read_bytes())
    for module in ("random_draws.py", "drawn_runs.py"):
        digest.update(Path(__file__).with_name(module).read_bytes())
    return digest.hexdigest()


def _rounding() -> str:
    # Exact entries, rank 6; the computed rank depends on the processor.
    matrix = (np.arange(1, 50) * 7919 % 101 - 50).reshape(7, 7) / 64
    regular = matrix + 8 * np.eye(7)  # diagonally dominant
    parts = (
        expm(matrix),
        matrix @ matrix,
        np.linalg.solve(regular, matrix[:, :2]),
        np.exp(matrix),
        np.linalg.norm(matrix, axis=1),
    )
    return blake2b(b"".join(part.tobytes() for part in parts), digest_size=8).hexdigest()
