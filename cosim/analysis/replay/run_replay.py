"""The replay of a run: its network, and each of its loops."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from cosim.analysis.replay.machine_replay import MachineReplay, SharedMachines
from cosim.analysis.replay.message_comparison import MessageComparison
from cosim.analysis.replay.replay_result import MessagesReplay, ProcessReplay, Replay
from cosim.analysis.summary_model import ReplayDifference, ReplayPart
from cosim.record.run_record import RecordedRun, RunRecord, load_run
from noack.protocol.topology import LOOP_ROLES

Result = TypeVar("Result", ProcessReplay, MessagesReplay)


def replay(record: RunRecord, shared: SharedMachines | None = None) -> Replay:
    """Replay a run and compare it with its record; a process is replayed up to its first gap.

    ``shared`` has the machines of several loops, if they are replayed in turn.

    In a run of several loops, the network is replayed once, for all of them: ``record`` is that of
    the network, or that of a loop, whose network is not replayed. The record is read part by part,
    so that memory does not grow with the length of the run.
    """
    shared = shared or SharedMachines(())
    machines = {role: MachineReplay(role, record, shared) for role in record.roles}
    messages = MessageComparison(record, machines) if "sensor" in machines else None
    with np.errstate(all="ignore"):  # a diverging run overflows and is replayed all the same
        for part in record.slices():
            for machine in machines.values():
                machine.take(part)
            if messages is not None:
                messages.take(part)
    results = tuple(result for one in machines.values() for result in one.results)
    return Replay(processes=results, messages=() if messages is None else messages.results())


def replay_run(run: RecordedRun, loop: str | None = None) -> Replay:
    """Replay a run, or one of its loops; each process's and link's results are added up.

    Raises:
        CallerError: there is no such loop.
    """
    if loop is not None or len(run.loops) == 1:
        return replay(run.loop(loop))
    found = [replay(run.network), *map(replay, run.loops)]
    # A restarted process has a result of its own.
    processes = _by_name((one.process, one) for each in found for one in each.processes)
    messages = _by_name((one.leg, one) for each in found for one in each.messages)
    return Replay(
        processes=tuple(
            _process(processes[name])
            for name in sorted(processes, key=lambda name: LOOP_ROLES.index(name.split()[0]))
        ),
        messages=tuple(map(_leg, messages.values())),
    )


def _by_name(named: Iterable[tuple[str, Result]]) -> dict[str, list[Result]]:
    found: dict[str, list[Result]] = {}
    for name, one in named:
        found.setdefault(name, []).append(one)
    return found


def stored_verdict(run_dir: Path) -> ReplayPart:
    """Replay the only loop of a run directory; return the result for its summary."""
    return replay(load_run(run_dir).loop()).verdict()


def _process(found: Sequence[ProcessReplay]) -> ProcessReplay:
    missing = (one.missing_from for one in found if one.missing_from is not None)
    return ProcessReplay(
        process=found[0].process,
        inputs=sum(one.inputs for one in found),
        compared=sum(one.compared for one in found),
        missing_from=next(missing, None),
        end_known=all(one.end_known for one in found),
        difference=_first(one.difference for one in found),
    )


def _leg(found: Sequence[MessagesReplay]) -> MessagesReplay:
    return MessagesReplay(
        leg=found[0].leg,
        received=sum(one.received for one in found),
        compared=sum(one.compared for one in found),
        difference=_first(one.difference for one in found),
    )


def _first(differences: Iterable[ReplayDifference | None]) -> ReplayDifference | None:
    return min(filter(None, differences), key=lambda one: one.now_ns, default=None)
