"""``netem explain`` describes links in tables and as JSON."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from netem.__main__ import main
from netem.emulator_options import command_line_parser as parser
from netem.emulator_options import specs_of
from netem.tc_words import load_links, settings_of
from noack.impairments.link_settings import LinkSettings

PAGE = (Path(__file__).parents[3] / "docs/netem-control.md").read_text()
MUCH = (
    "loss 5% 50% delay 10ms 11ms distribution normal lossrel 50% reorder 5% blackout 1s-2s "
    "loss gemodel 1% 10% 70% 0.1% duplicate 1% rate 1mbit mansd 3 first limit 7"
)
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


class Explain:
    """Runs the program and returns its output."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: str) -> str:
        assert main(["--explain", *arguments]) == 0
        out, err = self._capsys.readouterr()
        assert err == ""
        return out

    def links(self, *arguments: str) -> Any:
        document = json.loads(self("--json", *arguments))
        assert list(document) == ["links"]
        return document["links"]


@pytest.fixture
def explain(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Explain:
    monkeypatch.setenv("COLUMNS", "80")
    return Explain(capsys)


@pytest.fixture
def links_file(tmp_path: Path) -> Path:
    path = tmp_path / "links.toml"
    path.write_text(LINKS)
    return path


def one_line(text: str) -> str:
    return " ".join(text.split())


def test_words_are_explained(explain: Explain) -> None:
    out = one_line(explain("loss burst 5% 3 mansd 2 first"))
    assert "the bad state begins with probability 1.75439% per packet" in out
    assert (
        "mansd 2 the cap (M − 1): at most 2 consecutive packets of a flow are not delivered" in out
    )
    assert "first the first packet of each flow is always delivered" in out
    assert "expected loss rate: 3.947% (without the guarantee 5%)" in out
    assert "tc qdisc add dev DEVICE root netem limit 16384 loss gemodel" in out
    assert "tc lacks: mansd 2 (a cap on consecutive losses), first (that the first" in out


@pytest.mark.parametrize(
    ("arguments", "titles"),
    [
        ("", ["both directions, each by itself: no impairment"]),
        ("loss 5%", ["forward, from clients to the server, in this order",
                     "reverse, from the server to clients: no impairment"]),
        ("--reverse loss 5%", ["forward, from clients to the server: no impairment",
                            "reverse, from the server to clients, in this order"]),
        ("loss 5% --reverse loss 6%", ["forward, from clients to the server, in this order",
                                    "reverse, from the server to clients, in this order"]),
        ("--both loss 5%", ["both directions, each by itself, in this order"]),
        ("--one-way loss 5%", ["forward, from clients to the server, in this order",
                               "reverse: not relayed; the server's answers are discarded"]),
    ],
)  # fmt: skip
def test_each_direction_is_explained(explain: Explain, arguments: str, titles: list[str]) -> None:
    lines = explain(*shlex.split(arguments)).splitlines()
    assert [line for line in lines if line.startswith(("forward", "reverse", "both"))] == titles


def test_a_trace_is_shown_by_its_name(explain: Explain) -> None:
    out = explain("replay", "rural_n8_10kmh", "from", "2s", "share", "50%")
    assert "2178 packets in 129.6 s" in " ".join(out.split())
    assert 'file = "rural_n8_10kmh", offset_s = 2.0, delay_share = 0.5' in out
    assert len(out) < 2000


@pytest.mark.parametrize("columns", [120, 60])
def test_the_explanation_fits_into_a_terminal(
    explain: Explain, links_file: Path, monkeypatch: pytest.MonkeyPatch, columns: int
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    tables = explain(MUCH, "--both").partition("\nas a file of links")[0]
    for out in (tables, explain("--links", str(links_file))):
        assert max(map(len, out.splitlines())) <= columns


def test_commands_to_copy_are_complete_at_any_width(
    explain: Explain, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = set()
    for columns in ("200", "60", "30"):
        monkeypatch.setenv("COLUMNS", columns)
        out = explain("delay 10ms 2ms distribution normal loss gemodel 1% 10% 70% 0.1%")
        command = out[out.index("tc qdisc") :].partition("\ndifference")[0]
        commands.add(tuple(command.replace("\\\n", "").split()))
    whole = (
        "tc qdisc add dev DEVICE root netem limit 16384 delay 10ms 2ms distribution normal "
        "loss gemodel 1% 10% 70% 0.1%"
    )
    assert commands == {tuple(whole.split())}


@pytest.mark.parametrize(
    "arguments",
    [
        MUCH,
        f"--reverse {MUCH} --seed 9 --listen [::1]:7 --to 192.0.2.1:53",
        "loss 5% --both --idle 5s",
        "delay 0 samples 1ms,2ms --one-way",
        "",
    ],
)
def test_the_toml_output_equals_the_command_line_settings(
    explain: Explain, tmp_path: Path, arguments: str
) -> None:
    given = shlex.split(arguments)
    path = tmp_path / "links.toml"
    path.write_text(explain(*given).partition("(--links)\n")[2])
    expected = specs_of(parser().parse_intermixed_args(["--explain", *given]))
    assert load_links(path) == expected


def test_links_are_explained_as_json(explain: Explain, links_file: Path) -> None:
    uplink, video = explain.links("--links", str(links_file))
    assert (uplink["name"], uplink["listen"], uplink["to"], uplink["seed"]) == (
        "uplink", "127.0.0.1:9000", "[::1]:9001", 7,
    )  # fmt: skip
    assert uplink["forward"]["predicted_loss"] == pytest.approx(15 / 31)
    assert uplink["forward"]["predicted_loss_without_cap"] == pytest.approx(0.5)
    assert uplink["forward"]["tc"] == "limit 16384 loss random 50%"
    assert uplink["forward"]["tc_lacks"] == ["mansd 4 (a cap on consecutive losses)"]
    assert uplink["reverse"] is not None
    assert uplink["reverse"]["words"] == "delay 10ms"
    assert (video["forward"]["words"], video["reverse"]) == ("loss 20%", None)


def test_each_direction_is_explained_as_json(explain: Explain) -> None:
    (link,) = explain.links("delay 10ms loss 5%", "--reverse", "corrupt 1%")
    assert link["name"] == "relay"
    for side, words in (("forward", "delay 10ms loss 5%"), ("reverse", "corrupt 1%")):
        assert link[side]["words"] == words
        settings = LinkSettings.model_validate_json(json.dumps(link[side]["settings"]))
        assert settings == settings_of(words)


def rows(title: str) -> set[str]:
    (table,) = re.findall(rf"^\| {title} \| \|\n\|---\|---\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    return {
        name for row in table.splitlines() for name in re.findall("`(\\w+)`", row.split("|")[1])
    }


def test_every_key_is_documented_and_no_other(explain: Explain) -> None:
    (link,) = explain.links("loss 5%")
    assert rows("explained link") == link.keys()
    assert rows("explained direction") == link["forward"].keys()
