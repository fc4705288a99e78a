"""The command line of a stand-alone emulator: its options, and the links that they describe."""

import argparse
import difflib
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path

from netem.core.address import parse_address, parse_destination
from netem.core.clock import NS_PER_S
from netem.core.command_line import Parser, netem_program
from netem.core.errors import CallerError
from netem.core.number_checks import whole_number
from netem.core.settings_section import LARGEST_SEED
from netem.impairments.burst_prediction import USUAL_PACKETS, read_within
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import read_files
from netem.impairments.words import OWN_TIME_S
from netem.links_file import load_links, load_presets, load_timetable
from netem.presets.preset import Preset, find_preset
from netem.relay.relay_links import LinkSpec
from netem.tc_words import (
    GRAMMAR,
    KEYWORDS,
    parse,
    preset_names,
    require_no_dashes,
    reverse_words,
    settings_of,
)
from netem.timetable_file import SHORTEST_NS, TimetableFile, read_timetable

LINK_NAME = "relay"
"""Name of the link that the command line describes."""

_COMMANDS = ("show", "set", "watch", "shell", "measure")
_EXAMPLE_LISTEN, _EXAMPLE_TO = ":9000", ":9001"
"""Addresses for --explain."""

_NO_ADDRESS = ("0.0.0.0", 0)
_SHELL_EPILOG = """
The command reaches the outside at the addresses in NOACK_OUTSIDE and NOACK_OUTSIDE6. As root, and
in another shell, the outside is the present network namespace. Otherwise it is a new one, without
other networks; --outside starts servers in it.

exit status: the command's; 2 a mistake, or the system does not permit it; 143 ended by a signal

examples:
  {program} shell loss 30% mansd 4 delay 20ms -- ping -c 10 198.18.16.1
  {program} shell --both delay 20ms rate 8mbit -- bash
  {program} shell loss 5% --outside "iperf3 -s" -- sh -c "sleep 1; iperf3 -c 198.18.16.1"
"""
_EPILOG = """
words, in the order in which they apply; T is a time (10ms), P a percentage (5%), N a number:
  {grammar}

settings, at any place:
  mansd N    at most N consecutive losses in each flow
  atmost N in K  at most N losses in any K consecutive datagrams
  recover H  at least H consecutive deliveries between two loss bursts
  first      the first datagram of each flow is delivered
  limit N    at most N datagrams are delayed at a time
  seed N     seed of the link's random streams

  like NAME  the words of a preset, which may differ between the directions, e.g.
             like dsl mansd 4; or of a file: like ./NAME.toml

A flow is the datagrams from one client (address and port), or the answers to it.

commands for an emulator that runs with --control NAME (each has --help):
  {program} show [NAME]         show its statistics
  {program} set [NAME] WORDS    change its impairments
  {program} watch [NAME]        show its statistics live

`{program} shell --help` is about commands all of whose packets pass the emulator,
`{program} measure --help` about networks measured from captures and logs.

When the emulator is ready, it prints a line on standard output:
  ready: listening on 127.0.0.1:9000

exit status: 0 ended as requested; 1 a failure; 2 a mistake on the command line or in a file;
3 unintended losses (a full buffer or queue): the guarantee does not hold

examples:
  {program} --listen :9000 --to :9001 loss 5% mansd 4
  {program} --listen :9000 --to :9001 delay 10ms 2ms distribution normal --reverse delay 10ms
  {program} --listen :5300 --to 192.0.2.1:53 --both "loss gemodel 1% 10%"
  {program} --links links.toml
  {program} --explain loss burst 5% 3 mansd 2
"""


