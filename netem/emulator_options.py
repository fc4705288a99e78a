"""The command line of a stand-alone emulator: its options, and the links that they describe.

:func:`explain` shows the effect of the links' settings, for ``--explain``, which relays nothing.
"""

import argparse
import difflib
import json
import re
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path

import tomli_w
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table
from rich.text import Text

from netem.relay.relay_links import LinkSpec
from netem.tc_words import (
    GRAMMAR,
    KEYWORDS,
    TcCommand,
    load_links,
    parse,
    require_no_dashes,
    settings_of,
    tc_command,
    words_of,
)
from noack.core.errors import CallerError, shortened
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_prediction import expected_loss, read_files, with_target_loss
from noack.impairments.words import OWN_TIME_S
from noack.runtime.address import address_text, parse_address, parse_destination
from noack.runtime.command_line import Parser
from noack.runtime.join_run import add_options

LINK_NAME = "relay"
"""Name of the link that the command line describes."""

_COMMANDS = ("show", "set", "watch", "shell")
_EXAMPLE_LISTEN, _EXAMPLE_TO = ":9000", ":9001"
"""Addresses for --explain."""

_NOWHERE = ("0.0.0.0", 0)
_SHELL_EPILOG = """
The command reaches the outside at the addresses in NOACK_OUTSIDE and NOACK_OUTSIDE6. As root, and
in another shell, the outside is the present network namespace. Otherwise it is a new one, without
other networks; --outside starts servers in it.

exit status: the command's; 2 a mistake, or the system does not permit it; 143 ended by a signal

examples:
  noack netem shell loss 30% mansd 4 delay 20ms -- ping -c 10 198.18.16.1
  noack netem shell --both delay 20ms rate 8mbit -- bash
  noack netem shell loss 5% --outside "iperf3 -s" -- sh -c "sleep 1; iperf3 -c 198.18.16.1"
"""
_EPILOG = """
words, in the order in which they apply; T is a time (10ms), P a percentage (5%), N a number:
  {grammar}

settings, at any place:
  mansd N    at most N consecutive losses in each flow
  atmost M in K  at most M losses in any K consecutive datagrams
  recover H  at least H consecutive deliveries between two loss bursts
  first      the first datagram of each flow is delivered
  limit N    at most N datagrams are delayed at a time
  seed N     seed of the link's random streams

A flow is the datagrams from one client (address and port), or the answers to it.

commands for an emulator that runs with --control NAME (each has --help):
  noack netem show [NAME]         show its statistics
  noack netem set [NAME] WORDS    change its impairments
  noack netem watch [NAME]        show its statistics live

`noack netem shell --help` is about commands all of whose packets pass the emulator.

When the emulator is ready, it prints a line on standard output:
  ready: listening on 127.0.0.1:9000

exit status: 0 ended as requested; 1 a failure; 2 a mistake on the command line or in a file;
3 unintended losses (a full buffer or queue): the guarantee does not hold

examples:
  noack netem --listen :9000 --to :9001 loss 5% mansd 4
  noack netem --listen :9000 --to :9001 delay 10ms 2ms distribution normal --reverse delay 10ms
  noack netem --listen :5300 --to 192.0.2.1:53 --both "loss gemodel 1% 10%"
  noack netem --links links.toml
  noack netem --explain loss burst 5% 3 mansd 2
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
        prog="noack netem",
        usage="%(prog)s --listen HOST:PORT --to HOST:PORT\n"
        "                   [WORDS ...] [options]\n"
        "       %(prog)s --links FILE.toml [options]\n"
        "       %(prog)s --explain WORDS ...\n"
        "       %(prog)s shell [WORDS ...] [options] [-- COMMAND]\n"
        "       %(prog)s show|set|watch [NAME] ...\n"
        "       %(prog)s [--session NAME]",
        description="A UDP relay that emulates a network, configured in the syntax of `tc netem`. "
        "With mansd N, at most N consecutive datagrams of a flow are lost. Without --listen, it "
        "joins the run that `noack record SCENARIO` has opened.",
        epilog=_EPILOG.format(grammar="\n  ".join(GRAMMAR)),
        formatter_class=_Formatter,
        allow_abbrev=False,
    )
    add_options(parser)
    alone = parser.add_argument_group("links")
    _add_words(alone, "clients", "server")
    alone.add_argument(
        "--listen",
        metavar="HOST:PORT",
        help="address for the clients; "
        ":9000 is 127.0.0.1:9000, and 0.0.0.0:9000 or [::]:9000 is any address of this machine",
    )
    alone.add_argument("--to", metavar="HOST:PORT", help="address of the server")
    alone.add_argument("--links", metavar="FILE", type=Path, help="several links, from a TOML file")
    alone.add_argument("--one-way", action="store_true", help="do not relay the server's answers")
    alone.add_argument(
        "--explain", action="store_true", help="explain the words, or the links of a file, and exit"
    )
    return parser


def shell_parser() -> Parser:
    """Return the parser of the command line of a shell, without its command."""
    parser = Parser(
        prog="noack netem shell",
        usage="%(prog)s [WORDS ...] [options] [-- COMMAND]",
        description="Run a command (without one: your shell) in a network namespace, and pass all "
        "its IP packets through an emulated network. The words are those of `noack netem`. "
        "With mansd N, at most N consecutive packets of a flow (protocol, addresses and ports) "
        "are lost. It needs no root if the kernel permits user namespaces.",
        epilog=_SHELL_EPILOG,
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
    return LinkSpec(LINK_NAME, _NOWHERE, _NOWHERE, forward, reverse, seed, idle_s=_idle_s(options.idle))


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line.

    Raises:
        CallerError: a word begins with dashes, or --session is combined with other options.
    """
    require_no_dashes(arguments)
    # With a space before it, argparse takes -1,2 for a word, not for an option.
    words = [f" {argument}" if re.match(r"-[0-9.]", argument) else argument for argument in arguments]
    options = parser.parse_intermixed_args(words)
    if any(argument.partition("=")[0] == "--session" for argument in arguments):
        raise CallerError(
            "--session joins a run and allows only --json beside it; words and all other options "
            "belong to an emulator on its own, which needs --listen and --to, or --links"
        )
    return options


