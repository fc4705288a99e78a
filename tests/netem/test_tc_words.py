"""Words in the syntax of tc, and files with several links."""

import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import tomli_w
from hypothesis import assume, given

from netem.relay.relay_links import LinkSpec
from netem.tc_words import LinksFile, json_schema, load_links, parse, settings_of, words_of
from noack.impairments.link_settings import LinkSettings
from noack.scenario import toml_file
from tests.helpers.approved import compare_lines, lines_of_error
from tests.noack.impairments.any_link_settings import settings, words_can_say


def test_words_are_the_approved_impairments() -> None:
    def impairments(words: str) -> list[str]:
        parsed, seed = parse(words)
        assert seed is None
        assert settings_of(words_of(parsed)) == parsed
        return [one.model_dump_json(exclude_unset=True) for one in parsed.impairments]

    compare_lines(Path(__file__).with_name("word_settings.txt"), impairments)


def test_settings_may_come_anywhere_and_impairments_keep_their_order() -> None:
    words = "mansd 4 delay 10ms limit 50 loss 5% seed 7 delay 1ms first"
    settings, seed = parse(words)
    assert (settings.mansd, settings.limit, settings.first_delivered, seed) == (4, 50, True, 7)
    assert [one.kind for one in settings.impairments] == ["delay", "loss", "delay"]
    assert words_of(settings) == "delay 10ms loss 5% delay 1ms mansd 4 first limit 50"
    text = "loss trace 'my file' mansd 4"
    for listed in (["loss", "trace", "my file", "mansd", "4"], ["loss trace 'my file'", "mansd 4"]):
        assert settings_of(listed) == settings_of(text)
        assert words_of(settings_of(listed)) == text


@given(settings)
def test_all_settings_survive_being_written_and_read(settings: LinkSettings) -> None:
    assume(words_can_say(settings))  # another test covers refused settings
    text = words_of(settings)
    assert settings_of(text) == settings
    assert "'" in text or settings_of(text.split()) == settings


def test_the_lines_about_mistakes_are_those_that_were_approved() -> None:
    compare_lines(
        Path(__file__).with_name("word_mistakes.txt"), lambda words: lines_of_error(lambda: parse(words))
    )


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
def test_all_settings_can_be_written_as_a_table_or_in_words(settings: LinkSettings) -> None:
    table = settings.model_dump(mode="json", exclude_none=True)
    link: dict[str, Any] = LINK | {"forward": table}
    links = toml_file.validated(LinksFile, tomllib.loads(tomli_w.dumps({"link": [link]})), "here")
    assert links.link[0].forward == settings
    if words_can_say(settings):
        link["forward"] = words_of(settings)
        links = toml_file.validated(LinksFile, {"link": [link]}, "here")
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
