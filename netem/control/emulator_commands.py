"""The commands ``noack netem show``, ``set`` and ``watch`` for a running emulator."""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from netem.control.control_client import Client
from netem.control.emulator_statistics import Statistics
from netem.control.running_emulators import find_emulator, running_emulators
from netem.control.statistics_text import statistics_lines
from netem.core.command_line import Parser, Signals, discard_output, netem_program, report_failure
from netem.core.errors import CallerError, ExitStatus, NoackError, why
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import read_files
from netem.relay.relay_reports import DIRECTIONS
from netem.tc_words import guarantee_words, require_no_dashes, settings_of

_NAME_HELP = "the emulator's --control NAME; optional if only one runs"


def main(arguments: Sequence[str]) -> ExitStatus:
    """Run a command; the first argument is one of :data:`COMMANDS`."""
    command, *options = arguments
    try:
        return COMMANDS[command](options)
    except NoackError as error:
        source, as_json = f"{netem_program()} {command}", "--json" in options
        return report_failure(str(error), error.exit_status, source=source, as_json=as_json)
    except BrokenPipeError:  # the reader has closed the pipe
        discard_output(sys.stdout.fileno())
        return ExitStatus.OK
    except OSError as error:
        reason = f"cannot write: {why(error)}"
        return report_failure(
            reason, ExitStatus.FAILED, source=f"{netem_program()} {command}", as_json="--json" in options
        )


def _parser(
    command: str, description: str, examples: Sequence[str], json_help: str, **options: Any
) -> Parser:
    parser = Parser(
        prog=f"{netem_program()} {command}",
        description=description,
        epilog="\n  ".join(["examples:", *(f"{netem_program()} {line}" for line in examples)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        **options,
    )
    parser.add_argument("--control", metavar="NAME", help="the same as NAME")
    parser.add_argument("--json", action="store_true", help=json_help)
    return parser


def _named_emulator(options: argparse.Namespace) -> str:
    """Return the emulator that NAME or --control NAME selects."""
    if options.control is not None and options.name not in (None, options.control):
        raise CallerError(f"--control {options.control}: NAME is {options.name} already")
    return find_emulator(options.control or options.name)


def _show(arguments: Sequence[str]) -> ExitStatus:
    parser = _parser(
        "show",
        "Show the statistics of a running emulator.",
        ("show", "show dns --json"),
        "print one JSON document",
    )
    parser.add_argument("name", nargs="?", help=_NAME_HELP)
    options = parser.parse_args(arguments)
    statistics = Client(_named_emulator(options)).statistics()
    if options.json:
        print(json.dumps(statistics), flush=True)
    else:
        _print_lines(statistics)
    return ExitStatus.OK


def _set(arguments: Sequence[str]) -> ExitStatus:
    parser = _parser(
        "set",
        "Change the impairments of a link of a running emulator. The words replace all settings\n"
        "of the direction, the cap too, as with `tc qdisc change`.",
        ("set loss 10% mansd 4", "set dns --direction both delay 20ms 5ms"),
        "print the links' settings as JSON",
        usage="%(prog)s [NAME] [--link LINK] [--direction forward|reverse|both] WORDS ...",
    )
    parser.add_argument("words", nargs="*", metavar="[NAME] WORDS", help="for example loss 5%% mansd 4")
    parser.add_argument("--link", help="name of the link; optional if there is only one")
    parser.add_argument(
        "--direction", choices=(*DIRECTIONS, "both"), default="forward", help="default: forward"
    )
    require_no_dashes(arguments)
    options = parser.parse_intermixed_args(arguments)
    options.name, words = _name_and_words(options.words)
    directions = DIRECTIONS if options.direction == "both" else (options.direction,)
    settings = {each: read_files(settings_of(words, direction=each), Path()) for each in directions}
    # Change the emulator, and show all settings afterwards.
    client = Client(_named_emulator(options))
    earlier = client.links()
    tables = {each: settings[each].model_dump(mode="json") for each in directions}
    client.change(_link_name(options.link, earlier), **tables)
    later = client.links()
    if options.json:
        print(json.dumps({"links": later}), flush=True)
        return ExitStatus.OK
    for link in later:
        for direction in DIRECTIONS:
            words = link[direction]["words"] or "no impairment"
            print(f"{link['name']} {direction}: {words}", flush=True)
    _warn_of_removed_caps(earlier, later)
    return ExitStatus.OK


def _link_name(name: str | None, links: Sequence[Mapping[str, Any]]) -> str:
    """Return the name of the link that changes; without one, of the only link."""
    names = [str(link["name"]) for link in links]
    if name is None and len(names) > 1:
        raise CallerError(f"which link? Links: {', '.join(names)}")
    return name or names[0]


def _warn_of_removed_caps(earlier: Sequence[Mapping[str, Any]], later: Sequence[Mapping[str, Any]]) -> None:
    for old, new in zip(earlier, later, strict=True):
        for direction in DIRECTIONS:
            words_before, words_after = (
                guarantee_words(LinkSettings.model_validate_json(json.dumps(link_direction["settings"])))
                for link_direction in (old[direction], new[direction])
            )
            kept_names = {words.partition(" ")[0] for words in words_after}
            if removed := [words for words in words_before if words.partition(" ")[0] not in kept_names]:
                print(
                    f"{netem_program()} set: {new['name']} {direction} no longer has "
                    f"{', '.join(removed)}; the words replaced all settings",
                    file=sys.stderr,
                    flush=True,
                )


def _name_and_words(words: Sequence[str]) -> tuple[str | None, Sequence[str]]:
    """Separate the emulator's name, if the words begin with one, from the words of settings."""
    name, setting_words = None, words
    if words and words[0] in running_emulators():
        name, setting_words = words[0], words[1:]
    if not setting_words:
        raise CallerError("words are missing, for example: loss 5% mansd 4; or: loss none")
    try:
        settings_of(setting_words)
    except CallerError:
        if name is None:
            with suppress(CallerError):
                # The rest is valid: the first word is the name of an emulator that does not run.
                settings_of(words[1:])
                return words[0], words[1:]
        raise
    return name, setting_words


def _watch(arguments: Sequence[str]) -> ExitStatus:
    parser = _parser(
        "watch",
        "Print a running emulator's statistics every second: a line for each direction of a link\n"
        "that has received datagrams.",
        ("watch", "watch dns --json"),
        "print one JSON document per second",
    )
    parser.add_argument("name", nargs="?", help=_NAME_HELP)
    options = parser.parse_args(arguments)
    show = _print_document if options.json else _print_lines
    client = Client(_named_emulator(options))
    with Signals().handled() as signals:
        for statistics in client.follow(stop=lambda: signals.received is not None):
            show(statistics)
    return ExitStatus.OK


def _print_document(statistics: Statistics) -> None:
    print(json.dumps(statistics), flush=True)


def _print_lines(statistics: Statistics) -> None:
    print("\n".join(statistics_lines(statistics)), flush=True)


COMMANDS: Mapping[str, Callable[[Sequence[str]], ExitStatus]] = {"show": _show, "set": _set, "watch": _watch}
"""The commands by name."""
