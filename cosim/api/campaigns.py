"""Campaigns, and their results as tables and figures."""

import shutil
import sys
import tempfile
import weakref
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from os import PathLike
from pathlib import Path

import pyarrow as pa
from matplotlib.figure import Figure

from cosim.live.monitoring.progress import runs_bar
from cosim.shipped_files import find_shipped
from cosim.studies.campaign import campaign_figures, campaign_file, campaign_report, campaign_summary
from cosim.studies.campaign.campaign_report import FinishedCampaign
from cosim.studies.campaign.campaign_workers import local_runner, worker_count
from netem.core.console import SafeConsole
from netem.core.errors import CallerError
from netem.core.number_format import TextRows, as_html, as_text
from netem.core.toml_file import validated
from noack.core.progress import Progress
from noack.scenario.given_settings import plain_table

_TABLE = Path("campaign")
"""Stands for the file of a campaign that is given as a table."""


class CampaignResult:
    """A finished campaign; :func:`noack.campaign` returns it.

    >>> import noack
    >>> axis = {"name": "loss", "key": "network.loss.probability", "values": [0.2, 0.8]}
    >>> table = {"name": "losses", "scenario": "double_integrator", "draws": 5, "axes": [axis]}
    >>> result = noack.campaign(table | {"settings": {"horizon_s": 2.0}})
    >>> result.draws(loss=0.8).num_rows, result.breaches  # a row of each draw at a point of the grid
    (5, 0)
    """

    def __init__(self, finished: FinishedCampaign, temporary: Path | None = None) -> None:
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

    def estimates(self) -> pa.Table:
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

    def differences(self) -> pa.Table:
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

    def draws(self, **axes: object) -> pa.Table:
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
                return pa.table({str(name): values for name, values in metrics.items()})
        known = "; ".join(
            f"{axis.name} is one of {', '.join(axis.labels)}" for axis in self._finished.summary.campaign.axes
        )
        raise CallerError(f"no such grid point: {known}")

    def plot(self, figure: str | None = None) -> Figure:
        """Draw a figure that the campaign asks for, by default its first one.

        Args:
            figure: its kind and number: ``"curve-2"``.

        Raises:
            NoackError: the campaign has no such figure.
        """
        known = []
        for description in campaign_figures.figures(self._finished.summary, self._finished.store):
            if figure in (None, description.name):
                return description.draw()
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
        workers: processes, at most four per core; by default one per core. With 1, this process
            computes. Others import the main program anew: a script needs
            ``if __name__ == "__main__":``.
        progress: show a progress line on standard error.

    Raises:
        NoackError: one line per mistake in the campaign; or it was interrupted.
    """
    if isinstance(source, Mapping):
        path = _TABLE
        plan = validated(campaign_file.Campaign, plain_table(source), str(path))
    else:
        path = find_shipped(str(source), "campaigns")
        plan = campaign_file.load(path)
    start = partial(local_runner, worker_count(workers))
    temporary = None if folder is not None else Path(tempfile.mkdtemp(prefix="noack-"))
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


def _runs_bar() -> AbstractContextManager[Progress]:
    return runs_bar(SafeConsole(file=sys.stderr))


def _table(rows: list[dict[str, object]]) -> pa.Table:
    return pa.Table.from_pylist(rows)
