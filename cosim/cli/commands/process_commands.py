"""``noack record``, ``plant``, ``sensor``, ``controller``, ``netem``: one terminal per process."""

import sys
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import options as opt
from cosim.cli.options import PROCESSES, examples
from cosim.record.run_directory import DEFAULT_RUNS
from netem.core.command_line import LogFormat
from netem.core.errors import CallerError

app = typer.Typer()


@app.command(
    rich_help_panel=PROCESSES,
    epilog=examples(
        ("noack record lane_following", "then start the other four, in any order"),
        ("noack record lane_following --session two --live", "beside another run"),
        ("noack record lane_following --listen 192.0.2.1", "for processes on other hosts, too"),
    ),
)
def record(
    scenario: opt.ScenarioArgument,
    settings: opt.SetOption = None,
    session: Annotated[str, opt.SESSION] = "default",
    listen: Annotated[
        str | None,
        Option(
            metavar="ADDRESS[:PORT]",
            help="Let processes on other hosts join, at this address of this host.",
        ),
    ] = None,
    credentials: Annotated[
        Path | None,
        Option(
            metavar="FOLDER",
            help="With --listen: folder for what these processes need, by role; by default credentials.",
        ),
    ] = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    live: opt.LiveOption = False,
    log_format: opt.LogFormatOption = LogFormat.TEXT,
    report: opt.ReportOption = True,
    verbose: opt.VerboseOption = False,
    json: opt.JsonOption = False,
) -> int:
    """Open a run and record it; the other four processes join from other terminals or hosts."""
    opt.require_linux()
    from cosim.cli.execute_run import run_processes
    from cosim.live.coordination.remote_access import ListenSettings, listen_address
    from noack.protocol.roles import RECORDER

    listening = None
    if listen is not None:
        folder = Path("credentials") if credentials is None else credentials
        listening = ListenSettings(listen_address(listen), folder)
    elif credentials is not None:
        raise CallerError("--credentials needs --listen: processes of this host need no credentials")
    loaded = opt.load_scenario(scenario, settings)
    return run_processes(
        loaded, runs, live=live, report=report, verbose=verbose, json=json,
        spawn=(RECORDER,), session=session, listening=listening,
    )  # fmt: skip


JoinedSession = Annotated[str, opt.SESSION]
CredentialsOption = Annotated[
    Path | None,
    Option(
        "--credentials",
        metavar="FOLDER",
        help="Join a run on another host, by this role's folder of `noack record --listen`.",
    ),
]


def _join_examples(role: str) -> str:
    return examples(
        (f"noack {role}", "join the run that `noack record` has opened"),
        (f"noack {role} --session two --json", "in another session; print its report as JSON"),
        (f"noack {role} --credentials {role}", "on another host"),
    )


def _arguments(session: str, credentials: Path | None, runs: Path, json: bool) -> list[str]:
    """Return the arguments of a process that joins the open run."""
    arguments = [] if credentials is None else ["--credentials", str(credentials)]
    if credentials is None or session != "default":
        arguments += ["--session", session]
    return [*arguments, "--runs", str(runs), *(["--json"] if json else [])]


@app.command(rich_help_panel=PROCESSES, epilog=_join_examples("plant"))
def plant(
    session: JoinedSession = "default",
    credentials: CredentialsOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Join the open run as the plant: integrates the state, sends measurements."""
    opt.require_linux()
    from plant_server.__main__ import main

    return main(_arguments(session, credentials, runs, json))


@app.command(rich_help_panel=PROCESSES, epilog=_join_examples("sensor"))
def sensor(
    session: JoinedSession = "default",
    credentials: CredentialsOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Join the open run as the sensor: runs x_s and the trigger, sends updates."""
    opt.require_linux()
    from sensor_node.__main__ import main

    return main(_arguments(session, credentials, runs, json))


@app.command(rich_help_panel=PROCESSES, epilog=_join_examples("controller"))
def controller(
    session: JoinedSession = "default",
    credentials: CredentialsOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Join the open run as the controller: runs x_c, sends u = K x_c."""
    opt.require_linux()
    from controller_node.__main__ import main

    return main(_arguments(session, credentials, runs, json))


@app.command(
    rich_help_panel=PROCESSES,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)
def netem(context: typer.Context) -> int:
    """Join the open run as the network; or relay any UDP program: `noack netem --help`."""
    opt.require_linux()
    from noack.network_process.__main__ import main

    # typer removes the first `--`, which begins the command of a shell.
    return main(sys.argv[2:] if "--" in sys.argv else context.args)
