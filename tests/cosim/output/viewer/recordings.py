"""Recordings with known samples, what is in their files, and programs that write them."""

import contextlib
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rerun.chunk
from numpy.typing import NDArray
from rerun.error_utils import RerunWarning

from cosim.output.viewer.pictures.picture import TIMELINE
from cosim.output.viewer.recording_viewer import LiveView
from cosim.output.viewer.run_recording import RunRecording
from cosim.record.align import AlignedRun
from tests.helpers.shipped import resolved

Floats = NDArray[np.float64]
Chunks = dict[str, list[Any]]

STEP_NS = 2_000_000
K = 100


def new_view(path: Path, live: LiveView | None = None, horizon_s: float = 20.0) -> RunRecording:
    scenario = resolved("lane_following", f"horizon_s={horizon_s}")
    return RunRecording(scenario, path, 1, {0: scenario}, live=live)


def times(first: int, k: int = K) -> NDArray[np.int64]:
    return (first + np.arange(k)) * STEP_NS


def add_samples(view: RunRecording, batches: int, n: int = 4) -> None:
    """Samples with values that encode their series, coordinate and step."""
    for batch in range(batches):
        t_ns = times(batch * K)
        norm = t_ns.astype(np.float64) * 1e-9
        x: Floats = norm[:, None] + np.arange(n)
        bounds, none = np.stack([norm + 3, norm + 4], axis=1), np.full(K, -1)
        states, norms = (x, x + 100, x + 200), (norm, norm + 1, norm + 2)
        aligned = AlignedRun(t_ns, *states, norm, *norms, received=none)
        view.views[0].add_samples(aligned, bounds, bounds + 2)


def read(path: Path, kind: str = "recording") -> Chunks:
    """Chunks of the file by entity."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RerunWarning)  # a file without footer is read in full
        reader = rerun.chunk.RrdReader(path)
    (store,) = reader.recordings() if kind == "recording" else reader.blueprints()
    chunks: Chunks = {}
    for chunk in reader.stream(store=store):
        chunks.setdefault(chunk.entity_path.removeprefix("/"), []).append(chunk)
    return chunks


def column(chunks: list[Any], name: str) -> list[Any]:
    return [value for c in chunks for value in c.to_record_batch().column(name).to_pylist()]


def of_views(layout: Chunks, name: str) -> list[str]:
    """A property of every view of a layout that has it."""
    return [
        value
        for entity, chunks in layout.items() if entity.startswith("view/")
        for c in chunks if name in c.to_record_batch().schema.names
        for (value,) in column([c], name)
    ]  # fmt: skip


def series(chunks: Chunks, entity: str) -> tuple[NDArray[np.int64], Floats]:
    """Times in ns (k,) and scalars (k, series) of one entity, in the order of the file."""
    moving = [c for c in chunks[entity] if not c.is_static]
    assert all(c.timeline_names == [TIMELINE] for c in moving)
    batches = [c.to_record_batch() for c in moving]
    t_ns = np.concatenate([b.column("t").to_numpy(zero_copy_only=False) for b in batches])
    return t_ns.astype(np.int64), np.array(column(moving, "Scalars:scalars"), dtype=np.float64)


@contextlib.contextmanager
def another_process(code: str, path: Path) -> Iterator[subprocess.Popen[str]]:
    """Run code with a path as ``path``, and kill it at the end."""
    with subprocess.Popen(
        [sys.executable, "-c", "import pathlib, sys; path = pathlib.Path(sys.argv[1]);" + code, str(path)],
        cwd=Path(__file__).parents[4],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={name: value for name, value in os.environ.items() if "DISPLAY" not in name},
        text=True,
        start_new_session=True,
    ) as child:
        try:
            yield child
        finally:
            child.kill()