class _Formatter(argparse.HelpFormatter):
    """Wraps each line of a text separately, with an indent; a command gets a backslash."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines: list[str] = []
        for line in text.splitlines():
            margin = " " * (len(line) - len(line.lstrip()))
            column = line.rfind("  ") + 2 if line.strip().count("  ") else 0
            further_indent = " " * column if column else margin + (4 * " " if margin else "")
            command = line.startswith("  noack") and not column
            wrapped = textwrap.wrap(
                line,
                width - 2 * command,
                initial_indent=indent,
                subsequent_indent=indent + further_indent,
                break_long_words=False,
                break_on_hyphens=False,
            )
            lines += [(" \\\n" if command else "\n").join(wrapped)]
        return "\n".join(lines)


def command_line_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        prog=netem_program(),
        usage="%(prog)s --listen HOST:PORT --to HOST:PORT\n"
        "                   [WORDS ...] [options]\n"
        "       %(prog)s --links FILE.toml [options]\n"
        "       %(prog)s --explain WORDS ...\n"
        "       %(prog)s --presets\n"
        "       %(prog)s shell [WORDS ...] [options] [-- COMMAND]\n"
        "       %(prog)s show|set|watch [NAME] ...\n"
        "       %(prog)s measure FILE ...",
        description="A UDP relay that emulates a network, configured in the syntax of `tc netem`. "
        "With mansd N, at most N consecutive datagrams of a flow are lost.",
        epilog=_EPILOG.format(grammar="\n  ".join(GRAMMAR), program=netem_program()),
        formatter_class=_Formatter,
        allow_abbrev=False,
    )
    parser.add_argument("--json", action="store_true", help="print the final report as JSON")
    links = parser.add_argument_group("links")
    _add_words(links, "clients", "server")
    links.add_argument(
        "--listen",
        metavar="HOST:PORT",
        help="address for the clients; "
        ":9000 is 127.0.0.1:9000, and 0.0.0.0:9000 or [::]:9000 is any address of this machine",
    )
    links.add_argument("--to", metavar="HOST:PORT", help="address of the server")
    links.add_argument("--links", metavar="FILE", type=Path, help="several links, from a TOML file")
    links.add_argument("--one-way", action="store_true", help="do not relay the server's answers")
    links.add_argument(
        "--explain", action="store_true", help="explain the words, or the links of a file, and exit"
    )
    links.add_argument(
        "--presets", action="store_true", help="list the presets: what like NAME stands for, and its source"
    )
    links.add_argument(
        "--within",
        metavar="N|TIME",
        help=f"with --explain: chance of a long loss burst within N packets ({USUAL_PACKETS}), or a time",
    )
    links.add_argument("--period", metavar="TIME", help="with --within TIME: the sender's period")
    return parser


def shell_parser() -> Parser:
    """Return the parser of the command line of a shell, without its command."""
    parser = Parser(
        prog=f"{netem_program()} shell",
        usage="%(prog)s [WORDS ...] [options] [-- COMMAND]",
        description="Run a command (without one: your shell) in a network namespace, and pass all "
        f"its IP packets through an emulated network. The words are the same as for `{netem_program()}`. "
        "With mansd N, at most N consecutive packets of a flow (protocol, addresses and ports) "
        "are lost. It needs no root if the kernel permits user namespaces.",
        epilog=_SHELL_EPILOG.format(program=netem_program()),
        formatter_class=_Formatter,
        allow_abbrev=False,
    )
    parser.add_argument("--json", action="store_true", help="print the final report as JSON")
    group = parser.add_argument_group("link")
    _add_words(group, "inside", "outside")
    help_text = "run this outside meanwhile, such as a server; may be repeated"
    group.add_argument("--outside", metavar="COMMAND", action="append", help=help_text)
    return parser


def _add_words(group: argparse._ArgumentGroup, side: str, peer: str) -> None:
    group.add_argument("words", nargs="*", metavar="WORDS", help=f"impairments, {side} to {peer}")
    group.add_argument("--reverse", metavar="WORDS", nargs="+", help=f"impairments, {peer} to {side} (none)")
    group.add_argument("--both", action="store_true", help="the words apply in both directions")
    group.add_argument(
        "--timetable",
        metavar="FILE",
        type=Path,
        help="change the impairments at the times in this CSV file: time_s,words (direction, link)",
    )
    group.add_argument("--repeat", metavar="TIME", help="repeat the timetable after TIME")
    subject = "client that sends" if side == "clients" else "flow that has"
    group.add_argument("--idle", metavar="TIME", help=f"remove a {subject} nothing for TIME (60s)")
    group.add_argument("--seed", type=int, help="seed of the random streams (0)")


def shell_spec(options: argparse.Namespace) -> LinkSpec:
    """Return the link that the command line of a shell describes, without its addresses.

    Raises:
        CallerError: the command line has a mistake.
    """
    forward, reverse, seed = _directions(options)
    forward, reverse = (read_files(settings, Path()) for settings in (forward, reverse))
    return LinkSpec(LINK_NAME, _NO_ADDRESS, _NO_ADDRESS, forward, reverse, seed, idle_s=_idle_s(options.idle))


def parse_options(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line.

    Raises:
        CallerError: a word begins with dashes, or an option is unknown.
    """
    require_no_dashes(arguments)
    # With a space before it, argparse takes -1,2 for a word, not for an option.
    words = [f" {argument}" if re.match(r"-[0-9.]", argument) else argument for argument in arguments]
    return parser.parse_intermixed_args(words)


