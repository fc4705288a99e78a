"""Words in the syntax of tc, and files with several links."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import tomli_w
from hypothesis import assume, given

from netem.relay_links import LinkSpec
from netem.tc_words import LinksFile, json_schema, load_links, parse, settings_of, text_of
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings
from noack.scenario import toml_file
from tests.netem.any_settings import settings, words_can_say

Given = dict[str, Any]
"""An impairment as in a settings file."""


def one(kind: str, **fields: Any) -> Given:
    return {"kind": kind, **fields}


def loss(model: str, **fields: Any) -> Given:
    return one("loss", loss={"model": model, **fields})


def chain(good_to_bad: float, bad_to_good: float, **fields: float) -> Given:
    return loss("gilbert_elliott", good_to_bad=good_to_bad, bad_to_good=bad_to_good, **fields)


def states(*shares: float) -> Given:
    return loss(
        "four_state", **dict(zip(("p13", "p31", "p32", "p23", "p14"), shares, strict=False))
    )


TEN_MS = one("delay", delay_s=0.01)


@pytest.mark.parametrize(
    ("words", "impairments"),
    [
        # Examples and defaults of the tc-netem manual page.
        ("loss 0.3% 25%", [loss("bernoulli", probability=0.003, correlation=0.25)]),
        ("loss state 10%", [states(0.1, 0.9)]),
        ("loss gemodel 1%", [chain(0.01, 0.99)]),
        ("loss gemodel 1% 10% 70% 0.1%", [chain(0.01, 0.1, loss_in_bad=0.7, loss_in_good=0.001)]),
        ("delay 100 10", [one("delay", delay_s=1e-4, jitter_s=1e-5)]),
        ("delay 10ms distribution paths/observed.txt",
         [one("delay", delay_s=0.01, distribution="empirical", file="paths/observed.txt")]),
        ("delay 10ms reorder 25% 50%", [TEN_MS, one("reorder", probability=0.25, correlation=0.5)]),
        ("delay 10ms gap 5", [TEN_MS, one("reorder", gap=5)]),
        ("rate 5kbit 20 100 5",
         [one("rate", rate_bps=5000, overhead_bytes=20, cell_bytes=100, cell_overhead_bytes=5)]),
        # Words that tc does not have.
        ("loss burst 5% 2.5", [loss("gilbert_elliott", mean_loss=0.05, mean_burst=2.5)]),
        ("loss periodic 2/100 from 7", [loss("periodic", period=100, burst=2, first=7)]),
        ("loss trace 'a file.txt' once", [loss("trace", file="a file.txt", repeat=False)]),
        ("loss script 3,4 every 20", [loss("scripted", lost=[3, 4], repeat_every=20)]),
        ("loss worst", [loss("worst_case")]),
        ("rate 1mbit queue 20", [one("rate", rate_bps=1_000_000, queue=20)]),
        ("outages 'my file' every 1s", [one("blackout", file="my file", every_s=1.0)]),
        ("replay 'a b' once from 20s by time share 50% relative",
         [one("replay", file="a b", by="time", repeat=False, offset_s=20.0, delay_share=0.5,
              clocks_differ=True)]),
        ("replay records 0+1.000001ms,2us+lost from random",
         [one("replay", sent_ns=[0, 2000], delays_ns=[1_000_001, -1], offset_s="random")]),
        ("opportunities t.up queue 5 bytes 3000 overhead -4 from random",
         [one("opportunities", file="t.up", queue=5, queue_bytes=3000, overhead_bytes=-4,
              offset_s="random")]),
        ("blackout 0-10ms,1s-1.5s every 2s",
         [one("blackout", intervals_s=[[0.0, 0.01], [1.0, 1.5]], every_s=2.0)]),
        ("delay 1ms samples -0.5ms,0,2ms",
         [one("delay", delay_s=1e-3, distribution="empirical", samples_s=[-5e-4, 0.0, 2e-3])]),
        ("loss 5% delay 10ms 1ms lossrel 80%",
         [loss("bernoulli", probability=0.05),
          one("delay", delay_s=0.01, jitter_s=1e-3, loss_correlation=0.8)]),
    ],
)  # fmt: skip
def test_words_are_parsed_into_impairments(words: str, impairments: list[Given]) -> None:
    parsed = parse(words)
    expected = LinkSettings.model_validate_json(json.dumps({"impairments": impairments}))
    assert parsed == (expected, None)
    assert settings_of(text_of(expected)) == expected


def test_settings_may_come_anywhere_and_impairments_keep_their_order() -> None:
    words = "mansd 4 delay 10ms limit 50 loss 5% seed 7 delay 1ms first"
    settings, seed = parse(words)
    assert (settings.mansd, settings.limit, settings.first_delivered, seed) == (4, 50, True, 7)
    assert [one.kind for one in settings.impairments] == ["delay", "loss", "delay"]
    assert text_of(settings) == "delay 10ms loss 5% delay 1ms mansd 4 first limit 50"
    text = "loss trace 'my file' mansd 4"
    for listed in (["loss", "trace", "my file", "mansd", "4"], ["loss trace 'my file'", "mansd 4"]):
        assert settings_of(listed) == settings_of(text)
        assert text_of(settings_of(listed)) == text


@given(settings)
def test_all_settings_survive_being_written_and_read(settings: LinkSettings) -> None:
    assume(words_can_say(settings))  # another test covers refused settings
    text = text_of(settings)
    assert settings_of(text) == settings
    assert "'" in text or settings_of(text.split()) == settings


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("lsos 5%", "lsos: no such word; did you mean loss?"),
        ("d 5ms", "d: words are not shortened; did you mean delay or drop or duplicate?"),
        ("loss", "loss: a value is missing: a percentage, e.g. 5%, or one of random, state,"),
        ("loss -1%", "loss -1%: no such word; expected one of"),
        ("loss 5% 100%", "loss 5% 100%: expected a correlation from 0% to below 100%, e.g. 25%"),
        ("loss state 90% 20% 81%", "loss state 90% 20% 81%: p31: p31 + p32 must not exceed 1"),
        ("loss periodic 2", "loss periodic 2: expected losses per packets, e.g. 2/100"),
        ("loss script 3,x", "loss script 3,x: expected the numbers of the lost packets"),
        ("delay", "delay: a value is missing: a time in s, ms, us or ns, e.g. 10ms"),
        ("loss 1e999%", "loss 1e999%: expected a percentage from 0% to 100%"),
        ("delay 1e999ms", "delay 1e999ms: expected a time in s, ms, us or ns, e.g. 10ms"),
        ("delay 1ms lossrel 5%", "lossrel: needs a loss before it"),
        ("delay 4000s", "delay 4000s: delay_s should be less than or equal to 3600"),
        ("delay 1e99999999999999999999ms", "ms: expected a time in s, ms, us or ns, e.g. 10ms"),
        ("delay 1ms distribution normal", "distribution normal: has no effect without jitter"),
        ("delay 1ms loss 5% lossrel 5%", "lossrel: goes right after delay TIME"),
        ("delay 1ms samples 1,2", "delay 1ms samples 1,2: expected delays with their units"),
        ("reorder 25%", "reorder 25%: nothing before it delays a packet; it goes after delay"),
        ("delay 1ms gap 5 reorder 25%", "reorder 25%: there is a reorder, or a gap, before it; "),
        ("delay 1ms reorder 25% gap x", "gap x: expected a whole number, e.g. 5"),
        ("rate 1mb", "rate 1mb: expected a rate in bit, kbit, mbit, gbit, kbps (bytes!)"),
        ("rate 0", "rate 0: rate_bps should be greater than or equal to 1"),
        ("rate 1mbit 0 48 -5", "rate 1mbit 0 48 -5: cell_overhead_bytes should be greater than"),
        ("replay t.csv once by time once", "replay t.csv once by time once: there is one already"),
        ("replay t.csv by chance", "by chance: by should be 'packet' or 'time'"),
        ("replay records 0s+1ms,2ms", "expected records of sending time and delay, in whole ns"),
        ("replay records 0s+1ms,0.1ns+lost", "lost: expected records of sending time"),
        ("replay records 1s+1ms", "sent_ns: must begin with 0, must not descend"),
        ("replay records 0s+1ms,1s+1ms from 2s", "from 2s: offset_s: the trace lasts 2s"),
        ("replay records 0s+3601s", "delays_ns: must be -1 to 3600000000000, one hour"),
        ("opportunities at 3,2", "opportunities at 3,2: times_ms: must not descend"),
        ("opportunities at 0", "opportunities at 0: times_ms: the last must not be 0"),
        ("loss trace 'a\nb", r"loss trace 'a\nb: a quotation is not closed"),
        ("blackout 2s", "blackout 2s: expected intervals of time, e.g. 2s-3s,5s-5500ms"),
        ("mansd -1", "mansd -1: expected a whole number, e.g. 5"),
        ("mansd 4 mansd 4", "mansd: given twice"),
        ("seed 18446744073709551616", "seed 18446744073709551616: should be less than 1844674"),
        ("slot 800us", "slot: this emulator does not gather packets into slots"),
    ],
)
def test_a_mistake_gets_one_line_that_names_the_word(words: str, says: str) -> None:
    with pytest.raises(CallerError) as caught:
        parse(words)
    line = str(caught.value)
    assert says in line
    assert "\n" not in line


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


CONTRADICTIONS = [
    (one("delay", distribution="empirical"), "samples_s"),
    (one("replay", sent_ns=[0], delays_ns=[1], clocks_differ=True), "clocks_differ"),
    (loss("four_state", p13=0.6, p31=0.1, p14=0.6), "p13"),
    (loss("gilbert_elliott", mean_loss=0.1, mean_burst=2.0, state="link"), "step_s"),
    (loss("gilbert_elliott", mean_loss=0.1, mean_burst=2.0, loss_in_bad=0.5), "mean_loss"),
    (loss("gilbert_elliott", mean_loss=0.1, mean_burst=2.0, step_s=0.1), "step_s"),
    (chain(0.1, 0.1, mean_loss=0.1), "mean_loss"),
    (loss("gilbert_elliott", good_to_bad=0.1), "good_to_bad"),
    (loss("periodic", period=2, burst=3), "burst"),
    (one("blackout", intervals_s=[[0.0, 2.0]], every_s=1.0), "every_s"),
]


@pytest.mark.parametrize(
    ("content", "line"),
    [
        *(
            ({"link": [LINK | {"forward": {"impairments": [wrong]}}]}, f"link.0.forward.*{key}")
            for wrong, key in CONTRADICTIONS
        ),
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
