"""The tables of all results as files."""

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from cosim.analysis.certificates import Certificates
from cosim.analysis.margin_search import MarginResult
from cosim.analysis.mean_cost import MeanCost
from cosim.api.campaigns import CampaignResult
from cosim.api.runs import Run
from cosim.output import certificate_report
from cosim.output.table_files import save_tables as save_result_tables
from cosim.studies.campaign.campaign_report import campaign_tables
from netem.core.errors import CallerError
from netem.output.result_tables import ResultTable

Result = Run | Certificates | MarginResult | MeanCost | CampaignResult


def save_tables(result: Result, folder: str | PathLike[str]) -> list[Path]:
    """Write the tables of a result, each as CSV, as ``--tables`` does.

    >>> import noack, tempfile
    >>> folder = tempfile.TemporaryDirectory()
    >>> files = noack.save_tables(noack.certify("lane_following", search=False), folder.name)
    >>> [file.name for file in files]
    ['certificates.csv']
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
    tables: Iterable[ResultTable]
    match result:
        case Run():
            return result.save_tables(folder)
        case Certificates():
            tables = filter(None, [certificate_report.certificate_table(result)])
        case MarginResult():
            tables = certificate_report.margin_tables(result)
        case MeanCost():
            tables = certificate_report.mean_cost_tables(result)
        case CampaignResult():
            tables = campaign_tables(result._finished.summary)
        case _:
            raise CallerError(f"{type(result).__name__}: has no tables")
    return save_result_tables(tables, Path(folder))
