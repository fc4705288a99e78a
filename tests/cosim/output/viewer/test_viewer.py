import contextlib
import http.client
import os
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import numpy as np
import psutil
import pytest
import rerun.chunk
from numpy.typing import NDArray
from rerun.error_utils import RerunWarning

from cosim.output.viewer.blueprint import ShownLoop, over_time
from cosim.output.viewer.live_viewer import (
    RECORDING,
    LiveView,
    RecordingServer,
    has_display,
    view_recording,
)
from cosim.output.viewer.pictures.picture import TIMELINE, Frames
from cosim.output.viewer.recording import APPLICATION_ID, LoopView, RecordingFile, ViewError
from cosim.output.viewer.run_recording import RunRecording
from cosim.record.align import AlignedRun
from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError, ExitStatus
from noack.protocol.record_tables import Fate
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.output.test_approved import compare
from tests.integration.conftest import wait_for

ROOT = Path(__file__).parents[4]

Floats = NDArray[np.float64]

STATES = ["V", "r", "psi", "Y_g"]
STEP_NS = 2_000_000
S = 1_000_000_000
K = 100

pytestmark = pytest.mark.skipif(
    not hasattr(os, "killpg"), reason="tells by process groups what is left behind"
)


def new_view(path: Path, live: LiveView | None = None, horizon_s: float = 20.0) -> RunRecording:
    given = load(find_shipped("lane_following", "scenarios"), [f"horizon_s={horizon_s}"])
    scenario = resolve(given)
    return RunRecording(scenario, path, 1, {0: scenario}, live=live)


def times(first: int, k: int = K) -> NDArray[np.int64]:
    return (first + np.arange(k)) * STEP_NS


def add_samples(view: RunRecording, batches: int, n: int = 4) -> None:
    """Samples with values that encode their series, coordinate and step."""
    for batch in range(batches):
        t_ns = times(batch * K)
        norm = t_ns.astype(np.float64) * 1e-9
        x: Floats = norm[:, None] + np.arange(n)
        bounds = np.stack([norm + 3, norm + 4], axis=1)
        found = aligned(t_ns, (x, x + 100, x + 200), (norm, norm + 1, norm + 2))
        view.views[0].samples(found, bounds, bounds + 2)


def aligned(
    t_ns: NDArray[np.int64], states: tuple[Floats, ...], norms: tuple[Floats, ...]
) -> AlignedRun:
    """x, x_s, x_c and ‖e_s‖, threshold, ‖e_c‖ at times (k,)."""
    none = np.full(len(t_ns), -1)
    return AlignedRun(t_ns, *states, *norms, received=none, sensor=none)


Chunks = dict[str, list[Any]]


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


def until(condition: Callable[[], bool]) -> None:
    """Wait until the condition is true; the test's own time limit ends the wait."""
    while not condition():
        time.sleep(0.02)


def is_left(group: int) -> bool:
    """Whether a process of the group is alive; a zombie does not count."""
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                return True
    return False


@contextlib.contextmanager
def another_process(code: str, path: Path) -> Iterator[subprocess.Popen[str]]:
    """Run code with this module as ``t`` and a path as ``path``, and kill it at the end."""
    head = (
        "import importlib.util, pathlib, sys;"
        f"spec = importlib.util.spec_from_file_location('t', {__file__!r});"
        "t = importlib.util.module_from_spec(spec); spec.loader.exec_module(t);"
        "path = pathlib.Path(sys.argv[1]);"
    )
    with subprocess.Popen(
        [sys.executable, "-c", head + code, str(path)],
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


def get(url: str, host: str | None = None) -> tuple[int, bytes]:
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port)
    with contextlib.closing(connection):
        target = f"{parts.path}?{parts.query}" if parts.query else parts.path
        connection.request("GET", target, headers={"Host": host or parts.netloc})
        answer = connection.getresponse()
        if (there := answer.getheader("Location")) is not None:
            return get(urljoin(url, there))
        return answer.status, answer.read()