def specs_of(options: argparse.Namespace, *, read: bool = True) -> tuple[LinkSpec, ...]:
    """Return the links that the command line describes; ``read`` the files that they name.

    Raises:
        CallerError: the command line has a mistake.
    """
    if options.links is not None:
        for name in ("listen", "to", "words", "reverse", "both", "one_way", "idle", "seed"):
            if getattr(options, name):
                option = name if name == "words" else f"--{name.replace('_', '-')}"
                raise CallerError(f"{option}: with --links, set this in the file")
        return load_links(options.links, read=read)
    if options.explain:
        options.listen = options.listen or _EXAMPLE_LISTEN
        options.to = options.to or _EXAMPLE_TO
    if options.listen is None and options.to is None:
        _require_word(options.words)
        raise CallerError("an emulator on its own needs --listen and --to, or --links; see --help")
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


def _require_word(words: Sequence[str]) -> None:
    """Explain a first word that is neither a command nor an impairment."""
    first = words[0].split()[0] if words and words[0].split() else ""
    if first and first not in KEYWORDS and not any(word.startswith(first) for word in KEYWORDS):
        close = difflib.get_close_matches(first, [*_COMMANDS, *KEYWORDS], 1)
        hint = f"did you mean {close[0]}?" if close else "see --help"
        raise CallerError(f"{first}: neither a command ({', '.join(_COMMANDS)}) nor a word; {hint}")


def _idle_s(text: str | None) -> float:
    if text is None:
        return LinkSpec.idle_s
    try:
        idle_s = OWN_TIME_S.read(text)
    except ValueError:
        raise CallerError(f"--idle {text}: expected {OWN_TIME_S.expected}") from None
    if not 0 < idle_s <= 1e6:
        raise CallerError(f"--idle {text}: must be more than 0")
    return idle_s


