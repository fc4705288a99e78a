"""A command line gives links; mistakes give error messages."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from netem.__main__ import main
from netem.emulator_options import command_line_parser as parser
from netem.emulator_options import parse_options, specs_of
from netem.impairments.kinds.loss import LOSS_WORDS
from netem.relay.relay_links import LinkSpec
from netem.tc_words import EXAMPLES, KEYWORDS, parse, settings_of
from tests.helpers.approved import compare_lines

ADDRESSES = "--listen :9000 --to :9001"


def specs(arguments: str) -> tuple[LinkSpec, ...]:
    return specs_of(parse_options(parser(), shlex.split(arguments)))


@pytest.mark.parametrize(
    ("arguments", "forward", "reverse", "more"),
    [
        ("", "", "", {}),
        ("'loss 5%' 'mansd 4'", "loss 5% mansd 4", "", {}),
        ("rate 1mbit -14 queue 5 --reverse loss 5%", "rate 1mbit -14 queue 5", "loss 5%", {}),
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


_OF_THE_SYSTEM = re.compile(r"\((\[Errno|Name or service).*\)$")
"""Texts that depend on the system, or on a library."""


def test_a_mistake_ends_the_program_with_the_approved_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])

    def mistake(arguments: str) -> list[str]:
        assert main(shlex.split(arguments)) == 2
        out, err = capsys.readouterr()
        assert ("error" in json.loads(out)) if "--json" in arguments else out == ""
        assert err.count("\n") == 1
        return [_OF_THE_SYSTEM.sub("(…)", err.strip()).replace(str(Path.cwd()), "FOLDER")]

    compare_lines(Path(__file__).with_name("option_mistakes.txt"), mistake)


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
        assert line.startswith("  noack-netem ")
        assert specs(line.removeprefix("  noack-netem "))


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
