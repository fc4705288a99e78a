"""Runs: functions that run a scenario live or in virtual time, or open an earlier run."""

import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa

from cosim.analysis.replay import ReplayResult
from cosim.analysis.replay.run_replay import replay_run
from cosim.analysis.summary.run_summary import Outcome, outcome_of_loop
from cosim.analysis.summary.summary_model import Claim, RunSummary
from cosim.api.scenarios import Source, load
from cosim.live import finalize as run_end
from cosim.live.monitoring.run_observers import RunObserver
from cosim.live.monitoring.run_terminal import RunTerminal
from cosim.output import run_tables, run_verdict
from cosim.output.curves import Curve
from cosim.output.export.export_formats import export_run
from cosim.output.figures.figure_format import requested_files
from cosim.output.figures.network_figures import page_figures
from cosim.output.figures.page_figure import PageFigure
from cosim.output.figures.run_figures import BOUNDED, run_curves
from cosim.output.table_files import save_tables as save_result_tables
from cosim.record import data_frames
from cosim.record.run_directory import RECORD, REPORT_FILE, chosen_run, file_of_loop, require_run_directory
from cosim.record.run_record import RecordedRun, RunRecord, load_run, no_such_loop
from cosim.record.table_files import TableFile, arrow_table
from cosim.simulation.virtual_time import simulate_run
from cosim.studies.run_comparison import RunComparison, compare_runs
from netem.core.errors import CallerError, ExitStatus
from netem.core.number_format import as_html, as_text
from netem.output.document import Sentence
from noack.scenario.arrival_ties import with_later_updates
from noack.scenario.scenario import Scenario

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PathLike = str | os.PathLike[str]


