"""Certificates, margins, measurements and campaigns, and the tables of all results as files."""

import shutil
import sys
import tempfile
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from cosim.analysis.certificates import Certificates, certificates_of
from cosim.analysis.margin_search import MOST_M, MarginResult, find_margin
from cosim.analysis.mean_cost import MeanCost, find_mean_cost
from cosim.api.runs import Run
from cosim.api.scenarios import Source, load, plain_table
from cosim.lazy_modules import lazy_modules
from cosim.measurement.network_measurement import QUANTILES, MeasurementOptions, NetworkMeasurement
from cosim.measurement.network_section import write_network
from cosim.measurement.trace_sources import read_source
from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError
from noack.core.number_format import TextRows, as_html, as_text
from noack.core.system_processes import cores
from noack.scenario import toml_file
from noack.scenario.resolution import resolve
from noack.theory.margins.joint_spectral_radius import ACCURACY
from noack.traces.packet_trace import find_trace

with lazy_modules():
    from cosim.live.monitoring import progress as progress_display
    from cosim.measurement import measurement_outputs
    from cosim.output import certificate_report, result_tables
    from cosim.output.figures import figure_drawing
    from cosim.studies.campaign import (
        campaign_figures,
        campaign_file,
        campaign_report,
        campaign_summary,
        campaign_workers,
    )

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

_TABLE = Path("campaign")
"""Stands for the file of a campaign that is given as a table."""


def certify(scenario: Source, *, weight: str = "given", late: int | None = None) -> Certificates:
    """Return the certificates of a scenario, with their constants and conditions.

    >>> import noack
    >>> certificates = noack.certify("lane_following")
    >>> certificates.schedule.constants is None  # there is one
    False
    >>> print(f"no two events closer than {1e3 * certificates.schedule.inter_event_s:.0f} ms")
    no two events closer than 10 ms

    If the plant is not linear, the model is certified as the plant, and ``nonlinear`` says so.

    Args:
        scenario: a scenario, or a source that :func:`noack.load` accepts.
        weight: W of the trigger's norm: ``given`` by the scenario, ``identity``, or ``chosen`` so
            that more can be certified, which takes some seconds.
        late: plant steps by which the schedule may be late, 0 to 1000; by default the scenario's
            own value.

    Raises:
        NoackError: the scenario is wrong, or there are no certificates for it: its trigger is not
            the paper's, its updates are acknowledged, or u is not K x_c.
    """
    return certificates_of(load(scenario), weight, late, of_model=True)


def margin(
    scenario: Source,
    *,
    most_m: int = MOST_M,
    accuracy: float = ACCURACY,
    period: bool = True,
    guarantees: Sequence[str] = (),
    effort: float = 1.0,
) -> MarginResult:
    """Return the largest M for which a loop is stable under every loss pattern.

    >>> import noack
    >>> noack.margin("lane_periodic", most_m=3, period=False).stable_m
    3

    Args:
        scenario: a scenario whose trigger has a longest time between two events, as ``periodic``
            and ``deadline`` have, or a source that :func:`noack.load` accepts.
        most_m: largest M to examine.
        accuracy: wanted ratio of upper and lower bound of the growth, minus 1.
        period: whether to search for the longest period with the scenario's own M, too.
        guarantees: other guarantees to examine, in words such as ``mansd 4 atmost 3 in 10``.
        effort: factor of the work that a decision may take.

    Raises:
        NoackError: the scenario is wrong; or its trigger has no longest time, its loop is not
            linear, or its delay varies or is not below the shortest period.
    """
    return find_margin(
        resolve(load(scenario)),
        most_m=most_m,
        accuracy=accuracy,
        with_period=period,
        guarantees=guarantees,
        effort=effort,
    )


def cost(
    scenario: Source, *, Q: Sequence[object] | None = None, R: Sequence[object] | None = None
) -> MeanCost:
    """Return the mean cost ∫ xᵀQx + uᵀRu dt, and the rms of all states, under random losses.

    >>> import noack
    >>> mean_cost = noack.cost("lane_periodic")
    >>> round(mean_cost.with_guarantee.growth, 6)  # below 1: stable in mean square
    0.862511

    Args:
        scenario: a scenario with a time-triggered sensor (policy ``periodic``), or a source that
            :func:`noack.load` accepts.
        Q: weight of the state, (n, n); None: the identity.
        R: weight of the input, (m, m); None: the identity.

    Raises:
        NoackError: the scenario is wrong, or its loop is not covered; the message names the
            setting.
    """
    resolved = resolve(load(scenario))
    weights = (None if weight is None else np.array(weight, np.float64) for weight in (Q, R))
    return find_mean_cost(resolved, *weights)


