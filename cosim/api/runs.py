"""Runs: made, live or in virtual time, opened again, and looked at."""

import shutil
import tempfile
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.api.scenarios import Source, load
from cosim.output.row_display import as_html, as_text
from cosim.record.run_directory import RECORD, SCENARIO_FILE, chosen_run
from noack.config.scenario import Scenario
from noack.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

    from cosim.analysis.fidelity import Fidelity
    from cosim.analysis.replay import Replay
    from cosim.analysis.run_outcome import Outcome
    from cosim.record.run_record import RunRecord
    from cosim.studies.comparison.run_comparison import RunComparison

Folder = str | PathLike[str]


class Run:
    """A run that is over: its settings, its summary, its record.

    :func:`noack.simulate`, :func:`noack.run` and :func:`noack.open_run` give one. A run that was
    made without ``runs`` lies in a temporary folder, which is there as long as this object is.
    """

    directory: Path
    """The run directory; ``docs/record.md`` says what is in it."""

    def __init__(
        self, directory: Path, finalize: "Callable[[], Outcome]", temporary: Path | None = None
    ) -> None:
        self.directory = directory
        self._conclude = finalize
        if temporary is not None:
            weakref.finalize(self, shutil.rmtree, temporary, ignore_errors=True)

    @property
    def summary(self) -> dict[str, Any]:
        """What became of the run: ``summary.json``, whose keys ``docs/record.md`` documents.

        Of a simulated run in a temporary folder it is made, and its claims judged, when it is first
        asked for, by this or what follows from it; that takes a second or so.
        """
        return self._outcome.summary

    @property
    def ok(self) -> bool:
        """Whether the run reached its horizon, did not diverge, and all its rows are on record."""
        return self._outcome.status is ExitStatus.OK

    @property
    def reason(self) -> str:
        """Why it ended: ``horizon``, or what went wrong."""
        return self._outcome.reason

    @property
    def claims(self) -> list[dict[str, Any]]:
        """What was claimed of the run, each with its ``verdict``: held, violated or void."""
        claims: list[dict[str, Any]] = self.summary.get("claims") or []
        return claims

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario: what it left to a model's name, or to chance, is numbers here."""
        return self._record.scenario

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the record's tables."""
        return tuple(self._record.tables)

    def table(self, name: str) -> "pa.Table":
        """Return a table of the record, one row per input of a machine.

        Args:
            name: one of ``tables``, e.g. ``"plant_step"``.

        Returns:
            Its columns as in ``docs/record.md``: times in nanoseconds of simulated time, vectors
            one column per entry (``x_1``, ``x_2``, …). Before them ``t_s``, ``t_ns`` in seconds.

        Raises:
            NoackError: there is no such table, or its file is damaged.
        """
        from cosim.api.data_frames import with_seconds
        from cosim.record.run_record import read_table

        if name not in self.tables:
            known = ", ".join(self.tables)
            raise CallerError(f'"{name}": the record has no such table; it has {known}')
        path = self.directory / RECORD / f"{name}.parquet"
        return with_seconds(read_table(path, self._record.tables[name]))

    def samples(self) -> "pa.Table":
        """Return plant, sensor and controller side by side, one row per measurement.

        Returns:
            ``t_s`` and ``t_ns``; x, x_s and x_c, one column per state (``x_1``, ``x_s_1``,
            ``x_c_1``, …); ``e_s_norm`` before a reset, its ``threshold``, ``e_c_norm``, all in the
            trigger's norm; ``event``, the number of the update that was sent, −1 for none. x_s is
            shown after a reset; x_c is NaN where the controller's record does not reach. x is what
            the sensor takes for the state: with noise or an observer not quite the plant's.
        """
        from cosim.api.data_frames import samples

        return samples(self._record)

    def events(self) -> "pa.Table":
        """Return the sensor's transmissions, one row each.

        Returns:
            ``event``, its number; ``t_s`` and ``t_ns``; ``interval_s`` since the one before, NaN of
            the first; ``fate`` in the network: delivered, forced (by the bound on successive
            drops), dropped, corrupted, overflowed, blacked_out, overtaken, in_flight at the end, or
            none, if it did not get there; ``received``, whether the controller took it.
        """
        from cosim.api.data_frames import events

        return events(self._record)

    def plot(self, figure: str = "states") -> "Figure":
        """Draw a figure of the report.

        Args:
            figure: states, errors, state-norm, input or inter-event; of a live run also lateness or
                latency. Certified bounds are drawn beside what they bound.

        Raises:
            NoackError: there is no such figure of this run.
        """
        from cosim.output.report.run_figures import BOUNDED, pictures

        known = pictures(self._record, self._envelopes if figure in BOUNDED else ())
        if figure not in known:
            raise CallerError(f'"{figure}": no such figure of this run; it has {", ".join(known)}')
        return known[figure]().figure

    def report(self) -> Path:
        """Write ``report.html``, a page with all figures, into the run directory; return its path.

        Raises:
            NoackError: it cannot be written.
        """
        from cosim.live.finalize import rewrite_report

        return rewrite_report(self.directory)

    def replay(self) -> "Replay":
        """Feed every machine its recorded inputs again and compare the outputs bit for bit.

        Returns:
            The verdict: ``bit_exact``, ``first_difference``, ``gaps``, and more.
        """
        from cosim.analysis.replay import replay

        return replay(self._record)

    def fidelity(self) -> "Fidelity":
        """Compare the run with the ideal loop in continuous time, effect by effect.

        Returns:
            The differences: ``verdict`` in words, ``stages``, ``explained_relative``, and more.

        Raises:
            NoackError: there is no ideal loop to compare it with, or the record has holes.
        """
        from cosim.analysis.fidelity import compute_fidelity

        return compute_fidelity(self._record)

    @cached_property
    def _outcome(self) -> "Outcome":
        return self._conclude()

    @cached_property
    def _record(self) -> "RunRecord":
        from cosim.record.run_record import load_record

        return load_record(self.directory)

    @cached_property
    def _envelopes(self) -> list[Any]:
        from cosim.analysis.claims.claims_by_part import RunClaims

        return RunClaims(self._record).envelopes()

    def _facts(self) -> Iterator[tuple[str, str]]:
        """What matters, in a few lines."""
        found = self.summary
        mode = "model-based" if found["mode"] == "model" else "zero-order hold"
        yield "run", f"{found['scenario']}, {mode}, {found['kind']}, M − 1 = {found['mansd']}"
        yield "ended", f"at {found['reached_s']:g} s of {found['horizon_s']:g} s: {self.reason}"
        yield (
            "events",
            f"{found['events']}; {found['deliveries']} received, {found['drops']} lost, "
            f"longest loss burst {found['longest_loss_burst']}",
        )
        norms = (found["initial_state_norm"], found["final_state_norm"])
        yield "‖x‖", " → ".join("unknown" if norm is None else f"{norm:.3g}" for norm in norms)
        verdicts = Counter(claim["verdict"] for claim in self.claims)
        yield "claims", ", ".join(f"{n} {verdict}" for verdict, n in verdicts.items()) or "none"
        yield "directory", str(self.directory)

    def __repr__(self) -> str:
        return as_text([*self._facts()])

    def _repr_html_(self) -> str:
        return as_html([*self._facts()])