class Run:
    """A completed run: its settings, its summary, its record.

    :func:`noack.simulate`, :func:`noack.run` and :func:`noack.open_run` return one. Without the
    argument ``runs``, the run is in a temporary folder, which exists as long as this object. Of n
    states and m inputs, ``samples()`` has columns for each.

    >>> import noack
    >>> run = noack.simulate(noack.load("double_integrator", {"horizon_s": 2.0}))
    >>> run.ok, run.reason, run.summary.loops[0].longest_loss_burst
    (True, 'horizon', 4)
    >>> {claim.verdict.value for claim in run.claims}
    {'held'}
    """

    directory: Path
    """The run directory; ``docs/record.md`` describes its content."""

    def __init__(
        self,
        directory: Path,
        finalize: Callable[[], Outcome],
        temporary: Path | None = None,
        loop: str | None = None,
    ) -> None:
        self.directory, self._loop = directory, loop
        self._finalize = finalize
        if temporary is not None:
            weakref.finalize(self, shutil.rmtree, temporary, ignore_errors=True)

    @property
    def summary(self) -> RunSummary:
        """The results of the run, such as ``summary.loops[0].events``; see ``docs/record.md``.

        ``summary.to_json()`` is the content of ``summary.json``.

        For a simulated run in a temporary folder, the summary and the verdicts of the claims are
        computed at the first access to this property, or to one that depends on it. This takes
        about a second.
        """
        return self._outcome.summary

    @property
    def ok(self) -> bool:
        """Whether the run reached its horizon, did not diverge, and all its rows are recorded."""
        return self._outcome.status is ExitStatus.OK

    @property
    def reason(self) -> str:
        """The reason for the end of the run: ``horizon``, or an error."""
        return self._outcome.reason

    @property
    def verdict(self) -> list[Sentence]:
        """How the run ended, whether its guarantee was kept, its transmissions.

        Each line has a ``text``, and a ``tone``: good, doubt, bad or empty.
        """
        return [*run_verdict.verdict(self.summary)]

    @property
    def claims(self) -> list[Claim]:
        """The claims about all loops, each with its ``verdict``, as ``ClaimVerdict`` lists them."""
        return [claim for loop in self.summary.loops for claim in loop.claims]

    @property
    def loops(self) -> "Mapping[str, Run]":
        """The loops of the run, each as a run, by name; their times are their own.

        ``samples`` and ``events`` are of one loop: the only one of the run, or one of these.
        Another name is a NoackError.
        """
        return _Loops((name, self._of(name)) for name in self._run.names if self._loop in (None, name))

    def _of(self, loop: str) -> "Run":
        return Run(self.directory, lambda: outcome_of_loop(self._outcome, loop), loop=loop)

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario, with numbers in place of model names and random draws.

        That of a run of several loops has them as [[loops]].
        """
        shared = self._loop is None and self._run.names[1:]
        return self._run.scenario if shared else self._record.scenario

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the record's tables."""
        return tuple(self._run.resolved.tables)

    def table(self, name: str) -> pa.Table:
        """Return a table of the record, one row per input of a machine.

        Args:
            name: one of ``tables``, e.g. ``"plant_step"``.

        Returns:
            The table with the columns of ``docs/record.md``: times in nanoseconds of simulated
            time, and one column per entry of a vector (``x_1``, ``x_2``, …). The first column is
            ``t_s``, the time ``t_ns`` in seconds; the tables of plant, sensor and controller have
            the number of the ``loop``. Of a loop of ``loops``, the rows of this loop. Of one loop, a
            table with x ends with the states and the scenario's outputs, by their names.

        Raises:
            NoackError: there is no such table, or its file is damaged.
        """
        if name not in self.tables:
            known = ", ".join(self.tables)
            raise CallerError(f'"{name}": the record has no such table; it has {known}')
        if self._loop is not None:
            table = data_frames.with_seconds(arrow_table(self._record[name]))
            return data_frames.with_outputs(table, self.scenario)
        path = self.directory / RECORD / f"{name}.parquet"
        file = TableFile(path, self._run.resolved.tables[name])
        table = data_frames.with_seconds(file.whole())
        return table if self._run.names[1:] else data_frames.with_outputs(table, self.scenario)

    def samples(self) -> pa.Table:
        """Return plant, sensor and controller side by side, one row per measurement.

        Returns:
            ``t_s`` and ``t_ns``; x, x_s and x_c, one column per state (``x_1``, ``x_s_1``,
            ``x_c_1``, …); x once more by the names of the states, and the scenario's outputs by
            theirs; ``e_s_norm`` before a reset, its ``threshold``, and ``e_c_norm``, all in the trigger's
            norm; ``event``, the number of the transmitted update, or −1. x_s is the
            value after a reset. x_c is NaN at times without controller records. x is the state that
            the sensor uses; with noise or an observer it differs from the plant's state.
        """
        return data_frames.samples(self._record)

    def events(self) -> pa.Table:
        """Return the sensor's transmissions, one row each.

        Returns:
            ``event``, its number; ``t_s`` and ``t_ns``; ``interval_s``, the inter-event time, NaN
            for the first event; ``fate`` in the network: delivered, forced (delivered because ``mansd``
            was reached), dropped, corrupted, overflowed, blacked_out, delivered_out_of_order,
            in_flight at the end, or none, if it did not reach the network; ``received``, whether
            the controller processed it.
        """
        return data_frames.events(self._record)

    def curves(self) -> list[Curve]:
        """Return the curves of a loop as a table, to be drawn by other means.

        Returns:
            A :class:`noack.Curve` for each signal: the states of plant and models, the errors with
            the threshold, ‖x‖, the inputs, the transmissions, and the certified bounds of these. A
            long run has only as many times as a figure shows.
        """
        return run_curves(self._record)

    def plot(self, figure: str = "states") -> "Figure":
        """Draw a figure of the report.

        Args:
            figure: states, errors, state-norm, input or inter-event; outputs, if the scenario states
                some; for a live run also lateness
                or latency, and on hosts with different clocks clocks. Certified bounds are drawn
                next to the bounded quantity. Of loops that share a network: network, loops or map.

        Raises:
            NoackError: the run has no such figure.
        """
        return self._describe(figure).draw()

    def _describe(self, figure: str) -> PageFigure:
        """Return a figure of the report; raise CallerError if the run has no such figure."""
        known = self._figures(bounded=figure in BOUNDED)
        if figure not in known:
            raise CallerError(f'"{figure}": no such figure of this run; it has {", ".join(known)}')
        return known[figure]()

    def save_figures(
        self,
        format: str = "pdf",  # noqa: A002
        width: str | float | None = None,
        figure: str | None = None,
    ) -> list[Path]:
        """Write the figures of the report into ``report-figures`` in the run directory.

        Args:
            format: svg, png or pdf; a PDF has fonts like those of printed papers (STIX).
            width: ``"column"`` (3.5 in), ``"page"`` (7.16 in), or inches; by default a column for
                pdf, and 10 in for svg and png.
            figure: only this one; the names are those of :meth:`plot`. By default all.

        Returns:
            The paths.

        Raises:
            NoackError: there is no such format, width or figure, or a file cannot be written.
        """
        from cosim.output.figures.figure_files import save_figures  # imports matplotlib

        page = self.directory / file_of_loop(REPORT_FILE, self._loop)
        files = requested_files(format, width)
        if figure is not None:
            return save_figures([self._describe(figure)], page, files)
        figures = (describe() for describe in self._figures(bounded=True).values())
        return save_figures(figures, page, files)

    def save_tables(self, folder: PathLike) -> list[Path]:
        """Write the tables of the summary: :func:`noack.save_tables` of this run.

        Raises:
            NoackError: a file cannot be written.
        """
        tables = run_tables.summary_tables(self.summary)
        return save_result_tables(tables, Path(folder))

    def report(self) -> Path:
        """Write ``report.html``, a page with all figures, into the run directory; return its path.

        Raises:
            NoackError: the file cannot be written.
        """
        return run_end.run_report(self.directory, self._loop, again=True)

    def export(self, path: PathLike, *, certificates: bool = True) -> list[Path]:
        """Write the run for other programs; return the written files.

        Args:
            path: ``.mat`` for MATLAB and Octave, or the ending of an extension's format; without an
                ending, a folder of CSV files.
            certificates: whether a ``.mat`` file has the certificates of each loop, which take
                about a second each.

        Raises:
            NoackError: the path has another ending, or a file cannot be written.
        """
        self._ensure_summary()
        return export_run(self.directory, Path(path), loop=self._loop, certificates=certificates)

    def replay(self) -> ReplayResult:
        """Feed every machine its recorded inputs again and compare the outputs bit for bit.

        Returns:
            The result: ``bit_exact``, ``first_difference``, ``gaps``, and more.
        """
        return replay_run(self._run, self._loop)

    def _figures(self, *, bounded: bool) -> Mapping[str, Callable[[], PageFigure]]:
        """Return functions that describe the figures, by name; ``bounded`` with their bounds."""
        return page_figures(self._run, lambda: self.summary, self._loop, bounded=bounded)

    def _ensure_summary(self) -> None:
        """Write the summary into the run directory: a temporary run computes it when it is used."""
        _ = self._outcome

    @cached_property
    def _outcome(self) -> Outcome:
        return self._finalize()

    @cached_property
    def _run(self) -> RecordedRun:
        return load_run(self.directory)

    @cached_property
    def _record(self) -> RunRecord:
        return self._run.loop(self._loop)

    def _facts(self) -> list[tuple[str, str]]:
        return run_tables.run_facts(self.summary, self.directory)

    def __repr__(self) -> str:
        return as_text(self._facts())

    def _repr_html_(self) -> str:
        return as_html(self._facts())