def _directions(options: argparse.Namespace) -> tuple[LinkSettings, LinkSettings, int]:
    """Return the forward and the reverse settings, and the seed; files are not read yet."""
    forward, seed = parse(options.words or ())
    if options.both and options.reverse is not None:
        raise CallerError("--reverse and --both exclude each other")
    if getattr(options, "one_way", False) and (options.both or options.reverse is not None):
        raise CallerError("--one-way: no reverse direction; leave out --reverse and --both")
    reverse = settings_of(options.reverse) if options.reverse is not None else LinkSettings()
    if seed is not None and options.seed is not None:
        raise CallerError(f"--seed {options.seed}: the words have seed {seed} already")
    seed = options.seed if seed is None else seed
    if seed is not None and not 0 <= seed < 2**64:
        raise CallerError(f"--seed {seed}: must be 0 or more, below 2^64")
    return forward, forward if options.both else reverse, seed or 0


_MAX_TOML = 4000
_NARROW_WIDTH, _WIDE_WIDTH = 20, 44
"""Minimum and maximum columns for words."""


def explain(specs: Sequence[LinkSpec], written: Sequence[LinkSpec], *, as_json: bool, as_file: bool) -> None:
    """Print the effect of links' settings on standard output, as tables or as JSON.

    Args:
        specs: the links.
        written: the same links, with the names of files instead of their content: what tables show.
        as_json: JSON, with the content.
        as_file: tables have the links as a file of links instead of their names.
    """
    if as_json:
        links = [
            {
                "name": spec.name,
                "listen": address_text(spec.listen),
                "to": address_text(spec.to),
                "seed": spec.seed,
                "forward": _document(spec.forward),
                "reverse": _document(spec.reverse) if spec.return_path else None,
            }
            for spec in specs
        ]
        print(json.dumps({"links": links}, indent=2))
        return
    console = Console(highlight=False)
    for number, (spec, written_spec) in enumerate(zip(specs, written, strict=True)):
        if number:
            console.print()
        if not as_file:
            seed = f", seed {spec.seed}" if spec.seed else ""
            addresses = f"{address_text(spec.listen)} → {address_text(spec.to)}"
            console.print(Text(f"{spec.name}: {addresses}{seed}", "bold underline"))
        _print_link(console, spec, written_spec)
        if as_file:
            console.print(Text("\nas a file of links (--links)", "bold"))
            toml = tomli_w.dumps({"link": [_link_table(written_spec)]}).strip()
            console.print(Text(shortened(toml, _MAX_TOML)), soft_wrap=True)  # for copying


def _document(settings: LinkSettings) -> dict[str, object]:
    prediction, tc = expected_loss(settings), tc_command(settings)
    return {
        "words": words_of(settings),
        "settings": settings.model_dump(mode="json", exclude_none=True),
        "meaning": [impairment.meaning() for impairment in settings.impairments]
        + [f"{words}: {meaning}" for words, meaning in settings_meaning(settings)],
        "predicted_loss": prediction.rate,
        "predicted_loss_note": prediction.note,
        "predicted_loss_without_cap": expected_loss(_uncapped(settings)).rate,
        "tc": tc.words,
        "tc_lacks": list(tc.lacks),
        "tc_notes": list(tc.notes),
    }


def settings_meaning(settings: LinkSettings) -> Iterator[tuple[str, str]]:
    """Yield (words, meaning) of the cap and the other settings."""
    if settings.mansd is not None:
        meaning = f"at most {settings.mansd} consecutive packets of a flow are not delivered"
        yield f"mansd {settings.mansd}", f"the cap (M − 1): {meaning}; the next one is always delivered"
    for constraint in settings.constraints:
        yield constraint.text(), constraint.meaning()
    if settings.first_delivered:
        meaning = "the first packet of each flow is always delivered"
        yield "first", f"{meaning}; the cap for later packets is mansd"
    if any(impairment.delays for impairment in settings.impairments):
        most = settings.limit
        yield f"limit {most}", f"at most {most} packets are delayed at once; more are dropped"


