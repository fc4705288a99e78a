"""The file of a timetable: what it says, and the lines about its mistakes."""

import json
from pathlib import Path

import pytest

from netem.__main__ import main
from netem.core.clock import NS_PER_S
from netem.emulator_options import command_line_parser, parse_options, specs_of, timetable_of
from netem.impairments.link_settings import LinkSettings
from netem.links_file import load_links, load_timetable
from netem.relay.relay_links import LinkSpec
from netem.relay.timetable import TimedChange
from netem.tc_words import settings_of
from netem.timetable_file import MOST_CHANGES, TimetableFile, read_timetable
from tests.helpers.approved import compare_lines, lines_of_error

HERE, THERE = ("127.0.0.1", 0), ("127.0.0.1", 9)
LINKS = {
    "one": [LinkSpec("one", HERE, THERE, LinkSettings(), LinkSettings())],
    "two": [
        LinkSpec("up", HERE, THERE, settings_of("mansd 4"), LinkSettings()),
        LinkSpec("video", HERE, THERE, LinkSettings(), LinkSettings(), return_path=False),
    ],
}


def read(folder: Path, text: str, links: str = "one", repeat_s: float | None = None) -> TimetableFile:
    path = folder / "drive.csv"
    path.write_text(text)
    return read_timetable(path, LINKS[links], None if repeat_s is None else round(repeat_s * NS_PER_S))


def test_a_file_gives_the_changes_of_links_and_directions(tmp_path: Path) -> None:
    (tmp_path / "lost.txt").write_text("01")
    text = (
        "\ufeffwords, time_s,link,direction\n\n# a comment\n"
        "delay 5ms,0,up,both\n"
        '"blackout 1s-2s,3s-4s",.5,video,\n'
        "loss trace lost.txt,1.000000001,up,reverse\n"
        "like dsl,2,up,both\n"
    )
    delay, dsl = settings_of("delay 5ms"), settings_of("like dsl")
    assert read(tmp_path, text, "two", 60).timetable.changes == (
        TimedChange(0, "up", "forward", delay),
        TimedChange(0, "up", "reverse", delay),
        TimedChange(500_000_000, "video", "forward", settings_of("blackout 1s-2s,3s-4s")),
        TimedChange(1_000_000_001, "up", "reverse", settings_of("loss script 1 every 2")),
        TimedChange(2_000_000_000, "up", "forward", dsl),
        TimedChange(2_000_000_000, "up", "reverse", settings_of("like dsl", direction="reverse")),
    )
    assert dsl != settings_of("like dsl", direction="reverse")


def test_the_lines_about_mistakes_are_those_that_were_approved(tmp_path: Path) -> None:
    def mistakes(line: str) -> list[str]:
        text, _, links = line.partition(" [")
        lines = text.replace("; ", "\n")
        return lines_of_error(lambda: read(tmp_path, lines, links.rstrip("]") or "one", 60), FOLDER=tmp_path)

    compare_lines(Path(__file__).with_name("timetable_mistakes.txt"), mistakes)


def test_all_mistakes_of_a_file_are_reported_up_to_ten(tmp_path: Path) -> None:
    lines = lines_of_error(lambda: read(tmp_path, "time_s,words\n" + "0,lsos\n" * 15), FOLDER=tmp_path)
    assert len(lines) == 11
    assert lines[-1] == "FOLDER/drive.csv: 5 more mistakes"
    many = "time_s,words\n" + "".join(f"{k},loss none\n" for k in range(MOST_CHANGES + 2))
    (line,) = lines_of_error(lambda: read(tmp_path, many), FOLDER=tmp_path)
    assert line == "FOLDER/drive.csv: has more than 100000 changes"


def test_a_guarantee_that_ends_is_named(tmp_path: Path) -> None:
    text = "time_s,link,words\n1,up,loss 5% mansd 2\n2,video,loss 5%\n3,up,loss 5%\n"
    file = read(tmp_path, text, "two")
    line = f"{tmp_path}/drive.csv: line 4: forward no longer has mansd 2; the words replace all settings"
    assert [*file.notes(LINKS["two"])] == [line]
    assert file.summary == "3 changes of settings, the last at 3 s"


