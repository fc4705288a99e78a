"""A settings file is checked before it is parsed: its size, depth and key length are bounded."""

import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from cosim.studies.campaign.campaign_file import load as load_campaign
from netem.tc_words import load_links
from noack.core.errors import CallerError
from noack.scenario import toml_file
from noack.scenario.scenario_file import load, put, validate
from noack.settings.section import ScenarioSection
from noack.settings.user_files import NamedFile

MOST = toml_file.MOST_LEVELS
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
from noack.scenario.toml_file import read
from noack.core.errors import CallerError
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
    path.write_text(text)
    with pytest.raises(CallerError, match=f"^[^\n]*file.toml: {wrong}[^\n]*$"):
        read(path)


def test_the_key_of_a_setting_has_a_maximum_length() -> None:
    content: dict[str, object] = {}
    put(content, key(MOST), 1, "--set")
    with pytest.raises(CallerError, match=r"^--set: the key has more than 32 parts$"):
        put(content, key(MOST + 1), 1, "--set")


def test_the_number_of_further_mistakes_is_given() -> None:
    with pytest.raises(CallerError) as caught:
        validate({f"a{i}": 0 for i in range(100)}, "here")
    lines = str(caught.value).splitlines()
    assert len(lines) == 51
    assert lines[-1] == "here: 56 more mistakes"  # 6 required keys are missing, too


class _Named(ScenarioSection):
    name: str
    note: str = ""


def test_a_missing_file_suggests_only_files_of_its_type(tmp_path: Path) -> None:
    (tmp_path / "one.toml").write_text("name = 'one'\nmore = 1")
    (tmp_path / "nine.toml").write_text("name = ")
    (tmp_path / "tone.toml").write_text("[project]\nname = 'other'")
    os.mkfifo(tmp_path / "nose.toml")
    with pytest.raises(CallerError) as caught:
        toml_file.read(tmp_path / "none.toml", _Named)
    near = f"did you mean {tmp_path}/one.toml?"
    assert str(caught.value) == f"{tmp_path}/none.toml: no such file; {near}"


def test_only_regular_files_are_read(tmp_path: Path) -> None:
    file = NamedFile("/dev/zero", tmp_path, "run.toml: network.loss")
    for read in (file.content, file.sha256):
        with pytest.raises(CallerError, match=r"cannot be read: not a regular file$"):
            read()
