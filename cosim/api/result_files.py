"""The tables of results as files."""

from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.analysis.margin_search import MarginResult
from cosim.api.campaigns import CampaignResult
from cosim.api.runs import Run
from cosim.output.all_certificates import Certificates
from noack.core.errors import CallerError

if TYPE_CHECKING:
    from cosim.output.result_tables import ResultTable

Result = Run | Certificates | MarginResult | CampaignResult


def save_tables(result: Result, folder: str | PathLike[str]) -> list[Path]:
    """Write the tables of a result, each as LaTeX (booktabs) and as CSV, as ``--tables`` does.

    >>> import noack, tempfile
    >>> folder = tempfile.TemporaryDirectory()
    >>> files = noack.save_tables(noack.certify("lane_following"), folder.name)
    >>> [file.name for file in files]
    ['certificates.tex', 'certificates.csv', 'limits.tex', 'limits.csv']
    >>> folder.cleanup()

    Args:
        result: a run, or what :func:`noack.certify`, :func:`noack.margin` or
            :func:`noack.campaign` returned.
        folder: where the files are written; it is made if it does not exist.

    Returns:
        The paths.

    Raises:
        NoackError: it is another object, or a file cannot be written.
    """
    from cosim.output.result_tables import save_tables as save

    return save(_tables(result), Path(folder))


def _tables(result: Result) -> "Iterable[ResultTable]":
    """Return the tables that the command of such a result prints."""
    match result:
        case Run():
            from cosim.output.run_result_tables import summary_tables

            return summary_tables(result.summary)
        case Certificates():
            from cosim.output.certificate_report import certificate_tables

            return certificate_tables(result)
        case MarginResult():
            from cosim.output.margin_report import margin_tables

            return margin_tables(result)
        case CampaignResult():
            from cosim.studies.campaign.campaign_report import campaign_tables

            return campaign_tables(result._finished.summary)
    raise CallerError(f"{type(result).__name__}: has no tables")