@pytest.fixture
def live() -> Iterator[LiveView]:
    view = LiveView(native=False)
    yield view
    view.close()


@pytest.mark.parametrize("horizon_s", [20.0, 200.0])
def test_the_file_contains_every_sample_exactly(tmp_path: Path, horizon_s: float) -> None:
    """Short recordings have an index, long ones none."""
    path = tmp_path / "recording.rrd"
    with new_view(path, horizon_s=horizon_s) as view:
        add_samples(view, 5)
        view.views[0].inputs(times(0), np.stack((np.arange(K), -np.arange(K)), axis=1))
    chunks = read(path)
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


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording without samples."""
    path = tmp_path_factory.mktemp("empty") / "recording.rrd"
    new_view(path).close()
    return path


def test_the_recording_shows_what_was_approved(path: Path) -> None:
    """Names, colours and texts of what is drawn, and the panels of the layout."""
    reader = rerun.chunk.RrdReader(path)
    (recording,), (layout,) = reader.recordings(), reader.blueprints()
    assert recording.application_id == layout.application_id == APPLICATION_ID
    shown = [
        f"{entity} {name}: {value}"
        for entity, chunks in sorted(read(path).items())
        for batch in (chunk.to_record_batch() for chunk in chunks if chunk.is_static)
        for name in sorted(batch.schema.names)
        if name.endswith((":names", ":labels", ":colors", ":text"))
        for value in batch.column(name).to_pylist()
    ]
    shown += sorted(of_views(read(path, "blueprint"), "ViewBlueprint:display_name"))
    compare("recording.txt", "\n".join(shown))


def test_the_plots_show_the_whole_run_with_a_margin(path: Path) -> None:
    shared = read(path, "blueprint")["view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"]
    ((whole,),) = column(shared, "TimeAxis:view_range")
    assert -0.05 * 20 * S < whole["start"] < 0
    assert 1.05 * 20 * S < whole["end"] < 1.1 * 20 * S


@pytest.mark.parametrize("states", [["a"], ["a/b", "a b", "ψ"], [f"x{i}" for i in range(17)]])
def test_every_coordinate_has_a_panel(tmp_path: Path, states: list[str]) -> None:
    """Names with special characters give different entities, too."""
    path = tmp_path / "recording.rrd"
    shown = ShownLoop("", states, ["u"])
    with RecordingFile(path, "1", over_time(shown.panels(), 1.0), indexed=True) as file:
        LoopView(file, shown)
    entities = {entity for entity in read(path) if entity.startswith("state/")}
    assert len(entities) == len(states)
    origins = of_views(read(path, "blueprint"), "ViewBlueprint:space_origin")
    assert entities <= {o.removeprefix("/") for o in origins}


@pytest.mark.parametrize("threshold", [0.1, 0.0, np.inf, np.nan])
def test_the_logarithm_of_a_reset_error_stays_in_range(tmp_path: Path, threshold: float) -> None:
    """It is cut off at a thousandth of the threshold, or at 1e-12 if the rule has none."""
    path = tmp_path / "recording.rrd"
    with new_view(path) as view:
        x, e = np.zeros((3, 4)), np.array([0.1, 0.0, np.nan])
        none = np.full((3, 2), np.nan)
        found = aligned(times(0, 3), (x, x, x), (e, np.full(3, threshold), e))
        view.views[0].samples(found, none, none)
    assert not np.isinf(series(read(path), "error/norm")[1]).any()
    _, values = series(read(path), "error/log10")
    floor = -4.0 if threshold == 0.1 else -12.0
    np.testing.assert_allclose(values[:, 1], [-1.0, floor, np.nan], rtol=1e-12)
    assert not np.isinf(values).any()


def test_events_deliveries_losses_lateness_and_log_are_recorded(tmp_path: Path) -> None:
    """Every event is a mark on a stem; the first has height 0."""
    path = tmp_path / "recording.rrd"
    t_ns = np.array([0, 300, 700], dtype=np.int64)
    with new_view(path) as recording:
        view = recording.views[0]
        view.broadcasts(t_ns[:1], np.array([np.nan]))
        view.broadcasts(t_ns[1:], np.array([0.3, 0.4]))
        view.receptions(t_ns, np.array([np.nan, 0.3, 0.4]), np.array([False, True, False]))
        view.drops(np.array([100, 200], dtype=np.int64))
        view.drops(np.array([], dtype=np.int64))
        view.lateness("sensor", times(0, 3), np.array([1.0, 2.5, 900.0]))
        view.log(1_500_000_000, "WARN", "three measurements late")
    chunks = read(path)
    at, values = series(chunks, "event/interval")
    np.testing.assert_array_equal(at, t_ns)
    np.testing.assert_array_equal(values[:, 0], [0.0, 0.3, 0.4])
    at, values = series(chunks, "event/stem")
    np.testing.assert_array_equal(at, np.repeat(t_ns, 3))
    np.testing.assert_array_equal(values.reshape(3, 3), [[0, h, np.nan] for h in (0.0, 0.3, 0.4)])
    assert series(chunks, "reception/interval")[0].tolist() == [0, 700]
    at, values = series(chunks, "reception/forced")
    assert (at.tolist(), values.tolist()) == ([300], [[0.3]])
    assert series(chunks, "reception/stem")[0].tolist() == np.repeat(t_ns, 3).tolist()
    assert series(chunks, "drop")[0].tolist() == [100, 200]
    assert series(chunks, "lateness/sensor")[1].ravel().tolist() == [1.0, 2.5, 900.0]
    assert column(chunks["log"], "TextLog:level") == [["WARN"]]
    ((line,),) = column(chunks["log"], "TextLog:text")
    assert line.split(maxsplit=2) == ["1.500", "s", "three measurements late"]


def test_a_file_that_cannot_be_created_is_named(tmp_path: Path) -> None:
    with pytest.raises(ViewError, match=r"nowhere/recording.rrd: cannot create"):
        new_view(tmp_path / "nowhere" / "recording.rrd")


def test_a_disk_that_fills_during_the_run_is_reported_by_the_closing(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    code = (
        "import resource; view = t.new_view(path);"
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


def test_the_file_of_a_killed_writer_contains_all_written_rows(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    code = (
        "import time; view = t.new_view(path); t.add_samples(view, 5);"
        "print('written', flush=True); time.sleep(1000)"
    )
    with another_process(code, path) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "written\n"
        until(lambda: holds(path, 5 * K))
    assert rows_of(path) == 5 * K


def holds(path: Path, rows: int) -> bool:
    """Whether a file, possibly in the middle of a write, contains these rows."""
    with contextlib.suppress(RuntimeError, ValueError):
        return rows_of(path) == rows
    return False


def rows_of(path: Path) -> int:
    chunks = read(path).get("error/log10", [])
    return sum(c.num_rows for c in chunks if not c.is_static)


def test_a_live_viewer_receives_the_growing_file_to_its_end(tmp_path: Path, live: LiveView) -> None:
    path = tmp_path / "recording.rrd"
    view = new_view(path, live=live)
    assert live.url is not None
    assert live.url in live.status
    status, page = get(live.url)
    assert status == 200
    assert b"Rerun" in page
    parts = urlsplit(live.url + RECORDING)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port)
    with contextlib.closing(connection):
        connection.request("GET", parts.path)
        answer = connection.getresponse()
        received = answer.read(4)
        assert received == b"RRF2"
        size = path.stat().st_size
        add_samples(view, 5)
        while len(received) <= size:  # what was written after the download began
            received += answer.read(1)
        view.close()
        received += answer.read()
    assert received == path.read_bytes()
    live.close(keep=True)  # serves until it is ended
    assert get(live.url + RECORDING) == (200, path.read_bytes())
    assert live.pid is not None
    group = live.pid
    os.kill(group, signal.SIGTERM)
    live.close()
    assert not is_left(group)


def test_a_viewer_that_does_not_start_is_reported_and_the_run_is_recorded(
    tmp_path: Path, live: LiveView, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RERUN_CLI_PATH", shutil.which("false") or "false")
    path = tmp_path / "recording.rrd"
    with new_view(path, live=live) as view:
        add_samples(view, 1)
    assert live.url is None
    assert live.status == "no live view: rerun's web viewer did not start"
    assert rows_of(path) == K


def test_a_live_view_ends_when_the_recorder_is_killed(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(b"RRF2")
    code = (
        "import time; live = t.LiveView(native=False); live.show(path);"
        "print(live.pid, flush=True); time.sleep(1000)"
    )
    with another_process(code, path) as child:
        assert child.stdout is not None
        group = int(child.stdout.readline())
        assert is_left(group)
    until(lambda: not is_left(group))


WINDOW = """#!{python}
import os, sys, time, urllib.request
if "--serve-web" in sys.argv:
    os.execv({viewer!r}, [{viewer!r}, *sys.argv[1:]])
