"""The file of a recording: its samples, names and panels, and disks that refuse it."""

from pathlib import Path

import numpy as np
import pytest
import rerun.chunk

from cosim.output.viewer.loop_recording import APPLICATION_ID
from cosim.output.viewer.pictures.picture import Frames
from tests.cosim.output.viewer.recordings import (
    K,
    add_samples,
    another_process,
    new_view,
    of_views,
    read,
    series,
    times,
)
from tests.helpers.approved import compare_output

STATES = ["V", "r", "psi", "Y_g"]


@pytest.mark.parametrize("horizon_s", [20.0, 200.0])
def test_the_file_contains_every_sample_exactly(tmp_path: Path, horizon_s: float) -> None:
    """Short recordings have an index, long ones none."""
    path = tmp_path / "recording.rrd"
    with new_view(path, horizon_s=horizon_s) as view:
        add_samples(view, 5)
        view.views[0].add_inputs(times(0), np.stack((np.arange(K), -np.arange(K)), axis=1))
        x = np.zeros((3, 4))
        for _ in range(2):  # the picture has a maximum frame rate
            view.views[0].add_frames(times(0, 3), Frames(np.zeros(3), x, x, x))
    chunks = read(path)
    assert sum(c.num_rows for c in chunks["picture/plant"] if not c.is_static) == 1
    for i, name in enumerate(STATES):
        t_ns, values = series(chunks, f"state/{name}")
        np.testing.assert_array_equal(t_ns, times(0, 5 * K))
        x = t_ns * 1e-9 + i
        np.testing.assert_array_equal(values, np.stack((x, x + 100, x + 200), axis=1))
    t_ns, values = series(chunks, "error/norm")
    np.testing.assert_array_equal(values, (t_ns * 1e-9)[:, None] + [3, 0, 1, 2])
    t_ns, values = series(chunks, "error/log10")
    certified = 10 ** values[:, 4]
    np.testing.assert_allclose(certified, t_ns * 1e-9 + 4, rtol=1e-12)
    t_ns, values = series(chunks, "size/log10")
    bounds = (t_ns * 1e-9)[:, None] + [5, 6]
    np.testing.assert_allclose(10 ** values[:, :2], bounds, rtol=1e-12)
    t_ns, values = series(chunks, "input")
    np.testing.assert_array_equal(values, np.stack((np.arange(K), -np.arange(K)), axis=1))


def test_the_recording_shows_what_was_approved(tmp_path: Path) -> None:
    """Names, colours and texts of what is drawn, and the panels of the layout."""
    path = tmp_path / "recording.rrd"
    new_view(path).close()
    reader = rerun.chunk.RrdReader(path)
    (recording,), (layout,) = reader.recordings(), reader.blueprints()
    assert recording.application_id == layout.application_id == APPLICATION_ID
    shown_rows = [
        f"{entity} {name}: {value}"
        for entity, chunks in sorted(read(path).items())
        for batch in (chunk.to_record_batch() for chunk in chunks if chunk.is_static)
        for name in sorted(batch.schema.names)
        if name.endswith((":names", ":labels", ":colors", ":text"))
        for value in batch.column(name).to_pylist()
    ]
    shown_rows += sorted(of_views(read(path, "blueprint"), "ViewBlueprint:display_name"))
    compare_output("recording.txt", "\n".join(shown_rows))


def test_a_disk_that_fills_during_the_run_is_reported_by_the_closing(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    code = (
        "import resource; from tests.cosim.output.viewer import recordings as t; view = t.new_view(path);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000));"
        "t.add_samples(view, 50); view.close()"
    )
    with another_process(code, path) as child:
        _, errors = child.communicate()
        assert child.returncode == 1
    last = errors.splitlines()[-1]
    assert "ViewError" in last
    assert str(path) in last
    assert "the recording is incomplete" in last
