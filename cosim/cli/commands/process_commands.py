"""``noack record``, ``plant``, ``sensor``, ``controller``, ``netem``: by terminal."""

import sys
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from cosim.cli import command as cli
from cosim.cli import options as opt
from cosim.cli.execute_run import LiveOptions, run_processes
from cosim.lazy_modules import lazy_modules
from cosim.record.run_directory import DEFAULT_RUNS
from noack.core.errors import CallerError

with lazy_modules():
    from cosim.live.coordination import remote_access
    from netem import __main__ as emulator
    from noack.protocol import roles

SessionOption = Annotated[str, opt.SESSION]


class Invited(StrEnum):
    """Whom an invitation is for."""

    ALL = "all"
    PLANT = "plant"
    SENSOR = "sensor"
    NETEM = "netem"
    CONTROLLER = "controller"


@cli.command(cli.PROCESSES, 10, on_linux=True)
def record(
    context: typer.Context,
    source: opt.ScenarioOptions,
    *,
    session: SessionOption = "default",
    listen: Annotated[str | None, Option(metavar="ADDRESS[:PORT]")] = None,
    invitation: Annotated[Path, Option(metavar="FILE")] = Path("invitation.json"),
    invite: Invited = Invited.ALL,
    valid_minutes: Annotated[float, Option(min=0.01, max=525_600)] = 60.0,
    options: LiveOptions,
) -> int:
    """Open a run and record it; the other four processes join from other terminals or hosts.

    Options:
        listen: Let processes on other hosts join, at this address of this host.
        invitation: With --listen: where the invitation is written.
        invite: With --listen: which process the invitation is for.
        valid_minutes: With --listen: how long one can join by it.

    Examples:
        noack record lane_following   then start the other four, in any order
        noack record lane_following --session two --live   beside another run
        noack record lane_following --listen 192.0.2.1   for processes on other hosts, too
    """
    listening = None
    if listen is None:
        _require_none_of(context, "invitation", "invite", "valid_minutes")
    else:
        role = None if invite is Invited.ALL else invite.value
        address = remote_access.listen_address(listen)
        listening = remote_access.ListenSettings(address, invitation, role, 60 * valid_minutes)
    return run_processes(
        source.load(),
        options,
        spawn=(roles.RECORDER,),
        session=session,
        server=context.obj,
        listening=listening,
    )


@opt.option_group
class JoinOptions:
    """How a process joins the open run.

    Options:
        invitation: Join a run on another host, by the file that `noack record --listen` wrote.
    """

    session: SessionOption = "default"
    invitation: Annotated[Path | None, Option("--invitation", metavar="FILE")] = None
    runs: opt.RunsOption = DEFAULT_RUNS
    json: opt.JsonOption = False


def _join(role: str, position: int, module: str, about: str) -> None:
    """Declare the command that joins the open run as a process."""

    def join(options: JoinOptions) -> int:
        by_file = options.invitation is not None
        arguments = ["--invitation", str(options.invitation)] if by_file else []
        if not by_file or options.session != "default":
            arguments += ["--session", options.session]
        arguments += ["--runs", str(options.runs), *(["--json"] if options.json else [])]
        status: int = import_module(module).main(arguments)
        return status

    join.__doc__ = f"""Join the open run as the {role}: {about}

    Examples:
        noack {role}   join the run that `noack record` has opened
        noack {role} --session two --json   in another session; print its report as JSON
        noack {role} --invitation invitation.json   on another host
    """
    cli.command(cli.PROCESSES, position, on_linux=True, name=role)(join)


_join("plant", 20, "plant_server.__main__", "integrates the state, sends measurements.")
_join("sensor", 30, "sensor_node.__main__", "runs x_s and the trigger, sends updates.")
_join("controller", 40, "controller_node.__main__", "runs x_c, sends u = K x_c.")


@cli.command(
    cli.PROCESSES,
    50,
    on_linux=True,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    add_help_option=False,
)
def netem(context: typer.Context) -> int:
    """Join the open run as the network; or relay any UDP program: `noack netem --help`."""
    # typer removes the first `--`, which begins the command of a shell.
    return emulator.main(sys.argv[2:] if "--" in sys.argv else context.args)


def _require_none_of(context: typer.Context, *options: str) -> None:
    """Raise CallerError if one of the options that need ``--listen`` was given."""
    for option in options:
        source = context.get_parameter_source(option)
        if source is not None and source.name == "COMMANDLINE":
            name = "--" + option.replace("_", "-")
            raise CallerError(f"{name} needs --listen: processes of this host need no invitation")
