"""Commands on a running emulator: ``noack netem show``, ``set`` and ``watch``."""

import argparse
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.console import Console

from netem.control.control_client import Client
from netem.control.emulator_session import Session, find, running
from netem.control.live_screen import JsonLines, Screen
from netem.control.statistics_history import History
from netem.control.statistics_view import render
from netem.engine.relay_interface import DIRECTIONS
from netem.words.words_to_settings import require_no_dashes, settings_of
from noack.core.errors import CallerError, ExitStatus, NoackError, PeerError
from noack.impairments.link_settings import LinkSettings, read_files
from noack.runtime.command_line import Parser, failed
from noack.runtime.signals import Signals

_HELP = "name of the emulator, from its --control; may be left out if only one runs"


def main(arguments: Sequence[str]) -> ExitStatus:
    """Run a command; the first argument is one of :data:`COMMANDS`."""
    command, *rest = arguments
    try:
        return COMMANDS[command](rest)
    except NoackError as error:
        who, as_json = f"noack netem {command}", "--json" in rest
        return failed(str(error), error.exit_status, who=who, as_json=as_json)
    except BrokenPipeError:  # who reads has seen enough
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)
        return ExitStatus.OK


def _parser(command: str, description: str, examples: Sequence[str], **more: Any) -> Parser:
    return Parser(
        prog=f"noack netem {command}",
        description=description,
        epilog="\n  ".join(["examples:", *examples]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **more,
    )


def _show(arguments: Sequence[str]) -> ExitStatus:
    parser = _parser(
        "show",
        "Show what has happened in a running emulator.",
        ("noack netem show", "noack netem show dns --json"),
    )
    parser.add_argument("name", nargs="?", help=_HELP)
    parser.add_argument("--json", action="store_true", help="print one JSON document")
    options = parser.parse_args(arguments)
    session = find(options.name)
    with Client(session) as client:
        statistics = client.ask("report")
    if options.json:
        print(json.dumps(statistics, indent=2), flush=True)
    else:
        history = History()
        history.add(statistics)
        console = _Console()
        console.print(render(history, _title(session), console.width, None))
    return ExitStatus.OK


def _set(arguments: Sequence[str]) -> ExitStatus:
    parser = _parser(
        "set",
        "Change what a link of a running emulator does. As with `tc qdisc change`, the words\n"
        "replace all that the direction did, its cap too.",
        ("noack netem set loss 10% mansd 4", "noack netem set dns --direction both delay 20ms 5ms"),
        usage="%(prog)s [NAME] [--link LINK] [--direction forward|back|both] WORDS ...",
    )
    parser.add_argument("words", nargs="*", metavar="[NAME] WORDS", help="e.g. loss 5%% mansd 4")
    parser.add_argument("--link", help="may be left out if there is only one")
    parser.add_argument(
        "--direction", choices=(*DIRECTIONS, "both"), default="forward", help="default: forward"
    )
    parser.add_argument("--json", action="store_true", help="print the links' settings as JSON")
    require_no_dashes(arguments)
    options = parser.parse_intermixed_args(arguments)
    name, settings = _name_and_settings(options.words)
    settings = read_files(settings, Path())
    session = find(name)
    with Client(session) as client:
        before = client.ask("settings")
        answer = client.ask(
            "change",
            link=options.link,
            direction=options.direction,
            settings=settings.model_dump(mode="json"),
        )
    if options.json:
        print(json.dumps(answer, indent=2), flush=True)
        return ExitStatus.OK
    for link in answer["links"]:
        for direction in DIRECTIONS:
            words_now = link[direction]["words"] or "nothing is done"
            print(f"{link['name']} {direction}: {words_now}", flush=True)
    _tell_lost_caps(before["links"], answer["links"])
    return ExitStatus.OK


def _tell_lost_caps(
    before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]
) -> None:
    for old, new in zip(before, after, strict=True):
        for direction in DIRECTIONS:
            cap = old[direction]["settings"]["mansd"]
            if cap is not None and new[direction]["settings"]["mansd"] is None:
                print(
                    f"noack netem set: {new['name']} {direction} has no cap any more, it had "
                    f"mansd {cap}; the words replace all that was said before",
                    file=sys.stderr, flush=True,
                )  # fmt: skip


def _name_and_settings(words: Sequence[str]) -> tuple[str | None, LinkSettings]:
    """Tell the emulator's name, if the words begin with it, from what it shall do."""
    name, rest = None, words
    if words and words[0] in running():
        name, rest = words[0], words[1:]
    if not rest:
        raise CallerError("say what the link shall do, e.g. loss 5% mansd 4; or: loss none")
    try:
        return name, settings_of(rest)
    except CallerError:
        if name is None:
            with suppress(CallerError):
                # What follows is understood: the first word is the name of one that does not run.
                return words[0], settings_of(words[1:])
        raise


def _watch(arguments: Sequence[str]) -> ExitStatus:
    parser = _parser(
        "watch",
        "Watch a running emulator; where the output is no terminal, a line a second for each\n"
        "direction of a link that has seen datagrams.",
        ("noack netem watch", "noack netem watch dns --json"),
    )
    parser.add_argument("name", nargs="?", help=_HELP)
    parser.add_argument("--json", action="store_true", help="print a JSON document a second")
    options = parser.parse_args(arguments)
    session = find(options.name)
    ended: PeerError | None = None
    with Signals().handled() as signals, Client(session) as client:
        with JsonLines() if options.json else Screen(_title(session)) as screen:
            screen.show(client.ask("report"))
            try:
                for statistics in client.follow(
                    lambda: screen.look() or signals.received is not None
                ):
                    screen.show(statistics)
            except PeerError as error:
                ended = error
        if ended is not None:
            raise ended
    return ExitStatus.OK


def _title(session: Session) -> str:
    return f"noack netem {session.name}"


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


COMMANDS: Mapping[str, Callable[[Sequence[str]], ExitStatus]] = {
    "show": _show,
    "set": _set,
    "watch": _watch,
}
"""By their names."""
