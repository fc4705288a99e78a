"""Fixtures for all tests: one thread, deterministic Hypothesis examples, a small scenario.

By default, each run tries the same few examples; ``--hypothesis-profile search`` tries a thousand
new examples per test.
"""

import copy
import gc
import os
import shutil
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Before numpy is imported: threads slow small matrices down.
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MPLBACKEND"] = "Agg"  # no window, also where there is a display
os.environ["NOACK_NO_EXTENSIONS"] = "1"  # their tests are beside them, in a run of their own

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

from tests.helpers.pages import fill

if TYPE_CHECKING:
    from cosim.analysis.witnesses import Witnesses

# The workers and the programs that tests start import the same modules hundreds of times.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
gc.disable()  # until everything is loaded, of which nothing is garbage

settings.register_profile(
    "noack",
    max_examples=10,
    deadline=None,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],  # this check reads the wall clock
)
settings.register_profile("few", settings.get_profile("noack"), max_examples=8)  # with sanitizers
settings.register_profile(
    "search",
    settings.get_profile("noack"),
    max_examples=1000,
    derandomize=False,
)
settings.load_profile("noack")


TESTS = f"{Path(__file__).parent}{os.sep}"
LIVE_TESTS = f"{TESTS}integration{os.sep}"
"""The one folder that ``make test`` collects for live tests."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.get_closest_marker("live") is None:
            continue
        if (path := str(item.path)).startswith(TESTS) and not path.startswith(LIVE_TESTS):
            raise pytest.UsageError(f"{item.nodeid}: a live test belongs into tests/integration")
    if settings().derandomize:
        # Hypothesis would also try constants of the loaded modules, which depend on the tests that
        # this worker has run before.
        providers._get_local_constants = providers.Constants


def pytest_collection_finish() -> None:
    """Spare the garbage collector what is loaded by now: half a million objects that stay."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def no_signal_is_ignored_by_children() -> Iterator[None]:
    """Stop child processes from inheriting ignored signals.

    A background process of a shell ignores SIGINT, a process under nohup ignores SIGHUP, and
    children inherit an ignored signal. They do not inherit a handler that does nothing.
    """
    ignored = [
        number
        for name in ("SIGINT", "SIGHUP", "SIGTERM", "SIGQUIT")
        if (number := getattr(signal, name, None)) and signal.getsignal(number) is signal.SIG_IGN
    ]
    for number in ignored:
        signal.signal(number, lambda *_: None)
    yield
    for number in ignored:
        signal.signal(number, signal.SIG_IGN)


@pytest.fixture(scope="session", autouse=True)
def runs_of_other_workers_are_unknown(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[None]:
    """Give this worker a runtime directory of its own: a run warns of other active runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        yield


@pytest.fixture(scope="session", autouse=True)
def witnesses_are_found_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give all workers one folder for what is found of scenarios, and none that was found before."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        # A search takes seconds: the claims of a run are about bounds that need none.
        for module in ("cosim.analysis.claims.run_certificates", "cosim.live.finalize"):
            patch.setattr(f"{module}.search_limit", lambda loops: 0.0)
        yield


@pytest.fixture
def nothing_was_found_before(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hide what was found earlier, by tests or for the package: it is better than what needs no search."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
    monkeypatch.setattr("cosim.analysis.witness_store.SHIPPED", tmp_path_factory.mktemp("shipped"))


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Finalise runs without a report, whose figures take longer than everything else."""
    monkeypatch.setattr("cosim.live.finalize._write_report", lambda *_: None)


@pytest.fixture
def no_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """Finalise runs without a recording for the viewer: half of a short run's end."""
    monkeypatch.setattr("cosim.live.finalize._write_recording", lambda *_: None)


@pytest.fixture
def without_viewer(no_recording: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Start processes without the viewer's package, which is slow to import; see its folder."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent / "integration" / "without_viewer"))


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write pages whose figures are not drawn, which takes most of their time."""
    monkeypatch.setattr("cosim.output.page_kit.inline", lambda *_: "<svg></svg>")


@pytest.fixture
def short_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """End searches for witnesses early, where it does not matter what is proven."""
    from cosim.analysis.certificates import Certificates

    prove = Certificates.prove

    def shortly(self: Certificates, *_: object, **named: Any) -> "Witnesses":
        return prove(self, **(named | {"most_work": 0.02}))

    monkeypatch.setattr(Certificates, "prove", shortly)


@pytest.fixture
def no_searches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a search find what needs none, where it does not matter what is proven.

    Even the shortest search takes some seconds. What is found is kept apart from what others find.
    """
    from noack.theory.witnesses.documents import witness_by_gains
    from noack.theory.witnesses.regions import region_witness_by_gains

    monkeypatch.setenv("XDG_CACHE_HOME", f"{os.environ['XDG_CACHE_HOME']} without searches")
    for name, by_gains in (("", witness_by_gains), ("region_", region_witness_by_gains)):

        def find(
            of: Any, outputs: Sequence[str], *, ultimate: Sequence[str], by_gains: Any = by_gains, **_: object
        ) -> object:
            return by_gains(of, (*outputs, "e_s", *ultimate))

        monkeypatch.setattr(f"cosim.analysis.witnesses.find_{name}witness", find)


@pytest.fixture
def usual_signals() -> Iterator[None]:
    """Let signals do what they usually do, also in a process that was started to ignore them."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def unchanged_documented_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files that the documentation's commands and snippets use, which no test changes."""
    return fill(tmp_path_factory.mktemp("documented"))


@pytest.fixture
def documented_folder(unchanged_documented_folder: Path, tmp_path: Path) -> Path:
    """A copy of this folder."""
    folder = tmp_path / "documented"
    shutil.copytree(unchanged_documented_folder, folder, symlinks=True)
    return folder


CONTENT: dict[str, Any] = {
    "name": "small",
    "horizon_s": 1.0,
    "model": {"name": "double_integrator"},
    "plant": {"initial_state": [1.0, 0.0]},
    "trigger": {"beta": 0.5, "alpha_per_s": 0.25},
    "network": {"mansd": 2, "loss": {"model": "bernoulli", "probability": 0.5}},
}


@pytest.fixture
def content() -> dict[str, Any]:
    """A minimal valid scenario of the double integrator, as parsed TOML."""
    return copy.deepcopy(CONTENT)
