"""A command line gives links; mistakes give error messages; ``--explain`` describes links."""

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
from netem.tc_words import EXAMPLES, KEYWORDS, load_links, parse, settings_of
from noack.impairments.kinds.loss import LOSS_WORDS
from noack.impairments.link_settings import LinkSettings
from tests.approved import compare_lines

ADDRESSES = "--listen :9000 --to :9001"


def specs(arguments: str) -> tuple[LinkSpec, ...]:
    return specs_of(parsed(parser(), shlex.split(arguments)))


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
    monkeypatch.chdir(Path(__file__).parents[3])

    def mistake(arguments: str) -> list[str]:
        assert main(shlex.split(arguments)) == 2
        out, err = capsys.readouterr()
        assert ("error" in json.loads(out)) if "--json" in arguments else out == ""
        assert err.count("\n") == 1
        return [_OF_THE_SYSTEM.sub("(…)", err.strip()).replace(str(Path.cwd()), "FOLDER")]

    compare_lines(Path(__file__).with_name("mistakes.txt"), mistake)


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


MUCH = (
    "loss 5% 50% delay 10ms 11ms 5% delay 1ms 1ms distribution normal lossrel 50% reorder 5% "
    "blackout 1s-2s loss gemodel 1% 10% 70% 0.1% corrupt 1% duplicate 1% rate 1mbit codel mansd 3 "
    "first limit 7"
)


class Explain:
    """Runs the program and returns its output."""

    def __init__(self, capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> None:
        self._capsys, self._patch = capsys, patch

    def __call__(self, *arguments: str, columns: int = 80) -> str:
        self._patch.setenv("COLUMNS", str(columns))
        assert main(["--explain", *arguments]) == 0
        out, err = self._capsys.readouterr()
        assert err == ""
        return out


@pytest.fixture
def explain(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Explain:
    return Explain(capsys, monkeypatch)


def test_words_are_explained(explain: Explain) -> None:
    out = " ".join(explain("loss burst 5% 3 mansd 2 first").split())
    assert "the bad state begins with probability 1.75439% per packet" in out
    assert "mansd 2 the cap (M − 1): at most 2 consecutive packets of a flow are not delivered" in out
    assert "first the first packet of each flow is always delivered" in out
    assert "expected loss rate: 3.947% (without the guarantee 5%)" in out
    assert "tc qdisc add dev DEVICE root netem limit 16384 loss gemodel" in out
    assert "tc lacks: mansd 2 (a cap on consecutive losses), first (that the first" in out
    # A trace is shown by its name, not by its 2178 packets.
    trace = explain("replay", "rural_n8_10kmh", "from", "2s", "share", "50%")
    assert "2178 packets in 129.6 s" in " ".join(trace.split())
    assert 'file = "rural_n8_10kmh", offset_s = 2.0, delay_share = 0.5' in trace
    assert len(trace) < 2000


def test_the_explanation_fits_into_a_terminal_and_commands_are_complete(explain: Explain) -> None:
    commands = set()
    for columns in (200, 60, 30):
        tables = explain(MUCH, "--both", columns=columns).partition("\nas a file of links")[0]
        assert columns == 30 or max(map(len, tables.splitlines())) <= columns
        out = explain("delay 10ms 2ms distribution normal loss gemodel 1%", columns=columns)
        command = out[out.index("tc qdisc") :].partition("\ndifference")[0]
        commands.add(" ".join(command.replace("\\\n", "").split()))
    assert commands == {
        "tc qdisc add dev DEVICE root netem limit 16384 delay 10ms 2ms distribution normal "
        "loss gemodel 1% 99% 100% 0%"
    }


FORWARD = "forward, from clients to the server"
REVERSE = "reverse, from the server to clients"


@pytest.mark.parametrize(
    ("arguments", "titles"),
    [
        ("", ["both directions, each by itself: no impairment"]),
        (f"{MUCH} --seed 9 --listen [::1]:7 --to 192.0.2.1:53",
         [f"{FORWARD}, in this order", f"{REVERSE}: no impairment"]),
        (f"--reverse {MUCH}", [f"{FORWARD}: no impairment", f"{REVERSE}, in this order"]),
        ("rate 1mbit --both --idle 5s", ["both directions, each by itself, in this order"]),
        ("--one-way delay 0 samples 1ms,2ms",
         [f"{FORWARD}, in this order", "reverse: not relayed; the server's answers are discarded"]),
    ],
)  # fmt: skip
def test_each_direction_is_explained_and_written_as_a_file_of_links(
    explain: Explain, tmp_path: Path, arguments: str, titles: list[str]
) -> None:
    given = shlex.split(arguments)
    shown, _, file = explain(*given).partition("(--links)\n")
    lines = shown.splitlines()
    assert [line for line in lines if line.startswith(("forward,", "reverse", "both"))] == titles
    path = tmp_path / "links.toml"
    path.write_text(file)
    assert load_links(path) == specs_of(parser().parse_intermixed_args(["--explain", *given]))


LINKS = """
[[link]]
name = "uplink"
listen = "127.0.0.1:9000"
to = "[::1]:9001"
words = "loss 50% mansd 4"
reverse = "delay 10ms"
seed = 7

[[link]]
name = "video"
listen = "127.0.0.1:9002"
to = "127.0.0.1:9003"
return_path = false
words = "loss 20%"
"""


def test_links_are_explained_as_json(explain: Explain, tmp_path: Path) -> None:
    path = tmp_path / "links.toml"
    path.write_text(LINKS)
    assert max(map(len, explain("--links", str(path), columns=60).splitlines())) <= 60
    uplink, video = json.loads(explain("--json", "--links", str(path)))["links"]
    assert [uplink[key] for key in ("name", "listen", "to", "seed")] == [
        "uplink", "127.0.0.1:9000", "[::1]:9001", 7,
    ]  # fmt: skip
    forward = uplink["forward"]
    assert forward["predicted_loss"] == pytest.approx(15 / 31)
    assert forward["predicted_loss_without_cap"] == pytest.approx(0.5)
    assert forward["tc"] == "limit 16384 loss random 50%"
    assert forward["tc_lacks"] == ["mansd 4 (a cap on consecutive losses)"]
    for side, words in (("forward", "loss 50% mansd 4"), ("reverse", "delay 10ms")):
        assert uplink[side]["words"] == words
        settings = LinkSettings.model_validate_json(json.dumps(uplink[side]["settings"]))
        assert settings == settings_of(words)
    assert (video["forward"]["words"], video["reverse"]) == ("loss 20%", None)