def simulate(scenario: Source, *, runs: Folder | None = None) -> Run:
    """Run a scenario in virtual time: the same machines and losses, no sockets, never late.

    Args:
        scenario: as :func:`noack.load` gives it, or takes it.
        runs: where its run directory is made; without it, in a temporary folder, and without the
            recording for the viewer.

    Raises:
        NoackError: the scenario is wrong, or the run directory cannot be written.
    """
    from cosim.live.finalize import finalize
    from cosim.live.simulated_run import simulate_run

    loaded = load(scenario)
    with _folder(runs) as (folder, temporary):
        ending = simulate_run(loaded, folder, view=temporary is None)
        made = Run(ending.run_dir, lambda: finalize(ending, report=False), temporary)
    if temporary is None:
        made.summary  # noqa: B018  # it belongs into the run directory
    return made


def run(scenario: Source, *, runs: Folder | None = None, progress: bool = False) -> Run:
    """Run a scenario live: real processes over real UDP sockets on this machine.

    It takes the scenario's ``horizon_s`` over its ``speed``, and a start of some seconds. A run
    that is interrupted (Ctrl-C) ends in good order and is returned; ``ok`` is then false, as of a
    run of which a process died.

    Args:
        scenario: as :func:`noack.load` gives it, or takes it.
        runs: where its run directory is made; without it, in a temporary folder.
        progress: show a progress line on standard error.

    Raises:
        NoackError: the scenario is wrong; the run could not begin, e.g. as a port is taken; or this
            is not the main thread, which signals go to.
    """
    from cosim.live.finalize import finalize
    from cosim.live.launcher import launch
    from cosim.live.progress import PatientConsole, progress_line

    loaded = load(scenario)
    if threading.current_thread() is not threading.main_thread():
        raise CallerError(
            "noack.run: a live run is started by the main thread, which signals go to"
        )
    with _folder(runs) as (folder, temporary):
        console = PatientConsole(stderr=True, quiet=not progress)
        with progress_line(console, loaded) as watcher:
            ending = launch(loaded, folder, watcher=watcher)
        outcome = finalize(ending, report=False)
        return Run(ending.run_dir, lambda: outcome, temporary)


def open_run(directory: Folder = "runs/latest") -> Run:
    """Open an earlier run, live or simulated; finish its record if nobody did.

    Args:
        directory: a run directory. ``runs/latest`` leads to the newest below ``runs``.

    Raises:
        NoackError: it is no run directory, ``latest`` is another user's, its record is damaged, or
            the run is still under way.
    """
    from cosim.live.finalize import reopen

    path = chosen_run(Path(directory), Path(directory).parent)
    if not (path / SCENARIO_FILE).is_file():
        raise CallerError(f"{path}: not a run directory (no {SCENARIO_FILE})")
    outcome = reopen(path.resolve())
    return Run(outcome.run_dir, lambda: outcome)


def compare(*runs: Run | Folder) -> "RunComparison":
    """Put two or more runs beside each other; :meth:`Run.fidelity` is against the ideal loop.

    Args:
        runs: two to seven, each as a :class:`Run` or a run directory, live or simulated.

    Returns:
        The comparison: ``numbers`` side by side with their differences to the first run,
        ``settings`` that differ, ``plot()`` for the overlay, ``save(path)``, ``to_json()``.

    Raises:
        NoackError: they are too few or too many, or their plants have different numbers of states.
    """
    from cosim.studies.comparison.run_comparison import compare_runs

    for one in runs:
        if isinstance(one, Run):
            one.summary  # noqa: B018  # a temporary run's is made when it is first asked for
    return compare_runs([one.directory if isinstance(one, Run) else Path(one) for one in runs])


@contextmanager
def _folder(runs: Folder | None) -> Iterator[tuple[Path, Path | None]]:
    """Where a run directory is made; the same again if it is temporary, gone if no run comes."""
    if runs is not None:
        yield Path(runs), None
        return
    temporary = Path(tempfile.mkdtemp(prefix="noack-"))
    try:
        yield temporary, temporary
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