if {opens}:
    with urllib.request.urlopen(sys.argv[-1]) as answer, open({seen!r}, "wb") as seen:
        seen.write(answer.read())
sys.exit({status})
"""


def pretend_window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, opens: bool) -> Path:
    """Replace rerun's program by one that opens no window; its web server is rerun's."""
    folder = Path(str(__import__("rerun_cli").__file__)).parent
    program, seen = tmp_path / "viewer", tmp_path / "seen.rrd"
    program.write_text(
        WINDOW.format(
            python=sys.executable,
            viewer=str(folder / "rerun"),
            opens=opens,
            seen=str(seen),
            status=0 if opens else 1,
        )
    )
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    return seen


def test_a_window_is_shown_the_whole_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = pretend_window(tmp_path, monkeypatch, opens=True)
    path = tmp_path / "recording.rrd"
    live = LiveView(native=True)
    with new_view(path, live=live) as view:
        add_samples(view, 5)
        assert live.url is None
        assert live.status == "live view: in a window"
    live.close()
    until(lambda: seen.exists() and seen.read_bytes() == path.read_bytes())


def test_a_browser_is_served_if_no_window_opens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend_window(tmp_path, monkeypatch, opens=False)
    path = tmp_path / "recording.rrd"
    live = LiveView(native=True)
    new_view(path, live=live).close()
    assert live.url is not None
    assert get(live.url)[0] == 200
    live.close()


def test_other_host_names_and_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(b"RRF2 and more")
    with RecordingServer(path, follow=False) as server:
        assert server.origin.startswith("http://127.0.0.1:")
        recording = server.address + RECORDING
        assert get(recording) == (200, b"RRF2 and more")
        assert get(recording, host="localhost:1")[0] == 200
        assert get(recording, host="rebound.example:1")[0] == 403
        assert get(server.address + "../recording.rrd")[0] == 404


@pytest.mark.parametrize("content", [None, b"", b"<html>"])
def test_a_file_that_is_not_a_recording_is_not_served(
    content: bytes | None, tmp_path: Path
) -> None:
    path = tmp_path / "recording.rrd"
    if content is not None:
        path.write_bytes(content)
    wanted = "no such recording" if content is None else "not a rerun recording"
    with pytest.raises(CallerError, match=rf"recording\.rrd: {wanted}"):
        view_recording(path)


def listening(viewer: "subprocess.Popen[str]") -> list[str]:
    """Where a viewer listens: one port is for the page and the recording, one for rerun's files."""
    process = psutil.Process(viewer.pid)
    return [
        address.laddr.ip
        for one in (process, *process.children())
        for address in one.net_connections("inet")
        if address.status == psutil.CONN_LISTEN
    ]


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (signal.SIGINT, 0),
        (signal.SIGHUP, ExitStatus.TERMINATED),
        pytest.param(
            signal.SIGKILL, -signal.SIGKILL,
            marks=pytest.mark.skipif(sys.platform != "linux", reason="tells no child elsewhere"),
        ),
    ],
)  # fmt: skip
def test_viewing_without_a_display_serves_a_page_until_it_is_ended(
    tmp_path: Path, sent: int, status: int
) -> None:
    path = tmp_path / "recording.rrd"
    new_view(path).close()
    with another_process("t.view_recording(path)", path) as child:
        assert child.stdout is not None
        page = next(word for word in child.stdout.readline().split() if word.startswith("http"))
        assert get(page)[0] == 200
        assert get(page + RECORDING) == (200, path.read_bytes())
        assert listening(child) == ["127.0.0.1"] * 2
        child.send_signal(sent)
        assert child.wait() == status
        wait_for(lambda: not is_left(child.pid))


