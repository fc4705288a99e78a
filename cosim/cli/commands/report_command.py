"""``noack report``: a run's page of figures and tables."""

from cosim.cli import command as cli
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 90, [
    ("noack report", "the report of the last run"),
    ("noack report runs/latest --json", "print the path as JSON"),
])  # fmt: skip
def report(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    json: cli.JsonOption = False,
) -> int:
    """Write a run's report (one HTML page with all figures) and print its path."""
    from cosim.live.finalize import rewrite_report

    path = rewrite_report(chosen_run(run_dir, runs))
    if json:
        cli.print_json({"report": str(path)})
    else:
        print(path)
    return ExitStatus.OK
