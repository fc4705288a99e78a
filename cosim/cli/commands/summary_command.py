"""``noack summary``: the verdict and the tables of an earlier run."""

from cosim.cli import command as cli
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 50, [
    ("noack summary", "the last run"),
    ("noack summary --verbose", "with timing, assumptions and each claim"),
    ("noack summary --tables tables", "its tables for a paper, as LaTeX and CSV"),
    ("noack summary runs/latest --json", "all numbers, as JSON"),
])  # fmt: skip
def summary(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    verbose: cli.VerboseOption = False,
    tables: cli.TablesOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Show a run's summary; finalise an interrupted run first.

    Exit status 0: the summary was shown, also that of a failed run.
    """
    from cosim.analysis.run_summary import outcome_of_loop
    from cosim.live.finalize import reopen
    from cosim.output.run_tables import summary_tables
    from cosim.output.run_verdict import print_outcome

    outcome = outcome_of_loop(reopen(chosen_run(run_dir, runs)), loop)
    if json:
        cli.print_json(outcome.summary.to_json())
    else:
        print_outcome(cli.console(), outcome, verbose=verbose)
    cli.write_tables(summary_tables(outcome.summary), tables, json=json)
    return ExitStatus.OK