class _Loops(dict[str, Run]):
    """Loops by name; another name is a mistake of the caller, as for ``--loop``."""

    def __missing__(self, name: str) -> Run:
        raise no_such_loop(name, [*self])


def simulate(scenario: Source, *, runs: PathLike | None = None) -> Run:
    """Run a scenario in virtual time: the same machines and losses, no sockets, never late.

    >>> import noack
    >>> run = noack.simulate(noack.load("lane_following", {"horizon_s": 4.0}))
    >>> run.ok, run.replay().bit_exact
    (True, True)
    >>> run.events().column_names
    ['event', 't_s', 't_ns', 'interval_s', 'fate', 'received']

    Args:
        scenario: a scenario, or a source that :func:`noack.load` accepts.
        runs: folder for the run directory. Without it, the run is in a temporary folder and has no
            recording for the viewer.

    Raises:
        NoackError: the scenario is wrong, or the run directory cannot be written.
    """
    loaded, _ = with_later_updates(load(scenario))
    with _folder(runs) as (folder, temporary):
        ending, view = simulate_run(loaded, folder), temporary is None
        simulated = Run(ending.run_dir, lambda: run_end.finalize(ending, report=False, view=view), temporary)
    if temporary is None:
        simulated._ensure_summary()
    return simulated


def run(
    scenario: Source,
    *,
    runs: PathLike | None = None,
    progress: bool = False,
    observers: Sequence[RunObserver] = (),
) -> Run:
    """Run a scenario live: real processes over real UDP sockets on this machine.

    It takes the scenario's ``horizon_s`` divided by its ``speed``, plus a start of some seconds. If
    the run is interrupted (Ctrl-C), it is finalised and returned. ``ok`` is then false, as for a
    run in which a process died.

    >>> import noack
    >>> run = noack.run(noack.load("double_integrator", {"horizon_s": 0.5}))
    >>> run.reason
    'horizon'

    Args:
        scenario: a scenario, or a source that :func:`noack.load` accepts.
        runs: folder for the run directory; without it, a temporary folder.
        progress: show a progress line on standard error.
        observers: are told what happens during the run.

    Raises:
        NoackError: the scenario is wrong; the run could not start, e.g. because a port is in use;
            or the caller is not the main thread, which receives the signals.
    """
    from cosim.live.launcher import launch  # imports zenoh

    loaded = load(scenario)
    if threading.current_thread() is not threading.main_thread():
        raise CallerError("noack.run: a live run is started by the main thread, which signals go to")
    with _folder(runs) as (folder, temporary):
        with RunTerminal(loaded) as terminal:
            shown = [terminal] if progress else []
            ending = launch(loaded, folder, observers=[*shown, *observers])
        outcome = run_end.finalize(ending, report=False, view=temporary is None)
        return Run(ending.run_dir, lambda: outcome, temporary)


