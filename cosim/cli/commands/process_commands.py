"""``noack record``, ``plant``, ``sensor``, ``controller``, ``netem``: one terminal per process."""

from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli.execute_run import RunOutput, run_processes
from noack.core.errors import CallerError

InvitationOption = Annotated[
    Path | None,
    Option(
        "--invitation",
        metavar="FILE",
        help="Join a run on another host, by the file that `noack record --listen` wrote.",
    ),
]


class Invited(StrEnum):
    """Whom an invitation is for."""

    ALL = "all"
    PLANT = "plant"
    SENSOR = "sensor"
    NETEM = "netem"
    CONTROLLER = "controller"


def _examples(role: str) -> list[tuple[str, str]]:
    return [
        (f"noack {role}", "join the run that `noack record` has opened"),
        (f"noack {role} --session two --json", "in another session; print its report as JSON"),
        (f"noack {role} --invitation invitation.json", "on another host"),
    ]


@cli.command(cli.PROCESSES, 10, [
    ("noack record lane_following", "then start the other four, in any order"),
    ("noack record lane_following --session two --live", "beside another run"),
    ("noack record lane_following --listen 192.0.2.1", "for processes on other hosts, too"),
])  # fmt: skip
def record(
    context: typer.Context,
    scenario: cli.ScenarioArgument,
    *,
    settings: cli.SetOption = None,
    session: cli.SessionOption = "default",
    runs: cli.RunsOption = cli.DEFAULT_RUNS,
    live: cli.LiveOption = False,
    metrics: cli.MetricsOption = None,
    _log_format: cli.LogFormatOption = cli.LogFormat.TEXT,
    listen: Annotated[str | None, Option(metavar="ADDRESS[:PORT]")] = None,
    invitation: Annotated[Path, Option(metavar="FILE")] = Path("invitation.json"),
    invite: Invited = Invited.ALL,
    valid_minutes: Annotated[float, Option(min=0.01, max=525_600)] = 60.0,
    report: cli.ReportOption = True,
    verbose: cli.VerboseOption = False,
    json: cli.JsonOption = False,
) -> int:
    """Open a run and record it; the other four processes join from other terminals or hosts.

    Options:
        listen: Let processes on other hosts join, at this address of this host.
        invitation: With --listen: where the invitation is written.
        invite: With --listen: which process the invitation is for.
        valid_minutes: With --listen: how long one can join by it.
    """
    from noack.protocol.topology import RECORDER

    output, listening = RunOutput(report, verbose, json), None
    if listen is None:
        _require_none_of(context, "invitation", "invite", "valid_minutes")
    else:
        from cosim.live.remote_access import Listening, listen_address

        role = None if invite is Invited.ALL else invite.value
        address = listen_address(listen)
        listening = Listening(address, invitation, role, 60 * valid_minutes)

    return run_processes(
        lambda: cli.load_scenario(scenario, settings), runs, output,
        spawn=(RECORDER,), session=session, live=live, server=context.obj,
        listening=listening, metrics=metrics,
    )  # fmt: skip


def _join(role: str, place: int, module: str, about: str) -> None:
    """Declare the command that joins the open run as a process."""

    def join(
        *,
        session: cli.SessionOption = "default",
        invitation: InvitationOption = None,
        runs: cli.RunsOption = cli.DEFAULT_RUNS,
        json: cli.JsonOption = False,
    ) -> int:
        invited = [] if invitation is None else ["--invitation", str(invitation)]
        chosen = [] if session == "default" and invited else ["--session", session]
        arguments = [*chosen, *invited, "--runs", str(runs), *(["--json"] if json else [])]
        status: int = import_module(module).main(arguments)
        return status

    join.__doc__ = f"Join the open run as the {role}: {about}"
    cli.command(cli.PROCESSES, place, _examples(role), name=role)(join)


_join("plant", 20, "plant_server.__main__", "integrates the state, sends measurements.")
_join("sensor", 30, "sensor_node.__main__", "runs x_s and the trigger, sends updates.")
_join("controller", 40, "controller_node.__main__", "runs x_c, sends u = K x_c.")


@cli.command(
    cli.PROCESSES, 50,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)  # fmt: skip
def netem(context: typer.Context) -> int:
    """Join the open run as the network; or relay any UDP program: `noack netem --help`."""
    from netem.__main__ import main

    return main(context.args)


def _require_none_of(context: typer.Context, *options: str) -> None:
    """Raise CallerError if one of the options that need ``--listen`` was given."""
    for option in options:
        source = context.get_parameter_source(option)
        if source is not None and source.name == "COMMANDLINE":
            name = "--" + option.replace("_", "-")
            raise CallerError(f"{name} needs --listen: processes of this host need no invitation")
