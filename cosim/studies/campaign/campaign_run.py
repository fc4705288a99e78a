"""Runs a campaign: what is missing in its folder is made; what is there stays."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from cosim.studies.campaign.campaign_workers import LostWorkersError, OtherArithmeticError, Runner
from cosim.studies.campaign.chunk_store import Store
from noack.core.errors import ExitStatus, MachineError, NoackError

Progress = Callable[[int, int], None]
"""Told how many runs are there, and of how many."""


class InterruptedCampaignError(NoackError):
    """A person wanted it to end; what is written stays."""

    exit_status = ExitStatus.INTERRUPTED


class TerminatedCampaignError(NoackError):
    """The system, or who runs it, wanted it to end; what is written stays."""

    exit_status = ExitStatus.TERMINATED


@contextmanager
def terminations_raised() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the work in good order, unless they are ignored.

    Raises:
        TerminatedCampaignError: one of them came.
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
    """Run what is missing; return how many runs that were.

    Args:
        store: the campaign's folder.
        runner: who runs the chunks.
        progress: is told how far the work is.

    Raises:
        InterruptedCampaignError: by Ctrl-C.
        TerminatedCampaignError: by a signal, where :func:`terminations_raised`.
        LostWorkersError: workers have died.
        MachineError: the results cannot be written.
    """
    missing = list(store.missing())
    total = len(store.points) * store.draws
    before = done = total - sum(len(chunk.draws) for chunk in missing)
    tell = progress or (lambda done, total: None)
    tell(done, total)

    def told(what: str) -> str:
        return (
            f"{what}; {done:,} of {total:,} runs are in {store.folder}, "
            "the same command goes on from there"
        )

    try:
        for chunk, rows in runner([point.work for point in store.points], missing):
            try:
                store.write(chunk, rows)
            except OSError as error:
                reason = error.strerror or str(error)
                raise MachineError(told(f"{store.folder}: cannot be written: {reason}")) from None
            done += len(chunk.draws)
            tell(done, total)
    except KeyboardInterrupt:
        raise InterruptedCampaignError(told("interrupted")) from None
    except (LostWorkersError, OtherArithmeticError, TerminatedCampaignError) as error:
        raise type(error)(told(str(error))) from None
    return total - before
