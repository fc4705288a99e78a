"""Matrices from a ``.mat`` file, read by SciPy in a separate process.

SciPy's reader is compiled code. A damaged file may crash it, and then only the separate process
ends.
"""

import io
import subprocess
import sys
import warnings

import numpy as np

from noack.core.system_processes import python_command

_NUMERIC_CLASSES = {
    "double", "single", "sparse", "logical",
    "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
}  # fmt: skip
"""MATLAB's classes of arrays of numbers."""
_STATUS_OF_V7_3 = 3
"""Exit status of the separate process for a file of v7.3."""
_PATIENCE_S = 60.0
"""Longest time for reading a file."""


def matrices_as_npz(content: bytes, most_entries: int) -> bytes:
    """Return the matrices of a ``.mat`` file as the content of a ``.npz`` file.

    Arrays with more than ``most_entries``, and arrays that are not numeric, are left out. Raise
    NotImplementedError for MATLAB's format v7.3, and ValueError for an unreadable file.
    """
    command = python_command("-m", __name__, most_entries)
    try:
        reader = subprocess.run(command, input=content, capture_output=True, timeout=_PATIENCE_S, check=False)
    except subprocess.TimeoutExpired:
        raise ValueError("it cannot be read in time") from None
    if reader.returncode == _STATUS_OF_V7_3:
        raise NotImplementedError
    if reader.returncode != 0:
        raise ValueError("it cannot be read")
    return reader.stdout


def _main() -> int:
    from scipy.io import loadmat, whosmat  # not imported by the parent process

    file, most_entries = io.BytesIO(sys.stdin.buffer.read()), int(sys.argv[1])
    warnings.simplefilter("ignore")
    try:
        names = [
            name
            for name, shape, kind in whosmat(file)  # type: ignore[arg-type] # accepts files, too
            if np.prod(shape, dtype=float) <= most_entries and kind in _NUMERIC_CLASSES
        ]
        file.seek(0)
        variables = loadmat(file, variable_names=names)  # type: ignore[arg-type]
    except NotImplementedError:
        return _STATUS_OF_V7_3
    arrays = {
        name: variables[name].toarray() if hasattr(variables[name], "toarray") else variables[name]
        for name in names
    }
    np.savez(sys.stdout.buffer, allow_pickle=False, **arrays)
    return 0


if __name__ == "__main__":
    sys.exit(_main())
