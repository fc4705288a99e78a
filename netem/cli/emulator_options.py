"""What the command line takes, and the links that it asks for."""

import argparse
import textwrap
from collections.abc import Sequence
from pathlib import Path

from netem.engine.relay_interface import LinkSpec
from netem.words.links_file import load_links
from netem.words.words_to_settings import parse, require_no_dashes, settings_of
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings, read_files
from noack.impairments.quantities import OWN_TIME_S
from noack.runtime.address import parse_address
from noack.runtime.command_line import Parser
from noack.runtime.process_entry import add_options

LINK_NAME = "relay"
"""Of the link that the command line itself describes."""

_EXAMPLE_LISTEN, _EXAMPLE_TO = ":9000", ":9001"
"""Where words are explained that say nothing of addresses."""

_EPILOG = """
words, in the order in which they apply; T is a time (10ms), P a percentage (5%), N a number:
  loss P [CORR]
  loss gemodel P [R [1-H [1-K]]]
  loss state P13 [P31 [P32 [P23 [P14]]]]
  loss burst MEAN_LOSS MEAN_BURST
  loss periodic B/N [from N]  (B datagrams in a row of every N)
  loss script N,N,... [every N]
  loss trace FILE [once]
  loss worst | loss none
  delay T [JITTER [CORR]] [distribution uniform|normal|pareto|paretonormal|FILE] [lossrel P]
  delay T samples T,T,... [lossrel P]
  duplicate P [CORR] | corrupt P [CORR]
  reorder P [CORR] [gap N] | gap N
  rate RATE [OVERHEAD [CELL [CELL_OVERHEAD]]] [queue N]
  blackout T-T[,T-T...] [every T]

settings, wherever they stand:
  mansd N    at most N successive datagrams of a flow are not delivered
  first      the first datagram of each flow is delivered
  limit N    at most N datagrams are delayed at once
  seed N     of the link's random streams

A flow is what one client, that is an address and a port, sends, or what is answered to it.

while one runs with --control NAME (each has --help):
  noack netem show [NAME]         what has happened so far
  noack netem set [NAME] WORDS    what it does from now on
  noack netem watch [NAME]        live

When it is ready, it prints a line on standard output: ready: listening on 127.0.0.1:9000

exit status: 0 it ended as asked; 1 something failed; 2 the command line or a file is wrong;
3 there were unintended losses (a full buffer or queue), so that the guarantee does not hold

examples:
  noack netem --listen :9000 --to :9001 loss 5% mansd 4
  noack netem --listen :9000 --to :9001 delay 10ms 2ms distribution normal --back delay 10ms
  noack netem --listen :5300 --to 192.0.2.1:53 --both "loss gemodel 1% 10%"
  noack netem --links links.toml
  noack netem --explain loss burst 5% 3 mansd 2
"""