class Measurement(NetworkMeasurement):
    """The measurement of a network, which writes its page and a network that reproduces it."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the page of tables and figures (``.html``).

        Raises:
            NoackError: the name has another ending, or the file cannot be written.
        """
        measurement_outputs.write_page(self, None, Path(path))

    def write_network(self, path: str | PathLike[str], form: Literal["trace", "model"] = "trace") -> None:
        """Write a ``[network]`` section that reproduces the network (``.toml``).

        Raises:
            NoackError: the name has another ending, or a file cannot be written.
        """
        write_network(self, Path(path), form)


def measure(
    *sources: str | PathLike[str],
    deadline_s: float | None = None,
    outage_s: float | None = None,
    shares: Sequence[float] | None = None,
) -> Measurement:
    """Measure a network from a packet trace, as ``noack measure`` does.

    >>> import noack
    >>> network = noack.measure("rural_n8_10kmh", deadline_s=0.1)
    >>> network.longest_loss_burst >= 1
    True

    Args:
        sources: a file, the name of a shipped trace, or files that belong together.
        deadline_s: a packet that takes longer counts as lost.
        outage_s: loss bursts of this duration or more are outages; by default a test decides.
        shares: shares of loss bursts and packets for which M is given.

    Raises:
        NoackError: a file cannot be read, or is not a trace.
    """
    trace = read_source([find_trace(str(source)) for source in sources])
    quantiles = QUANTILES if shares is None else tuple(shares)
    options = MeasurementOptions(deadline_s, quantiles, outage_s=outage_s)
    name = " ".join(str(Path(source)) for source in sources)
    return Measurement(trace, options, name, trace.notes)


