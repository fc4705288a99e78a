"""``noack report``: a run's page of figures and tables."""

from cosim.cli.command import RUNS, JsonOption, RunArgument, RunsOption, command, print_json
from cosim.record.run_directory import DEFAULT_RUNS, chosen_run
from noack.core.errors import ExitStatus


@command(RUNS, 90, [
    ("noack report", "of the last run"),
    ("noack report runs/latest --json", "print the path as JSON"),
])  # fmt: skip
def report(
    run_dir: RunArgument = None, *, runs: RunsOption = DEFAULT_RUNS, json: JsonOption = False
) -> int:
    """Write a run's report (one HTML page with all figures) and print its path."""
    from cosim.live.finalize import rewrite_report

    path = rewrite_report(chosen_run(run_dir, runs))
    if json:
        print_json({"report": str(path)})
    else:
        print(path)
    return ExitStatus.OK