LINKS_TOML = """
timetable = "drive.csv"
timetable_repeat_s = 2.5
[[link]]
name = "up"
listen = ":0"
to = ":9"
"""


def test_a_file_of_links_or_the_command_line_names_the_timetable(tmp_path: Path) -> None:
    (tmp_path / "links.toml").write_text(LINKS_TOML)
    (tmp_path / "drive.csv").write_text("time_s,words\n0,loss 5%\n")

    def timetable(*arguments: str) -> TimetableFile | None:
        options = parse_options(command_line_parser(), arguments)
        return timetable_of(options, specs_of(options))

    named = timetable("--links", str(tmp_path / "links.toml"))
    given = timetable("--explain", "--timetable", str(tmp_path / "drive.csv"), "--repeat", "2500ms")
    assert named is not None
    assert given is not None
    assert named.lines[0].words == given.lines[0].words == "loss 5%"
    assert named.repeat_ns == given.repeat_ns == 2_500_000_000
    assert timetable("--explain", "loss", "5%") is None


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--repeat", "5s"), "--repeat 5s: is for --timetable FILE"),
        (("--timetable", "drive.csv", "--repeat", "x"),
         "--repeat x: expected a time in s, ms, us or ns, e.g. 10ms"),
        (("--timetable", "drive.csv", "--repeat", "1us"), "--repeat 1us: must be 1ms or more"),
        (("--timetable", "none.csv"), "none.csv: cannot be read: No such file or directory"),
        (("--timetable", "drive.csv", "--links", "links.toml"),
         "--timetable drive.csv: links.toml has a timetable already"),
    ],
)  # fmt: skip
def test_a_mistake_on_the_command_line_is_one_line(
    arguments: tuple[str, ...], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("links.toml").write_text(LINKS_TOML)
    Path("drive.csv").write_text("time_s,words\n0,loss 5%\n")
    assert main(["--explain", *arguments]) == 2
    assert capsys.readouterr().err == f"noack-netem: {line}\n"


def test_an_explanation_shows_the_timetable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    lines = ["0,loss 5%,both", "2,loss 10% mansd 1,", *(f"{k},loss none," for k in range(4, 60))]
    Path("drive.csv").write_text("\n".join(["time_s,words,direction", *lines]))
    arguments = ["--explain", "mansd", "4", "--timetable", "drive.csv", "--repeat", "60s"]
    assert main(arguments) == 0
    text = capsys.readouterr().out
    timetable, _, file = text[text.index("timetable") :].partition("as a file of links (--links)\n")
    shown = [" ".join(line.split()) for line in timetable.splitlines()]
    assert shown[:4] == [
        "timetable drive.csv: 59 changes of settings, the last at 59 s, repeated every 60 s",
        "time direction words expected loss rate",
        "0 s both loss 5% 5%",
        "2 s forward loss 10% mansd 1 9.091%",
    ]
    assert "and 8 further lines; --json has all" in shown
    Path("links.toml").write_text(file)
    options = parse_options(command_line_parser(), arguments)
    from_file = load_timetable(Path("links.toml"), load_links(Path("links.toml")))
    assert from_file == timetable_of(options, specs_of(options))
    assert "drive.csv: line 2: forward no longer has mansd 4; the words replace all settings" in shown
    assert main([*arguments, "--json"]) == 0
    timetable = json.loads(capsys.readouterr().out)["timetable"]
    assert (timetable["file"], timetable["repeat_s"], len(timetable["changes"])) == ("drive.csv", 60.0, 59)
    assert timetable["changes"][1] == {
        "time_s": 0.0, "link": "relay", "direction": "reverse", "words": "loss 5%",
        "predicted_loss": pytest.approx(0.05),
    }  # fmt: skip
