"""Matrix files that scenarios name; ``.mat`` has another reader, so ``.npz`` stands in."""

import io

import numpy as np

from noack.scenario.matrix_files import read_matrices
from noack.settings.user_files import NamedFile
from tests.fuzz.harness import refusal, workspace


def _saved(**arrays: object) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **{key: np.array(one) for key, one in arrays.items()})
    return file.getvalue()


SEEDS = [
    _saved(A=[[0.0, 1.0], [2.0, 3.0]], B=[[0.0], [1.0]], gain=[[1.0, 2.0]]),
    _saved(A=[[1]], B=[[1]], K=[[1]], C=[[1]], D=[[0]], dt=0.0),
    _saved(A=[[1.0]], B="text"),
    b"PK\x05\x06" + bytes(18),
]
WORDS = [
    b"'descr': '<f8'",
    b"(99999, 99999)",
    b"'|O'",
    b"PK\x01\x02",
    b"\x93NUMPY\x02\x00",
    b".npy",
]


def one_input(data: bytes) -> None:
    (workspace() / "any.npz").write_bytes(data)
    with refusal('run.toml: model.file = "any.npz"'):
        found = read_matrices(NamedFile("any.npz", workspace(), "run.toml: model"))
        assert found.keys() <= {"A", "B", "gain"}
        assert all(one.ndim == 2 and np.isfinite(one).all() for one in found.values())