class _Formatter(argparse.HelpFormatter):
    """Wraps each line of a text by itself; what goes on is indented, a command's line marked."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines: list[str] = []
        for line in text.splitlines():
            left = " " * (len(line) - len(line.lstrip()))
            column = line.rfind("  ") + 2 if line.strip().count("  ") else 0
            more = " " * column if column else left + (4 * " " if left else "")
            command = line.startswith("  noack") and not column
            wrapped = textwrap.wrap(
                line, width - 2 * command, initial_indent=indent, subsequent_indent=indent + more,
                break_long_words=False, break_on_hyphens=False,
            )  # fmt: skip
            lines += [(" \\\n" if command else "\n").join(wrapped)]
        return "\n".join(lines)


def parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser(
        prog="noack netem",
        usage="%(prog)s --listen HOST:PORT --to HOST:PORT\n"
        "                   [WORDS ...] [options]\n"
        "       %(prog)s --links FILE.toml [options]\n"
        "       %(prog)s --explain WORDS ...\n"
        "       %(prog)s show|set|watch [NAME] ...\n"
        "       %(prog)s [--session NAME]",
        description="A UDP relay that does to datagrams what a network may do, in the words of "
        "`tc netem`, but never lets more than MANSD successive ones of a flow be lost. Without "
        "--listen it joins the run that `noack record SCENARIO` has opened.",
        epilog=_EPILOG,
        formatter_class=_Formatter,
        allow_abbrev=False,
    )
    add_options(parser)
    alone = parser.add_argument_group("on its own")
    alone.add_argument(
        "--listen", metavar="HOST:PORT", help="where clients send to; "
        ":9000 is 127.0.0.1:9000, and 0.0.0.0:9000 or [::]:9000 is any address of this machine",
    )  # fmt: skip
    alone.add_argument("--to", metavar="HOST:PORT", help="the server")
    alone.add_argument("words", nargs="*", metavar="WORDS", help="from clients to the server")
    alone.add_argument(
        "--back", metavar="WORDS", nargs="+", help="from the server to clients; nothing by default"
    )
    alone.add_argument("--both", action="store_true", help="the words apply in both directions")
    alone.add_argument("--links", metavar="FILE", type=Path, help="several links, from a TOML file")
    alone.add_argument(
        "--one-way", action="store_true", help="what the server answers is not relayed"
    )
    alone.add_argument(
        "--idle", metavar="TIME", help="forget a client after so long without datagrams (60s)"
    )
    alone.add_argument("--seed", type=int, help="of the random streams (0)")
    alone.add_argument(
        "--explain", action="store_true",
        help="say what the words, or the links of a file, mean, and do nothing",
    )  # fmt: skip
    return parser


def parsed(parser: argparse.ArgumentParser, arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line.

    Raises:
        CallerError: a word stands there as an option, or an option that goes alone does not.
    """
    require_no_dashes(arguments)
    options = parser.parse_intermixed_args(arguments)
    if any(argument.partition("=")[0] == "--session" for argument in arguments):
        raise CallerError(
            "--session: joins a run, and goes alone or with --json; words and all other options "
            "are of an emulator on its own, which has --listen and --to, or --links"
        )
    return options


def specs_of(options: argparse.Namespace) -> tuple[LinkSpec, ...]:
    """Return the links that the command line asks for.

    Raises:
        CallerError: it says something wrong.
    """
    if options.links is not None:
        for name in ("listen", "to", "words", "back", "both", "one_way", "idle", "seed"):
            if getattr(options, name):
                shown = name if name == "words" else f"--{name.replace('_', '-')}"
                raise CallerError(f"{shown}: stands in the file that --links names")
        return load_links(options.links)
    if options.explain:
        options.listen = options.listen or _EXAMPLE_LISTEN
        options.to = options.to or _EXAMPLE_TO
    if options.listen is None and options.to is None:
        raise CallerError("an emulator on its own needs --listen and --to, or --links; see --help")
    if options.listen is None or options.to is None:
        raise CallerError("--listen and --to go together")
    listen = parse_address(options.listen, "--listen")
    to = parse_address(options.to, "--to", listen)
    forward, back, seed = directions(options)
    idle_s = LinkSpec.idle_s
    if options.idle is not None:
        try:
            idle_s = OWN_TIME_S.read(options.idle)
        except ValueError:
            raise CallerError(f"--idle {options.idle}: expected {OWN_TIME_S.expected}") from None
        if not 0 < idle_s <= 1e6:
            raise CallerError(f"--idle {options.idle}: must be more than 0")
    return (
        LinkSpec(
            name=LINK_NAME,
            listen=listen,
            to=to,
            forward=read_files(forward, Path()),
            back=read_files(back, Path()),
            seed=seed,
            return_path=not options.one_way,
            idle_s=idle_s,
        ),
    )


def directions(options: argparse.Namespace) -> tuple[LinkSettings, LinkSettings, int]:
    """Return what happens forward and back, and the seed; files are not read yet.

    Raises:
        CallerError: the words say something wrong.
    """
    forward, seed = parse(options.words or ())
    if options.both and options.back is not None:
        raise CallerError("--back: goes without --both")
    if options.one_way and (options.both or options.back is not None):
        raise CallerError("--one-way: nothing goes back; leave out --back and --both")
    back = settings_of(options.back) if options.back is not None else LinkSettings()
    if seed is not None and options.seed is not None:
        raise CallerError(f"--seed {options.seed}: the words say seed {seed} already")
    seed = options.seed if seed is None else seed
    if seed is not None and not 0 <= seed < 2**64:
        raise CallerError(f"--seed {seed}: must be 0 or more, below 2^64")
    return forward, forward if options.both else back, seed or 0
