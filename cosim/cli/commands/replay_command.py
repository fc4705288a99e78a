"""``noack replay``: repeats a run's recorded inputs and compares the outputs."""

from cosim.cli import command as cli
from cosim.record.run_directory import chosen_run
from noack.core.errors import ExitStatus


@cli.command(cli.RUNS, 70, [
    ("noack replay", "the last run; exit status 1 if a bit differs"),
    ("noack replay runs/latest --json", "as JSON"),
])  # fmt: skip
def replay(
    run_dir: cli.RunArgument = None,
    *,
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    loop: cli.LoopOption = None,
    json: cli.JsonOption = False,
) -> int:
    """Replay a run's recorded inputs; compare the outputs bit for bit."""
    from cosim.analysis.replay.replay_result import print_replay
    from cosim.analysis.replay.run_replay import replay_run
    from cosim.live.progress import PatientConsole
    from cosim.record.run_directory import changed_since
    from cosim.record.run_record import load_run

    path = chosen_run(run_dir, runs)
    with PatientConsole(stderr=True).status("replaying"):
        found = replay_run(load_run(path), loop)
    changed = changed_since(path)
    if json:
        cli.print_json(found.document() | {"changed_since": changed})
    else:
        print_replay(cli.console(), found, changed)
    return ExitStatus.OK if found.bit_exact else ExitStatus.FAILED
