"""Files with several links."""

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import tomli_w
from hypothesis import given

from netem.core import toml_file
from netem.impairments.link_settings import LinkSettings
from netem.links_file import LinksFile, json_schema, load_links
from netem.relay.relay_links import LinkSpec
from netem.tc_words import settings_of
from tests.helpers.approved import compare_lines, lines_of_error
from tests.netem.impairments.any_link_settings import settings

ROOT = Path(__file__).parents[2]

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
def test_all_settings_can_be_written_as_a_table(settings: LinkSettings) -> None:
    table = settings.model_dump(mode="json", exclude_none=True)
    link: dict[str, Any] = LINK | {"forward": table}
    links = toml_file.validated(LinksFile, tomllib.loads(tomli_w.dumps({"link": [link]})), "here")
    assert links.link[0].forward == settings


LINK = {"name": "a", "listen": ":9000", "to": ":9001"}


def test_a_mistake_in_a_file_of_links_gives_the_approved_line(tmp_path: Path) -> None:
    def mistake(line: str) -> list[str]:
        given = json.loads(line)
        is_file = not given or given.keys() & {"link", "links"}
        text = tomli_w.dumps(given if is_file else {"link": [LINK | given]})
        return lines_of_error(lambda: load(text, tmp_path), FOLDER=tmp_path)

    compare_lines(Path(__file__).with_name("link_mistakes.txt"), mistake)


def test_the_published_schema_is_that_of_the_code() -> None:
    """``noack schema --netem > docs/netem.schema.json`` updates the published schema."""
    published = json.loads((ROOT / "docs/netem.schema.json").read_text(encoding="utf-8"))
    assert published == json_schema()
    jsonschema.Draft202012Validator.check_schema(published)
    validator = jsonschema.Draft202012Validator(published)
    assert [error.message for error in validator.iter_errors(tomllib.loads(TWO))] == []
    for wrong in ({}, {"link": []}, {"link": [LINK | {"reverse": 3}]}, {"link": [LINK | {"x": 3}]}):
        assert not validator.is_valid(wrong)
