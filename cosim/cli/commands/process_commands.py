"""``noack record``, ``plant``, ``sensor``, ``controller``, ``netem``: one terminal per process."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import options as opt
from cosim.cli.options import PROCESSES, examples
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError
from noack.runtime.command_line import LogFormat

app = typer.Typer()


class Invited(StrEnum):
    """Whom an invitation is for."""

    ALL = "all"
    PLANT = "plant"
    SENSOR = "sensor"
    NETEM = "netem"
    CONTROLLER = "controller"


@app.command(
    rich_help_panel=PROCESSES,
    epilog=examples(
        ("noack record lane_following", "then start the other four, in any order"),
        ("noack record lane_following --session two --live", "beside another run"),
        ("noack record lane_following --listen 192.0.2.1", "for processes on other hosts, too"),
    ),
)
def record(
    context: typer.Context,
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
    invitation: Annotated[
        Path, Option(metavar="FILE", help="With --listen: where the invitation is written.")
    ] = Path("invitation.json"),
    invite: Annotated[
        Invited, Option(help="With --listen: which process the invitation is for.")
    ] = Invited.ALL,
    valid_minutes: Annotated[
        float, Option(min=0.01, max=525_600, help="With --listen: how long one can join by it.")
    ] = 60.0,
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
    from noack.protocol.roles import RECORDER

    listening = None
    if listen is None:
        _require_none_of(context, "invitation", "invite", "valid_minutes")
    else:
        from cosim.live.coordination.remote_access import ListenSettings, listen_address  # TLS

        role = None if invite is Invited.ALL else invite.value
        listening = ListenSettings(listen_address(listen), invitation, role, 60 * valid_minutes)
    loaded = opt.load_scenario(scenario, settings)
    return run_processes(
        loaded, runs, live=live, report=report, verbose=verbose, json=json,
        server=context.obj, spawn=(RECORDER,), session=session, listening=listening,
    )  # fmt: skip


def _require_none_of(context: typer.Context, *options: str) -> None:
    """Raise CallerError if one of the options that need ``--listen`` was given."""
    for option in options:
        source = context.get_parameter_source(option)
        if source is not None and source.name == "COMMANDLINE":
            name = "--" + option.replace("_", "-")
            raise CallerError(f"{name} needs --listen: processes of this host need no invitation")


JoinedSession = Annotated[str, opt.SESSION]
InvitationOption = Annotated[
    Path | None,
    Option(
        "--invitation",
        metavar="FILE",
        help="Join a run on another host, by the file that `noack record --listen` wrote.",
    ),
]


def _join_examples(role: str) -> str:
    return examples(
        (f"noack {role}", "join the run that `noack record` has opened"),
        (f"noack {role} --session two --json", "in another session; print its report as JSON"),
        (f"noack {role} --invitation invitation.json", "on another host"),
    )


def _arguments(session: str, invitation: Path | None, runs: Path, json: bool) -> list[str]:
    """Return the arguments of a process that joins the open run."""
    arguments = [] if invitation is None else ["--invitation", str(invitation)]
    if invitation is None or session != "default":
        arguments += ["--session", session]
    return [*arguments, "--runs", str(runs), *(["--json"] if json else [])]


@app.command(rich_help_panel=PROCESSES, epilog=_join_examples("plant"))
def plant(
    session: JoinedSession = "default",
    invitation: InvitationOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Join the open run as the plant: integrates the state, sends measurements."""
    opt.require_linux()
    from plant_server.__main__ import main

    return main(_arguments(session, invitation, runs, json))


@app.command(rich_help_panel=PROCESSES, epilog=_join_examples("sensor"))
def sensor(
    session: JoinedSession = "default",
    invitation: InvitationOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Join the open run as the sensor: runs x_s and the trigger, sends updates."""
    opt.require_linux()
    from sensor_node.__main__ import main

    return main(_arguments(session, invitation, runs, json))


@app.command(rich_help_panel=PROCESSES, epilog=_join_examples("controller"))
def controller(
    session: JoinedSession = "default",
    invitation: InvitationOption = None,
    runs: opt.RunsOption = DEFAULT_RUNS,
    json: opt.JsonOption = False,
) -> int:
    """Join the open run as the controller: runs x_c, sends u = K x_c."""
    opt.require_linux()
    from controller_node.__main__ import main

    return main(_arguments(session, invitation, runs, json))


@app.command(
    rich_help_panel=PROCESSES,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)
def netem(context: typer.Context) -> int:
    """Join the open run as the network; or relay any UDP program: `noack netem --help`."""
    opt.require_linux()
    from netem.__main__ import main

    # typer removes the first `--`, which begins the command of a shell.
    return main(sys.argv[2:] if "--" in sys.argv else context.args)
