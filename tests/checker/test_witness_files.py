"""``noack certify NAME --witness FILE`` and ``noack-check FILE``, from the command line."""

import json
import os
import re
from pathlib import Path

import pytest
from noack_check.__main__ import check_file, main
from typer.testing import CliRunner

from cosim.cli.application import app
from noack.core.errors import ExitStatus
from noack_check.check import RejectedError
from noack_check.keys import RefusedError
from noack_check.scenario import read_loop
from noack_check.sentences import assumptions, meaning
from tests.checker.proofs import use_stored
from tests.helpers.resolved_tables import resolved_tables

CASES = Path(__file__).parent.parent / "cases"


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("witness") / "pendulum.json"
    words = ["certify", "unstable_pendulum", "--witness", str(path), "--json"]
    with pytest.MonkeyPatch.context() as patch:
        use_stored(patch, "pendulum", "pendulum_ideal")
        result = CliRunner().invoke(app, words)
    assert result.exit_code == ExitStatus.OK
    certificates = json.loads(result.stdout)["certificates"]
    assert [certificate["under"] for certificate in certificates] == [
        "paper",
        "paper",
        "schedule",
        "schedule",
    ]
    assert all(certificate["proven"]["bounds"]["x"] for certificate in certificates)
    return path


@pytest.mark.parametrize("name", ["saturated_lqr", "lane_acknowledged"])
def test_what_has_no_witness_is_refused_before_anything_is_certified(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def certificates_of(*_: object, **__: object) -> None:
        raise AssertionError("a certificate is computed")

    monkeypatch.setattr("cosim.analysis.certificates.certificates_of", certificates_of)
    result = CliRunner().invoke(app, ["certify", name, "--witness", str(tmp_path / "w.json")])
    assert (result.exit_code, not any(tmp_path.iterdir())) == (ExitStatus.CALLER, True)


def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> tuple[int, str]:
    monkeypatch.setattr("sys.argv", ["noack-check", *words])
    try:
        main()
    except SystemExit as stop:
        captured = capsys.readouterr()
        return int(stop.code or 0), captured.out + captured.err
    return 0, capsys.readouterr().out


def test_the_program_prints_what_is_proven(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, text = run(capsys, monkeypatch, str(file))
    assert status == 0
    lines = text.splitlines()
    proven = [line for line in lines if line.startswith('PROVED "unstable_pendulum", ')]
    assumed = [line for line in lines if line.startswith("       if there are at most 3 consecutive losses")]
    assert (len(lines), len(assumed)) == (len(proven) + 4, 4)
    bound = re.search(r"its plant, its schedule: ‖x‖ ≤ (\S+) e", text)
    assert bound is not None
    assert 0.285 < float(bound[1]) < 0.42  # the first one is the largest that was found
    assert "losses, tests every 2 ms, updates act within 6 ms, inputs 0 to 7 ms old, the first" in text


def test_what_a_statement_assumes_is_printed(file: Path) -> None:
    content = json.loads(file.read_text())
    content["statements"] = content["statements"][:1]
    content["scenario"]["network"]["enforce_mansd"] = False
    content["scenario"]["changes"] = [{"at_s": 1.0, "key": "trigger.beta", "value": 0.1}]
    text = "\n".join(check_file(content, None))
    assert "losses, which nothing enforces, until the first change of settings" in text


def test_another_scenario_is_told_apart(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    resolved = CliRunner().invoke(app, ["check", "unstable_pendulum", "--resolved"]).stdout
    given = tmp_path / "resolved.toml"
    given.write_text(resolved)
    assert run(capsys, monkeypatch, str(file), "--scenario", str(given))[0] == 0
    given.write_text(resolved.replace("mansd = 3", "mansd = 4"))
    status, text = run(capsys, monkeypatch, str(file), "--scenario", str(given))
    what = "--scenario takes what `noack check NAME --resolved` prints"
    assert (status, text) == (1, f"REJECTED the witness is of another scenario, by its network; {what}\n")
    given.write_text("")
    status, text = run(capsys, monkeypatch, str(file), "--scenario", str(given))
    assert (status, text) == (1, "REJECTED --scenario: the file has no key\n")


def test_a_description_proves_nothing(file: Path) -> None:
    content = json.loads(file.read_text())
    given = {**content["scenario"], "description": "another text"}
    assert any(line.startswith("PROVED") for line in check_file(content, given))


def test_noise_is_an_assumption_and_errors_are_about_x() -> None:
    tables = resolved_tables("pendulum_observed")
    loop = read_loop(tables, box=False, ideal=False)
    assert "noise and disturbances within the scenario's bounds" in assumptions(tables, loop)
    assert "e_s and e_c are x_s − x and x_c − x" in meaning(tables, loop)


@pytest.mark.parametrize(
    ("section", "key", "value", "why"),
    [
        ("network", "mansd", 4, "edge|missing"),
        ("trigger", "beta", 0.03, "inter_event_s|start|flow|output"),
        ("plant", "initial_state", [0.3, 0.0], "start"),
        ("plant", "rate_hz", 250.0, "flow|inter_event_s|times"),
        ("network", "protocol", "ack", "network.protocol"),
        ("network", "actuation", {"mansd": 9}, "flow|inter_event_s|times|later|edge"),
        ("network", "actuation", {}, "network.actuation.mansd: missing"),
        ("controller", "safe_input", [1.0], "controller.safe_input"),
        ("trigger", "new_key", 1, "trigger.new_key: no statement covers this key"),
    ],
)
def test_a_changed_scenario_is_not_proven(
    file: Path, section: str, key: str, value: object, why: str
) -> None:
    content = json.loads(file.read_text())
    content["scenario"][section][key] = value
    content["statements"] = content["statements"][2:3]
    with pytest.raises(ValueError, match=why):
        list(check_file(content, None))


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"scenario": {}}', "[" * 100_000])
def test_files_that_are_no_witness_are_one_line(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "w.json"
    path.write_text(text)
    status, printed = run(capsys, monkeypatch, str(path))
    assert status in (1, 2)
    assert len(printed.splitlines()) == 1


def test_control_characters_do_not_reach_the_terminal(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, text = run(capsys, monkeypatch, str(CASES / "witness_escape.json"))
    assert status == 1
    assert text.removesuffix("\n").isprintable()
    assert r"controller.reference.\x1b]0;owned\x07\x1b[31m: no statement covers this key" in text
    status, text = run(capsys, monkeypatch, "\x1b[31m\u202e.json")
    assert (status, text.removesuffix("\n").isprintable()) == (2, True)


@pytest.mark.parametrize(
    ("name", "begins"),
    [
        (
            "lane_following, its plant, its schedule: ‖x‖ ≤ 0.001 e^(−9 t). Copy of g43",
            'PROVED "lane_following, its plant, its schedule: ‖x‖ ≤ 0.001 e^(−9 t). Copy of g43", ',
        ),
        ('a", its plant: ‖x‖ ≤ 0', r'PROVED "a\", its plant: ‖x‖ ≤ 0", '),
    ],
)
def test_a_name_that_reads_like_a_statement_is_quoted(file: Path, name: str, begins: str) -> None:
    content = json.loads(file.read_text())
    content["scenario"]["name"] = name
    lines = [line for line in check_file(content, None) if line.startswith("PROVED")]
    assert all(line.startswith(begins) for line in lines)


def test_a_name_of_an_output_that_reads_like_a_bound_is_quoted(file: Path) -> None:
    content = json.loads(file.read_text())
    content["scenario"]["outputs"][0]["name"] = "z| ≤ 1e-9, so |y"
    assert any('|"z| ≤ 1e-9, so |y"| ≤ ' in line for line in check_file(content, None))


def test_a_fifo_and_a_device_are_refused(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(fifo := tmp_path / "fifo")
    for words in ([fifo], [file, "--scenario", fifo], [file, "--equations", fifo], ["/dev/zero"]):
        status, text = run(capsys, monkeypatch, *map(str, words))
        assert (status, text.endswith(": not a regular file\n")) == (2, True)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (".".join("a" * 2000) + " = 1", "a key has more than 32 parts"),
        ("[" + ". ".join(['"a"'] * 2000) + "]", "a key has more than 32 parts"),
        ("a = " + "[" * 2000, "levels deep"),
        ("a = " + "1" * 5000, "an integer is too large"),
        ("a = ", "not a TOML file"),
    ],
)
def test_a_scenario_beyond_the_limits_is_refused_before_it_is_parsed(
    text: str, reason: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    given = tmp_path / "given.toml"
    given.write_text(text)
    status, printed = run(capsys, monkeypatch, str(file), "--scenario", str(given))
    assert (status, len(printed.splitlines())) == (2, 1)
    assert reason in printed


@pytest.mark.parametrize(
    ("place", "value", "why"),
    [
        (("scenario", "name"), "a\nPROVED b", "name"),
        (("scenario", "name"), None, "name"),
        (("statements", 0, "bounds"), [], "bounds: there is none"),
        (("statements", 0, "plants"), [], "no plants"),
        (("statements", 0, "conditions"), {}, "no plants or conditions"),
    ],
)
def test_hostile_entries_are_rejected(
    file: Path, place: tuple[str | int, ...], value: object, why: str
) -> None:
    content = json.loads(file.read_text())
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    with pytest.raises(ValueError, match=why):
        list(check_file(content, None))


def test_a_file_without_statements_proves_nothing() -> None:
    with pytest.raises(RejectedError, match="no statements"):
        list(check_file({"scenario": {}, "statements": []}, None))


@pytest.mark.parametrize("option", ["--scenario", "--equations"])
def test_an_option_is_given_once(
    option: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    status, text = run(capsys, monkeypatch, "w.json", option, "a", f"{option}=b")
    assert (status, f"argument {option}: is given twice; it takes one value" in text) == (2, True)


@pytest.mark.parametrize(
    ("place", "reason"),
    [
        (("scenario", "model", "A"), "model.A: more than 20,000 numbers"),
        (("scenario", "plant", "initial_state"), "plant.initial_state: more than 20,000 numbers"),
        (("scenario", "outputs"), "outputs: more than 1,000 tables"),
        (("statements", 2, "chain", "tail"), "tail: more than 100,000 numbers"),
    ],
)
def test_a_size_beyond_the_limits_is_refused_before_numbers_are_read(
    place: tuple[str | int, ...], reason: str, file: Path
) -> None:
    content = json.loads(file.read_text())
    row: list[object] = ["not a number"] * 2000
    values = {"A": [row] * 2000, "tail": [row] * 2000, "initial_state": row * 11, "outputs": [{}] * 1001}
    table = content
    for key in place[:-1]:
        table = table[key]
    assert place[-1] in table
    table[place[-1]] = values[str(place[-1])]
    with pytest.raises((RejectedError, RefusedError), match=re.escape(reason)):
        list(check_file(content, None))
