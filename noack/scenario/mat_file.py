"""Arrays of a MATLAB file, read by SciPy in a process of its own: a damaged file can crash its reader."""

import io
import subprocess
import sys
import warnings
import zipfile
from contextlib import suppress

import numpy as np

from netem.core.system_processes import python_command

with suppress(ImportError):  # Windows has no such limits
    import resource

_IS_HDF5 = 3
"""Exit status of the process if the file is of MATLAB's v7.3."""
_MOST_S = 60.0
"""Wall time of the process; it needs less than a second."""
_MOST_BYTES = 8 * 2**30
"""Address space of the process: what is compressed may be far larger than the file."""


def arrays_of_mat(content: bytes, most_entries: int) -> bytes:
    """Return the arrays of numbers in a ``.mat`` file that are not too large, as a ``.npz`` file.

    Raises:
        NotImplementedError: the file is of MATLAB's v7.3.
        ValueError: it is damaged, or is no ``.mat`` file.
    """
    command = python_command("-m", __name__, most_entries)
    try:
        reader = subprocess.run(command, input=content, capture_output=True, timeout=_MOST_S, check=False)
    except subprocess.TimeoutExpired:
        raise ValueError("takes too long to read") from None
    if reader.returncode == _IS_HDF5:
        raise NotImplementedError
    if reader.returncode:
        raise ValueError("damaged")
    return reader.stdout


def _read(content: bytes, most_entries: int) -> bytes:
    from scipy.io import loadmat  # only in this process: it takes time and memory

    with warnings.catch_warnings(action="ignore"):
        variables = loadmat(io.BytesIO(content))  # type: ignore[arg-type] # accepts files, too
    arrays = {}
    for name, value in variables.items():
        if np.prod(getattr(value, "shape", (np.inf,)), dtype=float) <= most_entries:
            array = value.toarray() if hasattr(value, "toarray") else value
            if array.dtype.kind in "fiubc":
                arrays[name] = array
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:  # np.savez refuses some names, such as "file"
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    return file.getvalue()


def _main() -> int:
    if "resource" in globals():
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        _, hard = resource.getrlimit(resource.RLIMIT_AS)
        if hard == resource.RLIM_INFINITY or hard > _MOST_BYTES:
            resource.setrlimit(resource.RLIMIT_AS, (_MOST_BYTES, hard))
    try:
        sys.stdout.buffer.write(_read(sys.stdin.buffer.read(), int(sys.argv[1])))
    except NotImplementedError:
        return _IS_HDF5
    return 0


if __name__ == "__main__":
    sys.exit(_main())
