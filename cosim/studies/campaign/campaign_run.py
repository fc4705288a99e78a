"""Runs a campaign: computes the runs that its folder does not have yet."""

from collections.abc import Callable

from cosim.studies.campaign.campaign_workers import LostWorkersError, OtherArithmeticError, Runner
from cosim.studies.campaign.chunk_store import Store
from noack.core.errors import ExitStatus, MachineError, NoackError

Progress = Callable[[int, int], None]
"""Called with the number of finished runs and the number of all runs."""


class InterruptedCampaignError(NoackError):
    """A user or a signal interrupted the campaign; written runs are kept."""

    def __init__(self, message: str, exit_status: ExitStatus) -> None:
        super().__init__(message)
        self.exit_status = exit_status


def run_campaign(store: Store, runner: Runner, progress: Progress | None = None) -> int:
    """Compute the missing runs; return their number.

    Raises:
        InterruptedCampaignError: a signal was received.
        LostWorkersError: workers have died.
        MachineError: the results cannot be written.
    """
    missing = list(store.missing())
    total = len(store.points) * store.draws
    before = done = total - sum(len(chunk.draws) for chunk in missing)
    report = progress or (lambda done, total: None)
    report(done, total)

    def message(what: object) -> str:
        return (
            f"{what}; {done:,} of {total:,} runs are in {store.folder}; "
            "the same command continues the campaign"
        )

    try:
        for chunk, rows in runner([point.work for point in store.points], missing):
            store.write(chunk, rows)
            done += len(chunk.draws)
            report(done, total)
    except KeyboardInterrupt as error:
        status = getattr(error, "exit_status", ExitStatus.INTERRUPTED)
        raise InterruptedCampaignError(message(str(error) or "interrupted"), status) from None
    except (LostWorkersError, OtherArithmeticError, MachineError) as error:
        raise type(error)(message(error)) from None
    return total - before