def specs_of(options: argparse.Namespace, *, read: bool = True) -> tuple[LinkSpec, ...]:
    """Return the links that the command line describes; ``read`` the files that they name.

    Raises:
        CallerError: the command line has a mistake.
    """
    # A file describes its links on its own.
    if options.links is not None:
        for name in ("listen", "to", "words", "reverse", "both", "one_way", "idle", "seed"):
            if getattr(options, name):
                option = name if name == "words" else f"--{name.replace('_', '-')}"
                raise CallerError(f"{option}: with --links, set this in the file")
        return load_links(options.links, read=read)
    # Otherwise there is one link; an explanation needs no addresses.
    if options.explain:
        options.listen = options.listen or _EXAMPLE_LISTEN
        options.to = options.to or _EXAMPLE_TO
    if options.listen is None and options.to is None:
        _require_word(options.words)
        raise CallerError("--listen and --to are missing, or --links FILE; see --help")
    if options.listen is None or options.to is None:
        raise CallerError("--listen and --to must be given together")
    listen = parse_address(options.listen, "--listen")
    to = parse_destination(options.to, "--to", listen)
    forward, reverse, seed = _directions(options)
    if read:
        forward, reverse = (read_files(settings, Path()) for settings in (forward, reverse))
    return (
        LinkSpec(
            name=LINK_NAME,
            listen=listen,
            to=to,
            forward=forward,
            reverse=reverse,
            seed=seed,
            return_path=not options.one_way,
            idle_s=_idle_s(options.idle),
        ),
    )


def presets_of(options: argparse.Namespace) -> tuple[Preset, ...]:
    """Return the presets that a command line names, which has been read without a mistake."""
    if options.links is not None:
        return load_presets(options.links)
    names = (*preset_names(options.words or ()), *preset_names(options.reverse or ()))
    return tuple(map(find_preset, dict.fromkeys(names)))


def timetable_of(options: argparse.Namespace, specs: Sequence[LinkSpec]) -> TimetableFile | None:
    """Return the timetable for the links of a command line, or of its file of links.

    Raises:
        CallerError: an option or the file has a mistake; one line for each.
    """
    links: Path | None = getattr(options, "links", None)
    if options.timetable is None:
        if options.repeat is not None:
            raise CallerError(f"--repeat {options.repeat}: is for --timetable FILE")
        return None if links is None else load_timetable(links, specs)
    if links is not None and load_timetable(links, specs) is not None:
        raise CallerError(f"--timetable {options.timetable}: {links} has a timetable already")
    repeat_ns = None
    if options.repeat is not None:
        repeat_ns = round(_time_s("--repeat", options.repeat) * NS_PER_S)
        if repeat_ns < SHORTEST_NS:
            raise CallerError(f"--repeat {options.repeat}: must be 1ms or more")
    return read_timetable(options.timetable, specs, repeat_ns)


def explained_packets(options: argparse.Namespace) -> int:
    """Return how many packets the explanation's chance of a long loss burst is for.

    Raises:
        CallerError: the options are wrong.
    """
    for name in ("within", "period"):
        if getattr(options, name) is not None and not options.explain:
            raise CallerError(f"--{name}: is for --explain")
    period_s = None if options.period is None else _time_s("--period", options.period)
    if options.within is None:
        return USUAL_PACKETS
    try:
        return read_within(options.within, period_s)
    except ValueError as error:
        raise CallerError(f"--within {options.within}: {error}") from None


def _require_word(words: Sequence[str]) -> None:
    """Explain a first word that is neither a command nor an impairment."""
    first = words[0].split()[0] if words and words[0].split() else ""
    if first and first not in KEYWORDS and not any(word.startswith(first) for word in KEYWORDS):
        close = difflib.get_close_matches(first, [*_COMMANDS, *KEYWORDS], 1)
        hint = f"did you mean {close[0]}?" if close else "see --help"
        raise CallerError(f"{first}: neither a command ({', '.join(_COMMANDS)}) nor a word; {hint}")


def _idle_s(text: str | None) -> float:
    return LinkSpec.idle_s if text is None else _time_s("--idle", text)


def _time_s(option: str, text: str) -> float:
    """Return the time of an option; raise CallerError if it is none, or out of range."""
    try:
        time_s = OWN_TIME_S.read(text)
    except ValueError:
        raise CallerError(f"{option} {text}: expected {OWN_TIME_S.expected}") from None
    if time_s <= 0:
        raise CallerError(f"{option} {text}: must be more than 0")
    if time_s > 1e6:
        raise CallerError(f"{option} {text}: must be 1000000s or less")
    return time_s


def _directions(options: argparse.Namespace) -> tuple[LinkSettings, LinkSettings, int]:
    """Return the forward and the reverse settings, and the seed; files are not read yet."""
    forward, seed, presets = parse(options.words or ())
    if options.both and options.reverse is not None:
        raise CallerError("--reverse and --both exclude each other")
    if getattr(options, "one_way", False) and (options.both or options.reverse is not None):
        raise CallerError("--one-way: no reverse direction; leave out --reverse and --both")
    if options.both:
        reverse = parse(options.words or (), direction="reverse").settings
    elif options.reverse is not None:
        reverse = settings_of(options.reverse, direction="reverse")
    else:
        is_one_way = getattr(options, "one_way", False)
        reverse = settings_of("" if is_one_way else reverse_words(presets), direction="reverse")
    if seed is not None and options.seed is not None:
        raise CallerError(f"--seed {options.seed}: the words have seed {seed} already")
    seed = options.seed if seed is None else seed
    return forward, reverse, whole_number("seed", seed or 0, 0, LARGEST_SEED)
