"""Runs a campaign: computes the runs that its folder does not have yet."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from cosim.studies.campaign.campaign_workers import LostWorkersError, OtherArithmeticError, Runner
from cosim.studies.campaign.chunk_store import Store
from noack.core.errors import ExitStatus, MachineError, NoackError

Progress = Callable[[int, int], None]
"""Called with the number of finished runs and the number of all runs."""


class InterruptedCampaignError(NoackError):
    """A user interrupted the campaign; written runs are kept."""

    exit_status = ExitStatus.INTERRUPTED


class TerminatedCampaignError(NoackError):
    """A signal ended the campaign; written runs are kept."""

    exit_status = ExitStatus.TERMINATED


@contextmanager
def terminations_raised() -> Iterator[None]:
    """Raise an exception on SIGTERM and SIGHUP, unless they are ignored.

    Raises:
        TerminatedCampaignError: one of them was received.
    """

    def terminated(number: int, _: FrameType | None) -> None:
        raise TerminatedCampaignError(f"ended by {signal.Signals(number).name}")

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    for number, handler in before.items():
        if handler is signal.SIG_DFL:
            signal.signal(number, terminated)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_campaign(store: Store, runner: Runner, progress: Progress | None = None) -> int:
    """Compute the missing runs; return their number.

    Raises:
        InterruptedCampaignError: the user pressed Ctrl-C.
        TerminatedCampaignError: a signal was received within :func:`terminations_raised`.
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
    except KeyboardInterrupt:
        raise InterruptedCampaignError(message("interrupted")) from None
    except (LostWorkersError, OtherArithmeticError, TerminatedCampaignError, MachineError) as error:
        raise type(error)(message(error)) from None
    return total - before
