"""``netem explain`` describes links in tables and as JSON."""

import json
import shlex
from pathlib import Path

import pytest

from netem.__main__ import main
from netem.emulator_options import command_line_parser as parser
from netem.emulator_options import specs_of
from netem.tc_words import load_links, settings_of
from noack.impairments.link_settings import LinkSettings

MUCH = (
    "loss 5% 50% delay 10ms 11ms distribution normal lossrel 50% reorder 5% blackout 1s-2s "
    "loss gemodel 1% 10% 70% 0.1% duplicate 1% rate 1mbit mansd 3 first limit 7"
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
    assert (
        "mansd 2 the cap (M − 1): at most 2 consecutive packets of a flow are not delivered" in out
    )
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
        ("loss 5% --both --idle 5s", ["both directions, each by itself, in this order"]),
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
