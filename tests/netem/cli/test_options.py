"""A command line gives links; mistakes give error messages."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from netem.__main__ import main
from netem.emulator_options import command_line_parser as parser
from netem.emulator_options import parsed, specs_of
from netem.relay_links import LinkSpec
from netem.tc_words import EXAMPLES, KEYWORDS, parse, settings_of
from noack.core.errors import CallerError
from noack.impairments.kinds.loss import LOSS_WORDS

ADDRESSES = "--listen :9000 --to :9001"


def specs(arguments: str) -> tuple[LinkSpec, ...]:
    return specs_of(parsed(parser(), shlex.split(arguments)))


@pytest.mark.parametrize(
    ("arguments", "forward", "reverse", "more"),
    [
        ("", "", "", {}),
        ("'loss 5%' 'mansd 4'", "loss 5% mansd 4", "", {}),
        ("rate 1mbit -14", "rate 1mbit -14", "", {}),
        ("--reverse 'delay 3ms' --seed 3", "", "delay 3ms", {"seed": 3}),
        ("--both loss 5%", "loss 5%", "loss 5%", {}),
        ("loss 5% --seed 7 delay 1ms", "loss 5% delay 1ms", "", {"seed": 7}),
        ("--one-way --idle 500ms", "", "", {"return_path": False, "idle_s": 0.5}),
    ],
)
def test_a_command_line_describes_a_link(
    arguments: str, forward: str, reverse: str, more: dict[str, Any]
) -> None:
    here, there = ("127.0.0.1", 9000), ("127.0.0.1", 9001)
    link = LinkSpec("relay", here, there, settings_of(forward), settings_of(reverse), **more)
    assert specs(f"{ADDRESSES} {arguments}") == (link,)


def test_addresses() -> None:
    for listen, to, addresses in (
        ("127.0.0.1:0", "192.0.2.7:53", (("127.0.0.1", 0), ("192.0.2.7", 53))),
        ("[::1]:9000", ":9001", (("::1", 9000), ("::1", 9001))),
        (":9000", "[::1]:9001", (("127.0.0.1", 9000), ("::1", 9001))),
        ("0.0.0.0:9000", "localhost:9001", (("0.0.0.0", 9000), ("127.0.0.1", 9001))),
    ):
        (link,) = specs(f"--listen {listen} --to {to}")
        assert (link.listen, link.to) == addresses


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("--listen :9000", "--listen and --to must be given together"),
        ("shwo lab", "shwo: neither a command (show, set, watch) nor a word; did"),
        ("loss 5%", "an emulator on its own needs --listen and --to, or --links"),
        ("--listen x --to :9", "--listen: expected HOST:PORT, e.g. 127.0.0.1:9000"),
        ("--listen :0 --to 'no such:9'", "--to: no such: no such host"),
        ("-a --reverse seed 5", "seed 5: belongs to the link"),
        ("-a --seed -1", "--seed -1: must be 0 or more"),
        ("-a --seed 1 seed 1", "--seed 1: the words have seed 1 already"),
        ("-a --both --reverse loss 5%", "--reverse and --both exclude each other"),
        ("-a --one-way --reverse loss 5%", "--one-way: no reverse direction"),
        ("-a --idle 0", "--idle 0: must be more than 0"),
        ("-a loss trace no.txt", "no.txt: cannot be read: No such file"),
        ("-a --loss bernoulli:0.3", "--loss: write words without the dashes, e.g. loss 30%"),
        ("-a -loss 5%", "-loss: write words without the dashes"),
        ("-a loss bernoulli:0.3", "loss bernoulli:0.3: no such word; here it is loss 30%"),
        ("--session x loss 5%", "--session joins a run and allows only --json"),
        ("--links no.toml loss 5%", "words: with --links, set this in the file"),
    ],
)  # fmt: skip
def test_a_mistake_gets_one_line(arguments: str, line: str) -> None:
    with pytest.raises(CallerError) as caught:
        specs(arguments.replace("-a ", f"{ADDRESSES} ", 1))
    assert str(caught.value).startswith(line)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("-a lsos 5% --json", "lsos: no such word; did you mean loss?\n"),
        ("-a --capture - --json", "--capture -: --json and --stats"),
        ("-a --stats 0", "--stats 0: must be 0.01 s or more"),
        ("-a --record-fates a.parquet --replay-fates ./a.parquet", "--replay-fates "),
        (f"-a --record-fates {__file__}",
         f"--record-fates {__file__}: exists and is not a Parquet file"),
        ("--session x --capture x.pcapng", "--session joins a run"),
        ("-a --replay-fates no.parquet", "no.parquet: cannot be read"),
    ],
)  # fmt: skip
def test_a_mistake_ends_the_program(
    arguments: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(shlex.split(arguments.replace("-a ", f"{ADDRESSES} ", 1))) == 2
    out, err = capsys.readouterr()
    assert ("error" in json.loads(out)) if "--json" in arguments else out == ""
    assert err.startswith(f"noack netem: {line}")
    assert err.count("\n") == 1


@pytest.mark.parametrize("columns", ["120", "60"])
def test_the_examples_of_the_help_are_valid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, columns: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", columns)
    Path("links.toml").write_text('[[link]]\nname = "a"\nlisten = ":1"\nto = ":2"\n')
    text = parser().format_help().partition("examples:\n")[2]
    examples = text.replace("\\\n", "").splitlines()
    assert len(examples) == 5
    for line in examples:
        assert line.startswith("  noack netem ")
        assert specs(line.removeprefix("  noack netem "))


def test_every_word_is_in_the_help_and_has_an_example() -> None:
    text = parser().format_help()
    for word in (*KEYWORDS, *LOSS_WORDS):
        # The documentation lists these synonyms.
        assert word in ("latency", "drop", "random") or re.search(rf"\b{word}\b", text), word
    synonyms = {"drop": "loss", "random": "loss", "latency": "delay", "jitter": "delay"}
    for word, example in EXAMPLES.items():
        assert parse(example)
        assert synonyms.get(word, word) in example.split()
    assert set(KEYWORDS) - EXAMPLES.keys() == {"seed"}
