"""Campaigns: a scenario over a grid of settings, with many random draws at each point."""

import shutil
import sys
import tempfile
import weakref
from collections.abc import Mapping
from contextlib import nullcontext
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError
from noack.core.number_format import Rows, as_html, as_text
from noack.core.process_limits import cores

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

    from cosim.studies.campaign.finished_campaign import FinishedCampaign

_TABLE = Path("campaign")
"""Stands for the file of a campaign that is given as a table."""


class CampaignResult:
    """A finished campaign; :func:`noack.campaign` returns it."""

    def __init__(self, finished: "FinishedCampaign", temporary: Path | None = None) -> None:
        self._finished = finished
        if temporary is not None:
            weakref.finalize(self, shutil.rmtree, temporary, ignore_errors=True)

    @property
    def folder(self) -> Path:
        """The folder of the campaign, with its page and all runs."""
        return self._finished.store.folder

    @property
    def summary(self) -> dict[str, Any]:
        """The results: ``summary.json``; ``docs/campaigns.md`` documents its keys."""
        return self._finished.summary.document()

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
            {**found.point.labels, "metric": str(metric), **one._asdict()}
            for found in self._finished.summary.found
            for metric, one in found.estimates.items()
        ]
        return _table(rows)

    def differences(self) -> "pa.Table":
        """Return the paired differences of every metric to the reference, draw by draw.

        Returns:
            As :meth:`estimates`, and the shares of the draws in which the metric is ``larger`` and
            ``smaller`` than at the reference. Without ``compare`` in the campaign it is empty.
        """
        rows = [
            {**one.point.labels, "metric": str(metric), **found.estimate._asdict(),
             "larger": found.larger, "smaller": found.smaller}
            for one in self._finished.summary.compared
            for metric, found in one.differences.items()
        ]  # fmt: skip
        return _table(rows)

    def draws(self, **axes: object) -> "pa.Table":
        """Return all metrics of the runs at a grid point, a row per draw.

        Args:
            axes: a value of each axis, as in the campaign: ``draws(policy="MB-ET", beta=0.5)``.

        Raises:
            NoackError: there is no such grid point.
        """
        import pyarrow as pa

        from cosim.studies.campaign.campaign_file import label_of
        from cosim.studies.campaign.campaign_summary import runs_at

        wanted = {name: label_of(value) for name, value in axes.items()}  # type: ignore[arg-type]
        points = [one.point for one in self._finished.summary.found]
        for point in points:
            if dict(point.labels) == wanted:
                metrics, _ = runs_at(point, self._finished.store)
                return pa.table({str(name): values for name, values in metrics.items()})
        known = "; ".join(
            f"{axis.name} is one of {', '.join(axis.labels)}"
            for axis in self._finished.summary.campaign.axes
        )
        raise CallerError(f"no such grid point: {known}")

    def plot(self, figure: str | None = None) -> "Figure":
        """Draw a figure that the campaign asks for, by default its first one.

        Args:
            figure: its kind and number: ``"curve-2"``.

        Raises:
            NoackError: the campaign has no such figure.
        """
        from cosim.studies.campaign.campaign_figures import figures

        drawn = {}
        for name, one, _ in figures(self._finished.summary, self._finished.store):
            if figure in (None, name):
                return one
            drawn[name] = one
        named = f'"{figure}": no such figure' if figure else "no figure"
        raise CallerError(f"{named} in this campaign; it has {', '.join(drawn) or 'none'}")

    def report(self) -> Path:
        """Return the path of the page with all tables and figures."""
        from cosim.studies.campaign.campaign_report import PAGE

        return self.folder / PAGE

    def _rows(self) -> Rows:
        from cosim.studies.campaign.campaign_report import campaign_tables

        table = next(iter(campaign_tables(self._finished.summary)))
        return [(*table.headings,), *((*row,) for row in table.rows)]

    def __repr__(self) -> str:
        return as_text(self._rows())

    def _repr_html_(self) -> str:
        return as_html(self._rows())


def campaign(
    source: str | PathLike[str] | Mapping[str, Any],
    *,
    draws: int | None = None,
    folder: str | PathLike[str] | None = None,
    workers: int | None = None,
    progress: bool = False,
) -> CampaignResult:
    """Run a scenario over a grid of settings, with many random draws at each point.

    >>> import noack
    >>> found = noack.campaign(
    ...     {
    ...         "name": "losses",
    ...         "scenario": "double_integrator",
    ...         "draws": 20,
    ...         "settings": {"horizon_s": 5.0},
    ...         "axes": [{"name": "loss", "key": "network.loss.probability", "values": [0.2, 0.8]}],
    ...     },
    ...     workers=1,
    ... )
    >>> found.estimates().column_names[:3]
    ['loss', 'metric', 'draws']
    >>> found.breaches
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
    from cosim.studies.campaign.campaign_file import Campaign, load
    from cosim.studies.campaign.campaign_workers import local
    from cosim.studies.campaign.finished_campaign import finish_campaign
    from noack.config import toml_file

    if isinstance(source, Mapping):
        path = _TABLE
        plan = toml_file.validated(Campaign, source, str(path))
    else:
        path = find_shipped(str(source), "campaigns")
        plan = load(path)
    temporary = None if folder is not None else Path(tempfile.mkdtemp(prefix="noack-"))
    bar = None
    if progress:
        from cosim.live.progress import PatientConsole, runs_bar

        bar = runs_bar(PatientConsole(file=sys.stderr))
    start = partial(local, workers or cores())
    try:
        finished = finish_campaign(
            plan, path, Path(folder or temporary or ""), start, draws=draws,
            show=lambda text: nullcontext(), bar=bar,
        )  # fmt: skip
    except BaseException:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
        raise
    return CampaignResult(finished, temporary)


def _table(rows: list[dict[str, Any]]) -> "pa.Table":
    import pyarrow as pa

    return pa.Table.from_pylist(rows)