def test_a_picture_has_a_maximum_frame_rate_across_batches(tmp_path: Path) -> None:
    path = tmp_path / "recording.rrd"
    with new_view(path) as recording:
        view = recording.views[0]
        for first in range(0, 1000, 37):
            t_ns = times(first, min(37, 1000 - first))
            x = np.tile(t_ns[:, None] * 1e-9, (1, 4))
            view.move(t_ns, Frames(t_ns * 1e-9, x, x, x))
        view.packets(np.array([S]), np.array([S]), np.array([Fate.FORCED]))
        view.travel(2 * S)
    chunks = read(path)
    moving = [c for c in chunks["picture/plant"] if not c.is_static]
    places = np.array(column(moving, "Transform3D:translation"))[:, 0, :]
    assert len(places) == 2 * 60  # of 2 s, out of 1000 samples
    # the lateral offset grows; +y points down in the viewer
    assert (np.diff(places[:, 1]) < 0).all()
    shapes = column([c for c in chunks["network/forced"] if not c.is_static], "LineStrips2D:strips")
    assert [len(strips) for strips in (shapes[0], shapes[-1])] == [1, 0]


def test_a_dead_viewer_does_not_delay_the_recorder(tmp_path: Path, live: LiveView) -> None:
    path = tmp_path / "recording.rrd"
    view = new_view(path, live=live)
    assert live.pid is not None
    os.killpg(live.pid, signal.SIGKILL)
    add_samples(view, 5)
    view.close()
    live.close()
    assert rows_of(path) == 5 * K


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="there is always a display")
@pytest.mark.parametrize("variable", ["DISPLAY", "WAYLAND_DISPLAY", None])
def test_a_display_is_detected_from_the_environment(
    monkeypatch: pytest.MonkeyPatch, variable: str | None
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    if variable is not None:
        monkeypatch.setenv(variable, ":0")
    assert has_display() is (variable is not None)


def test_a_browser_is_served_with_a_display_if_no_window_is_wanted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On loopback only."""
    pretend_window(tmp_path, monkeypatch, opens=True)
    monkeypatch.setenv("DISPLAY", ":0")
    path = tmp_path / "recording.rrd"
    new_view(path).close()
    with subprocess.Popen(
        [sys.executable, "-m", "cosim.cli", "view", str(path), "--web"],
        stdout=subprocess.PIPE, text=True, cwd=ROOT, start_new_session=True,
    ) as child:  # fmt: skip
        try:
            assert child.stdout is not None
            page = next(word for word in child.stdout.readline().split() if "http" in word)
            assert get(page + RECORDING) == (200, path.read_bytes())
            assert listening(child) == ["127.0.0.1"] * 2
        finally:
            child.send_signal(signal.SIGTERM)
            assert child.wait() == ExitStatus.TERMINATED
