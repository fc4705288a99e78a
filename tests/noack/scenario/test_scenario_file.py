"""Every mistake in a scenario gives one line; a file is checked before it is parsed."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from cosim.studies.campaign.campaign_file import load as load_campaign
from netem.core import toml_file
from netem.core.errors import CallerError
from netem.core.toml_limits import MOST_LEVELS
from netem.links_file import load_links
from noack.scenario.resolution import resolve, resolved_loops
from noack.scenario.scenario_file import dumps, load, put, validate, value_of
from tests.helpers.approved import compare_lines

SHIPPED = sorted((Path(__file__).parents[3] / "scenarios").glob("*.toml"))
Content = dict[str, Any]

LANE = """
name = "lane"
horizon_s = 20.0
model = { name = "lane_following" }
[plant]
draw = "uniform"
uncertainty_A = [[0.1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
initial_state = [0.5, 0.0, 0.1, 3.0]
[trigger]
beta = 0.5
alpha_per_s = 0.25
[network]
mansd = 4
loss = { model = "bernoulli", probability = 0.8 }
[ports]
plant = 47001
"""

DOUBLE = """
name = "double"
horizon_s = 1.0
model = { A = [[0, 1], [0, 0]], B = [[0], [1]], gain = [[-1, -1.5]] }
plant = { initial_state = [1, 0] }
trigger = { beta = 0.5, alpha_per_s = 0.25 }
network = { mansd = 2, loss = { model = "worst_case" } }
"""


def mistakes(text: str, folder: Path, lines: Sequence[str] = ()) -> list[str]:
    """The error message for a scenario file with these ``key=value`` settings added."""
    return mistakes_with(content_with(text, lines), folder, ())


def content_with(text: str, lines: Sequence[str]) -> str:
    content = tomllib.loads(text)
    for line in lines:
        key, _, value = line.partition("=")
        put(content, key, value_of(value, key), key)
    return tomli_w.dumps(content)


def mistakes_with(text: str, folder: Path, settings: Sequence[str]) -> list[str]:
    """The error message for these settings, with the file's name shortened to FILE."""
    path = folder / "some.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CallerError) as caught:
        resolve(load(path, settings))
    return str(caught.value).replace(str(path), "FILE").split("\n")


_SUGGESTED = re.compile(r"(?:try|e\.g\.|% is|, or) (\[.*\]|[\d.]+)$")


def test_the_lines_about_mistakes_are_those_that_were_approved(tmp_path: Path) -> None:
    """``APPROVE=1 pytest`` writes them anew: read the difference. What they suggest is valid."""
    page, text = Path(__file__).with_name("mistakes.txt"), ""
    lines: list[str] = []
    for line in page.read_text(encoding="utf-8").splitlines():
        if line.startswith("    "):
            continue
        lines.append(line)
        if line.startswith("# "):
            text = {"# LANE": LANE, "# DOUBLE": DOUBLE}[line]
        elif text:
            about = mistakes(text, tmp_path, line.split(" & "))
            lines += [f"    {mistake.removeprefix('FILE: ')}" for mistake in about]
            if suggested := _SUGGESTED.search(about[0]):
                key = about[0].removeprefix("FILE: ").partition(" = ")[0].removesuffix(".0")
                right = [*line.split(" & "), f"{key}={suggested[1]}", "model.allow_unstable=true"]
                validate(tomllib.loads(content_with(text, right)), "here")
    if os.environ.get("APPROVE"):
        page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert "\n".join(lines) + "\n" == page.read_text(encoding="utf-8")


def test_a_mistake_in_a_setting_is_not_attributed_to_the_file(tmp_path: Path) -> None:
    def about(line: str) -> list[str]:
        return mistakes_with(LANE, tmp_path, line.split(" & "))

    compare_lines(Path(__file__).with_name("setting_mistakes.txt"), about)
    wrong = LANE.replace('name = "lane"', "name = 1", 1)
    (line,) = mistakes_with(wrong, tmp_path, ["trigger.beta=1"])  # this setting is valid
    assert line.startswith("FILE: name = 1: ")


def test_invalid_toml_is_reported_with_its_line(tmp_path: Path) -> None:
    compare_lines(
        Path(__file__).with_name("toml_mistakes.txt"),
        lambda text: mistakes_with(json.loads(text), tmp_path, ()),
    )


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenarios_are_unchanged_by_writing_and_reading(path: Path, tmp_path: Path) -> None:
    resolved = resolved_loops(load(path))
    copy = tmp_path / "copy.toml"
    for scenario in (load(path), *resolved):
        copy.write_text(dumps(scenario), encoding="utf-8")
        assert load(copy).model_dump() == scenario.model_dump()
    assert resolve(load(copy)).model_dump() == resolved[-1].model_dump()


# --- the file before it is parsed -----------------------------------------------------------------

MOST = MOST_LEVELS
READERS = [load, load_campaign, load_links]


def key(parts: int, part: str = "a", dot: str = ".") -> str:
    return dot.join([part] * parts)


LONG = key(MOST + 1)
TRICKY = [
    '"""a"b""c\\""""',  # ends in an escaped or extra quotation mark
    '"""\n#\n\\"""\n"""',
    "'''it's ''it'''''",
    '"\\"#\\\\"',
    "'\\'",
    '""',
]
"""Strings with an end that a simple parser misses."""


@pytest.mark.parametrize(
    "text",
    [
        f"{LONG} = 1",
        f"[{LONG}]",
        f"[[{LONG}]]",
        f"x = {{ {LONG} = 1 }}",
        f"x = [1.5, {{ {LONG} = 1 }}]",
        key(MOST + 1, '"a.b"', " . ") + " = 1",
        key(MOST + 1, "'#'", "\t.") + " = 1",
        *(f"x = [{string}, {{ {LONG} = '' }}, '']" for string in TRICKY),
        *(f"x = {string} # '\n{LONG} = '''\n'''" for string in TRICKY),
    ],
)
def test_long_key_is_refused_before_it_is_parsed(text: str) -> None:
    tomllib.loads(text)  # the text is valid TOML
    with pytest.raises(CallerError, match=rf"^here: a key has more than {MOST} parts$"):
        toml_file.parsed(text, "here")


@pytest.mark.parametrize("part", ["a", "a ", "a.b ", '"""\\', '"', "'''\\"])
def test_text_without_long_keys_is_checked_in_linear_time(part: str) -> None:
    """Quadratic time would need 2.5 · 10¹¹ steps and exceed the test's time limit."""
    with pytest.raises(CallerError, match=r"^here: not valid TOML"):
        toml_file.parsed(part * (500_000 // len(part)), "here")


LIMITED = """
import resource, sys
from pathlib import Path
from netem.core.toml_file import read
from tests.helpers.approved import compare_lines
from netem.core.errors import CallerError
usage = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
limit = usage + 64 * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
for path in sys.argv[1:]:
    try:
        read(Path(path))
    except CallerError as error:
        print(error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/proc and /dev of Linux")
def test_hostile_files_take_little_memory(tmp_path: Path) -> None:
    (tmp_path / "key.toml").write_text(f"{key(100_000)} = 1\n")
    (tmp_path / "large.toml").write_text("x = 1\n" * 200_000)
    (tmp_path / "endless.toml").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "fifo.toml")
    paths = sorted(map(str, tmp_path.glob("*.toml")))
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, *paths], capture_output=True, text=True, timeout=200
    )
    assert done.stderr == ""
    expected = [
        "endless.toml: cannot be read: not a regular file",
        "fifo.toml: cannot be read: not a regular file",
        "key.toml: a key has more than 32 parts",
        "large.toml: cannot be read: larger than 1 MiB",
    ]
    assert done.stdout.splitlines() == [f"{tmp_path}/{line}" for line in expected]


DEEP = "tables and lists lie within each other more than 32"


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (f"x = {'[' * 100}{']' * 100}", DEEP),
        (f"x = {'[' * 9999}{']' * 9999}", DEEP),
        (f"x = {('{' + key(30) + ' = ') * 100}1{'}' * 100}", DEEP),
        (f"x = 0x{'f' * 20_000}", "an integer is too large"),
        (f"x = {'9' * 20_000}", "an integer is too large"),
        ("x = 1\n" * 200_000, "cannot be read: larger than 1 MiB"),
    ],
    ids=["lists", "many lists", "tables", "hexadecimal", "decimal", "long"],
)
def test_every_reader_refuses_large_files_deep_tables_and_long_integers(
    tmp_path: Path, read: Callable[[Path], object], text: str, wrong: str
) -> None:
    path = tmp_path / "file.toml"
    path.write_text(f"link = 1\naxes = 1\nmodel = 1\n{text}")  # as each reader expects
    with pytest.raises(CallerError, match=f"^[^\n]*file.toml: {wrong}[^\n]*$"):
        read(path)


@pytest.mark.parametrize("key", ["controller.reference", "trigger.floor", "controller.update_timeout_s"])
def test_none_takes_a_key_out_that_may_be_absent(key: str) -> None:
    path = next(path for path in SHIPPED if path.stem == "servo_reference")
    section, _, field = key.partition(".")
    default = type(getattr(load(path), section)).model_fields[field].get_default(call_default_factory=True)
    assert getattr(getattr(load(path, [f"{key}=none"]), section), field) == default


def test_none_is_the_protocol_without_acknowledgements() -> None:
    """As a line about their table advises."""
    path = next(path for path in SHIPPED if path.stem == "lane_acknowledged")
    for words in ("network.protocol=none", 'network.protocol="none"'):
        assert load(path, [words]).network.protocol == "none"
    assert load(path, [words]).network.acknowledgements is not None


def test_none_takes_an_entry_out_and_a_text_in_quotes_stays() -> None:
    path = next(path for path in SHIPPED if path.stem == "servo_reference")
    entries = 'network.impairments=[{kind="delay", delay_s=0.001}, {kind="loss", model="lossless"}]'
    content = tomllib.loads(path.read_text())
    put(content, "network.impairments", value_of(entries.partition("=")[2], ""), "")
    put(content, "network.impairments.0", None, "")
    assert [entry["kind"] for entry in content["network"]["impairments"]] == ["loss"]
    assert load(path, ['description="none"']).description == "none"


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        (["trigger.flor=none"], "--set trigger.flor: unknown key; did you mean trigger.floor?"),
        (["trigger.beta=none"], "--set trigger.beta: missing"),
    ],
)
def test_a_key_that_cannot_be_taken_out(settings: list[str], line: str) -> None:
    with pytest.raises(CallerError, match=re.escape(line)):
        load(SHIPPED[0].with_name("servo_reference.toml"), settings)