class CampaignResult:
    """A finished campaign; :func:`noack.campaign` returns it."""

    def __init__(self, finished: "campaign_report.FinishedCampaign", temporary: Path | None = None) -> None:
        self._finished = finished
        if temporary is not None:
            weakref.finalize(self, shutil.rmtree, temporary, ignore_errors=True)

    @property
    def folder(self) -> Path:
        """The folder of the campaign, with its page and all runs."""
        return self._finished.store.folder

    @property
    def summary(self) -> dict[str, object]:
        """The results: ``summary.json``; ``docs/campaigns.md`` documents its keys."""
        return self._finished.summary.to_json()

    @property
    def breaches(self) -> int:
        """Number of runs in which a certified bound was exceeded: an error in noack."""
        return self._finished.summary.breaches

    def estimates(self) -> "pa.Table":
        """Return every metric at every grid point, a row each.

        Returns:
            The value of each axis, as text; ``metric``; ``mean`` with ``halfwidth``, half of its
            95 % confidence interval; quantiles ``q05``, ``q25``, ``median``, ``q75``, ``q95``;
            ``largest``; the number of ``draws``, and how many of them are ``finite``.
        """
        rows = [
            {**result.point.labels, "metric": str(metric), **estimate._asdict()}
            for result in self._finished.summary.results
            for metric, estimate in result.estimates.items()
        ]
        return _table(rows)

    def differences(self) -> "pa.Table":
        """Return the paired differences of every metric to the reference, draw by draw.

        Returns:
            As :meth:`estimates`, and the shares of the draws in which the metric is ``larger`` and
            ``smaller`` than at the reference. Without ``compare`` in the campaign it is empty.
        """
        rows = [
            {
                **compared.point.labels,
                "metric": str(metric),
                **difference.estimate._asdict(),
                "larger": difference.larger,
                "smaller": difference.smaller,
            }
            for compared in self._finished.summary.compared
            for metric, difference in compared.differences.items()
        ]
        return _table(rows)

    def draws(self, **axes: object) -> "pa.Table":
        """Return all metrics of the runs at a grid point, a row per draw.

        Args:
            axes: a value of each axis, as in the campaign: ``draws(policy="MB-ET", beta=0.5)``.

        Raises:
            NoackError: there is no such grid point.
        """
        labels = {name: campaign_file.label_of(value) for name, value in axes.items()}  # type: ignore[arg-type]
        points = [result.point for result in self._finished.summary.results]
        for point in points:
            if dict(point.labels) == labels:
                metrics, _ = campaign_summary.runs_at(point, self._finished.store)
                # importing pyarrow takes 0.1 s
                import pyarrow as pa

                return pa.table({str(name): values for name, values in metrics.items()})
        known = "; ".join(
            f"{axis.name} is one of {', '.join(axis.labels)}" for axis in self._finished.summary.campaign.axes
        )
        raise CallerError(f"no such grid point: {known}")

    def plot(self, figure: str | None = None) -> "Figure":
        """Draw a figure that the campaign asks for, by default its first one.

        Args:
            figure: its kind and number: ``"curve-2"``.

        Raises:
            NoackError: the campaign has no such figure.
        """
        known = []
        for description in campaign_figures.figures(self._finished.summary, self._finished.store):
            if figure in (None, description.name):
                return figure_drawing.draw(description)
            known.append(description.name)
        named = f'"{figure}": no such figure' if figure else "no figure"
        raise CallerError(f"{named} in this campaign; it has {', '.join(known) or 'none'}")

    def report(self) -> Path:
        """Return the path of the page with all tables and figures."""
        return self.folder / campaign_report.PAGE

    def _rows(self) -> TextRows:
        table = next(iter(campaign_report.campaign_tables(self._finished.summary)))
        return [(*table.headings,), *((*row,) for row in table.rows)]

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def campaign(
    source: str | PathLike[str] | Mapping[str, object],
    *,
    draws: int | None = None,
    folder: str | PathLike[str] | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> CampaignResult:
    """Run a scenario over a grid of settings, with many random draws at each point.

    >>> import noack
    >>> result = noack.campaign(
    ...     {
    ...         "name": "losses",
    ...         "scenario": "double_integrator",
    ...         "draws": 20,
    ...         "settings": {"horizon_s": 5.0},
    ...         "axes": [{"name": "loss", "key": "network.loss.probability", "values": [0.2, 0.8]}],
    ...     },
    ...     workers=1,
    ... )
    >>> result.estimates().column_names[:3]
    ['loss', 'metric', 'draws']
    >>> result.breaches
    0

    Args:
        source: the name of a shipped campaign (``"mb_vs_zoh"``), the path of a campaign file, or
            its content as a table; ``docs/campaigns.md`` documents the keys.
        draws: draws at each grid point; by default the campaign's.
        folder: where the runs are kept; an interrupted campaign in it is continued. Without it,
            a temporary folder, which exists as long as the result.
        workers: processes; by default one per core. With 1, this process computes. Others import
            the main program anew: a script needs ``if __name__ == "__main__":``.
        progress: show a progress line on standard error.

    Raises:
        NoackError: one line per mistake in the campaign; or it was interrupted.
    """
    if isinstance(source, Mapping):
        path = _TABLE
        plan = toml_file.validated(campaign_file.Campaign, plain_table(source), str(path))
    else:
        path = find_shipped(str(source), "campaigns")
        plan = campaign_file.load(path)
    temporary = None if folder is not None else Path(tempfile.mkdtemp(prefix="noack-"))
    start = partial(campaign_workers.local_runner, workers or cores())
    try:
        bar, runs_folder = _runs_bar() if progress else None, Path(folder or temporary or "")
        finished = campaign_report.finish_campaign(
            plan, path, runs_folder, start, draws=draws, show=lambda text: nullcontext(), bar=bar
        )
    except BaseException:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        raise
    return CampaignResult(finished, temporary)


def _runs_bar() -> "AbstractContextManager[Callable[[int, int], None]]":
    return progress_display.runs_bar(progress_display.PipeSafeConsole(file=sys.stderr))


def _table(rows: list[dict[str, object]]) -> "pa.Table":
    # importing pyarrow takes 0.1 s
    import pyarrow as pa

    return pa.Table.from_pylist(rows)


Result = Run | Certificates | MarginResult | MeanCost | CampaignResult


def save_tables(result: Result, folder: str | PathLike[str]) -> list[Path]:
    """Write the tables of a result, each as CSV, as ``--tables`` does.

    >>> import noack, tempfile
    >>> folder = tempfile.TemporaryDirectory()
    >>> files = noack.save_tables(noack.certify("lane_following"), folder.name)
    >>> [file.name for file in files]
    ['certificates.csv', 'limits.csv']
    >>> folder.cleanup()

    Args:
        result: a run, or what :func:`noack.certify`, :func:`noack.margin`,
            :func:`noack.cost` or :func:`noack.campaign` returned.
        folder: where the files are written; it is made if it does not exist.

    Returns:
        The paths.

    Raises:
        NoackError: it is another object, or a file cannot be written.
    """
    tables: Iterable[result_tables.ResultTable]
    match result:
        case Run():
            return result.save_tables(folder)
        case Certificates():
            tables = certificate_report.certificate_tables(result)
        case MarginResult():
            tables = certificate_report.margin_tables(result)
        case MeanCost():
            tables = certificate_report.mean_cost_tables(result)
        case CampaignResult():
            tables = campaign_report.campaign_tables(result._finished.summary)
        case _:
            raise CallerError(f"{type(result).__name__}: has no tables")
    return result_tables.save_tables(tables, Path(folder))