def _print_link(console: Console, spec: LinkSpec, written: LinkSpec) -> None:
    if spec.return_path and spec.forward == spec.reverse:
        _print_direction(console, "both directions, each by itself", spec.forward, written.forward)
        return
    _print_direction(console, "forward, from clients to the server", spec.forward, written.forward)
    console.print()
    if spec.return_path:
        title = "reverse, from the server to clients"
        _print_direction(console, title, spec.reverse, written.reverse)
    else:
        console.print(Text("reverse: not relayed; the server's answers are discarded", "bold"))


def _print_direction(console: Console, title: str, settings: LinkSettings, written: LinkSettings) -> None:
    if settings == LinkSettings():
        console.print(Text(f"{title}: no impairment", "bold"))
        return
    console.print(Text(f"{title}, in this order", "bold"))
    console.print(_table(settings, written, console.width))
    console.print(Text(f"\nexpected loss rate: {_rate_text(settings)}"))
    _print_tc(console, tc_command(settings, written))


def _table(settings: LinkSettings, written: LinkSettings, width: int) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=False)
    table.add_column(justify="right", style="dim")
    most = min(max(2 * width // 5, _NARROW_WIDTH), _WIDE_WIDTH)
    table.add_column(max_width=most, overflow="fold", style="bold")
    table.add_column(overflow="fold")
    pairs = zip(settings.impairments, written.impairments, strict=True)
    for number, (impairment, written_impairment) in enumerate(pairs, 1):
        # As text: a bracket in a file's name is not markup.
        words, meaning = shortened(written_impairment.text(), 200), impairment.meaning()
        table.add_row(str(number), Text(words), Text(meaning))
    if not settings.impairments:
        table.add_row("", "", "no impairment")
    for words, meaning in settings_meaning(settings):
        table.add_row("", words, meaning)
    return table


def _rate_text(settings: LinkSettings) -> str:
    prediction = expected_loss(settings)
    if prediction.rate is None:
        return f"not known: {prediction.note}"
    text = f"{100 * prediction.rate:.4g}%"
    without = expected_loss(_uncapped(settings)).rate
    if without is not None and settings.longest_burst is not None:
        text += f" (without the guarantee {100 * without:.4g}%)"
    return f"{text}, {prediction.note}" if prediction.note else text


def _print_tc(console: Console, tc: TcCommand) -> None:
    lacks = ", ".join(tc.lacks)
    if tc.words is None:
        console.print(Text(f"not possible with tc, which lacks: {lacks}"))
        return
    console.print(Text("nearest command of tc, for a network device:"))
    command = textwrap.wrap(
        f"tc qdisc add dev DEVICE root netem {tc.words}",
        max(console.width - 2, _NARROW_WIDTH),
        initial_indent="  ",
        subsequent_indent="      ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    console.print(Text(" \\\n".join(command)), soft_wrap=True)
    if lacks:
        console.print(Text(f"tc lacks: {lacks}"))
    for note in tc.notes:
        console.print(Text(f"difference: {note}"))


def _uncapped(settings: LinkSettings) -> LinkSettings:
    """Return settings without the guarantee, which lose with the same probabilities."""
    return with_target_loss(settings).model_copy(update={"mansd": None, "constraints": ()})


def _link_table(spec: LinkSpec) -> dict[str, object]:
    """Return a link's table in a file of links, without default values."""
    table: dict[str, object] = {
        "name": spec.name,
        "listen": address_text(spec.listen),
        "to": address_text(spec.to),
    }
    for key in ("seed", "return_path", "idle_s"):
        if getattr(spec, key) != getattr(LinkSpec, key):
            table[key] = getattr(spec, key)
    sides = {"forward": _set_keys(spec.forward), "reverse": _set_keys(spec.reverse)}
    return table | {name: side for name, side in sides.items() if side}


def _set_keys(section: BaseModel) -> dict[str, object]:
    """Return the keys of a section that differ from their defaults, and its kind."""
    return {
        key: _plain(getattr(section, key))
        for key, field in type(section).model_fields.items()
        if key in ("kind", "model") or getattr(section, key) != field.default
    }


def _plain(value: object) -> object:
    if isinstance(value, BaseModel):
        return _set_keys(value)
    return [_plain(entry) for entry in value] if isinstance(value, tuple) else value
