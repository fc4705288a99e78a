"""A live run of the page, as a process of its own: so the page never disturbs the loop.

It reads the scenario's text from standard input, until its end. It writes one JSON object per line
on standard output: what happened, with its fields.
"""

import json
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

from cosim.interactive.draft import Draft
from cosim.live.launcher import Watcher, launch
from noack.core.errors import ExitStatus, NoackError


def main() -> int:
    """Run a scenario; the arguments are the folder of the files that it names, and of the runs."""
    folder, runs = map(Path, sys.argv[1:3])
    watcher = Watcher(
        started=lambda run_dir: _say("started", run_dir=str(run_dir)),
        failed=lambda why, t_s, by_hand: _say("failed", why=why, t_s=t_s),
        restarted=lambda role, t_s: _say("restarted", role=role, t_s=t_s),
        progress=lambda report: _say("progress", **report),
    )
    try:
        draft = Draft("scenario", folder, "", sys.stdin.buffer.read().decode())
        ending = launch(draft.scenario, runs, live=True, watcher=watcher)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a stop now must not cost the summary
        _say("finalising", reason=ending.reason)
        from cosim.live.finalize import finalize
        from cosim.output.run_verdict import verdict

        outcome = finalize(ending, report=False)
    except NoackError as error:
        _say("error", text=str(error))
        return error.exit_status
    _say(
        "ended", run_dir=str(outcome.run_dir), reason=outcome.reason,
        ok=outcome.status is ExitStatus.OK, verdict=verdict(outcome.summary),
    )  # fmt: skip
    return outcome.status


def _say(what: str, **fields: Any) -> None:
    with suppress(BrokenPipeError):  # the page has ended; the run is recorded all the same
        print(json.dumps({"what": what, **fields}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