def open_run(directory: PathLike = "runs/latest") -> Run:
    """Open an earlier run, live or simulated; finalise an interrupted run first.

    >>> import noack
    >>> simulated = noack.simulate(noack.load("lane_acknowledged", {"horizon_s": 1.0}))
    >>> noack.open_run(simulated.directory).ok
    True

    Args:
        directory: a run directory. ``runs/latest`` is the newest one in ``runs``.

    Raises:
        NoackError: it is not a run directory, ``latest`` belongs to another user, the record is
            damaged, or the run is still active.
    """
    path = chosen_run(Path(directory), Path(directory).parent)
    require_run_directory(path)
    outcome = run_end.reopen(path.resolve())
    opened = Run(outcome.run_dir, lambda: outcome)
    _ = opened._run  # an error if a table is missing or damaged
    return opened


def compare(*runs: Run | PathLike) -> RunComparison:
    """Compare two or more runs.

    >>> import noack
    >>> scenario = noack.load("lane_acknowledged", {"horizon_s": 2.0})
    >>> two = [noack.simulate(noack.with_settings(scenario, {"trigger.beta": b})) for b in (0.1, 0.4)]
    >>> noack.compare(*two).numbers[1]
    KeyNumber(name='transmissions', values=(9, 6))

    Args:
        runs: two to seven, each as a :class:`Run` or a run directory, live or simulated.

    Returns:
        The comparison: ``numbers`` with their differences to the first run, ``settings`` that
        differ, ``plot()`` for the overlay, ``save(path)``, ``to_json()``.

    Raises:
        NoackError: there are fewer than two or more than seven runs, or their plants have different
            numbers of states.
    """
    for source in runs:
        if isinstance(source, Run):
            source._ensure_summary()
    directories = [source.directory if isinstance(source, Run) else Path(source) for source in runs]
    return compare_runs(directories)


@contextmanager
def _folder(runs: PathLike | None) -> Iterator[tuple[Path, Path | None]]:
    """Yield the folder for a run directory, twice if it is temporary; after an error, remove it."""
    if runs is not None:
        yield Path(runs), None
        return
    temporary = Path(tempfile.mkdtemp(prefix="noack-"))
    try:
        yield temporary, temporary
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
