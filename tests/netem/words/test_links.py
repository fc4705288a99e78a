"""Files with several links."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import tomli_w
from hypothesis import given

from netem.relay_links import LinkSpec
from netem.tc_words import LinksFile, json_schema, load_links, settings_of, text_of
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings
from noack.scenario import toml_file
from tests.netem.any_settings import settings, words_can_say

ROOT = Path(__file__).parents[3]

TWO = """
[[link]]
name = "uplink"
listen = "127.0.0.1:9000"
to = "127.0.0.1:9001"
words = "delay 10ms loss 5% mansd 4"
seed = 7

[[link]]
name = "video"
listen = "[::1]:0"
to = ":9003"
return_path = false
idle_s = 5
most_clients = 10
forward.impairments = [
    { kind = "loss", loss = { model = "gilbert_elliott", mean_loss = 0.05, mean_burst = 3 } },
    { kind = "delay", delay_s = 0.02 },
]
reverse = "loss trace lost.txt"
"""


def load(text: str, folder: Path) -> tuple[LinkSpec, ...]:
    (folder / "lost.txt").write_text("010")
    path = folder / "links.toml"
    path.write_text(text, encoding="utf-8")
    return load_links(path)


def test_links_are_given_in_words_or_tables(tmp_path: Path) -> None:
    uplink, video = load(TWO, tmp_path)
    ends = ("127.0.0.1", 9000), ("127.0.0.1", 9001)
    words = settings_of("delay 10ms loss 5% mansd 4")
    assert uplink == LinkSpec("uplink", *ends, words, LinkSettings(), seed=7)
    both = settings_of("loss burst 5% 3 delay 20ms"), settings_of("loss script 1 every 3")
    others = {"return_path": False, "idle_s": 5.0, "most_clients": 10}
    assert video == LinkSpec("video", ("::1", 0), ("::1", 9003), *both, **others)


@given(settings)
def test_all_settings_can_be_written_as_a_table_or_in_words(settings: LinkSettings) -> None:
    table = settings.model_dump(mode="json", exclude_none=True)
    link: dict[str, Any] = LINK | {"forward": table}
    links = toml_file.validated(LinksFile, tomllib.loads(tomli_w.dumps({"link": [link]})), "here")
    assert links.link[0].forward == settings
    if words_can_say(settings):
        link["forward"] = text_of(settings)
        links = toml_file.validated(LinksFile, {"link": [link]}, "here")
        assert links.link[0].forward == settings


LINK = {"name": "a", "listen": ":9000", "to": ":9001"}


MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"words": "delay 10ms losss 5%"}, 'words = "delay 10ms losss 5%": losss: no such word; '),
    ({"words": "seed 3"}, 'words = "seed 3": seed 3: belongs to the link, not to one of its '),
    ({"words": "", "forward": ""}, 'words = "": is short for forward; give one of them'),
    ({"words": 3}, "words = 3: should be a table"),
    ({"reverse": {"mandsd": 3}}, "reverse.mandsd = 3: unknown key; did you mean mansd?"),
    ({"reverse": {"impairments": [{"kind": "dely"}]}}, 'reverse.impairments.0.kind = "dely": '
     "must be one of blackout, corrupt, delay, duplicate, loss, opportunities, rate, reorder, "),
    ({"forward": "loss trace nothing.txt"}, 'forward.impairments.0.loss.file = "nothing.txt": '
     "cannot be read: No such file or directory"),
    ({"name": "a b"}, 'name = "a b": use letters, digits, _ and -'),
    ({"listen": "9000"}, "listen: expected HOST:PORT, e.g. 127.0.0.1:9000, [::1]:9000 or "),
    ({"idle_s": 0}, "idle_s = 0: should be greater than 0"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("content", "line"),
    [
        *(({"link": [LINK | link]}, re.escape(f"link.0.{line}")) for link, line in MISTAKES),
        ({}, r"link: missing \(the links, \[\[link\]\] each\)"),
        ({"links": [LINK], "link": [LINK]}, "links = .*: unknown key; did you mean link?"),
        ({"link": [LINK, LINK]}, 'link.1.name = "a": another link has this name already'),
        ({"link": [LINK, LINK | {"name": "b"}]}, 'link.1.listen = ":9000": link a listens '),
    ],
)
def test_a_mistake_gets_one_line(content: dict[str, Any], line: str, tmp_path: Path) -> None:
    with pytest.raises(CallerError) as caught:
        load(tomli_w.dumps(content), tmp_path)
    assert re.match(f"{tmp_path}/links.toml: {line}", str(caught.value)), caught.value
    assert "\n" not in str(caught.value)


def test_the_published_schema_is_that_of_the_code() -> None:
    """``noack schema --netem > docs/netem.schema.json`` updates the published schema."""
    published = json.loads((ROOT / "docs/netem.schema.json").read_text(encoding="utf-8"))
    assert published == json_schema()
    jsonschema.Draft202012Validator.check_schema(published)
    validator = jsonschema.Draft202012Validator(published)
    assert [error.message for error in validator.iter_errors(tomllib.loads(TWO))] == []
    for wrong in ({}, {"link": []}, {"link": [LINK | {"reverse": 3}]}, {"link": [LINK | {"x": 3}]}):
        assert not validator.is_valid(wrong)
