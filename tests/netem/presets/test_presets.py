"""Presets: each has a source and words that reproduce it; ``like NAME`` stands for its words."""

import json
from pathlib import Path

import numpy as np
import pytest

from netem.__main__ import main
from netem.core.errors import CallerError
from netem.emulator_options import command_line_parser, parse_options, specs_of
from netem.impairments.kinds.delay import Delay
from netem.impairments.kinds.rate import Rate
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import expected_loss
from netem.link_state import LinkState
from netem.links_file import load_links
from netem.lossy_udp import LossyUdp
from netem.measurement.measured_preset import fitted_words
from netem.measurement.network_measurement import MeasurementOptions, NetworkMeasurement
from netem.measurement.trace_sources import read_files
from netem.presets.preset import Direction, Preset, find_preset, load_preset, shipped_presets
from netem.tc_words import parse, preset_names, settings_of, words_of
from netem.traces.packet_trace import find_trace

PRESETS = shipped_presets()
DIRECTIONS: tuple[Direction, ...] = ("forward", "reverse")
OWN = """
name = "office"
sentence = "An office"
forward = "loss 1% delay 5ms"
reverse = "delay 7ms"
fit = "by hand"
is_guess = true
"""


def of_preset(preset: Preset) -> dict[Direction, LinkSettings]:
    return {direction: settings_of(preset.words(direction)) for direction in DIRECTIONS}


def delay_s(settings: LinkSettings, share: float) -> float:
    """The quantile of the delay, without the time in a queue; at most one delay is random."""
    delays = [impairment for impairment in settings.impairments if isinstance(impairment, Delay)]
    samples = [delay.samples_s for delay in delays if delay.samples_s is not None]
    assert len(samples) < 2
    assert not any(delay.jitter_s for delay in delays)
    random_s = float(np.quantile(samples[0], share)) if samples else 0.0
    return sum(delay.delay_s for delay in delays) + random_s


def test_at_least_twelve_presets_have_a_source_and_none_is_a_guess() -> None:
    assert len([preset for preset in PRESETS.values() if preset.source and not preset.is_guess]) >= 12
    for name, preset in PRESETS.items():
        assert preset.name == name
        assert preset.source_text
        # The numbers can be compared: published ones, or those of a shipped trace.
        assert preset.published or (preset.source and preset.source.trace)


@pytest.mark.parametrize("name", PRESETS)
def test_the_words_of_a_preset_have_the_numbers_of_its_source(name: str) -> None:
    settings = of_preset(PRESETS[name])
    for numbers in PRESETS[name].published:
        sides: tuple[Direction, ...] = DIRECTIONS if numbers.of == "round_trip" else (numbers.of,)
        for share, published_s in numbers.delay_s.items():
            both_s = sum(delay_s(settings[side], float(share)) for side in sides)
            assert both_s == pytest.approx(published_s, abs=numbers.within_s + 1e-12)
        if numbers.loss_rate is not None:
            rate = expected_loss(settings[sides[0]]).rate
            assert rate == pytest.approx(numbers.loss_rate, rel=0.01)
        if numbers.rate_bps is not None:
            rates = [one.rate_bps for one in settings[sides[0]].impairments if isinstance(one, Rate)]
            assert rates == [numbers.rate_bps]


@pytest.mark.parametrize("name", [name for name, one in PRESETS.items() if one.source and one.source.trace])
def test_the_fit_to_a_shipped_trace_is_repeated(name: str) -> None:
    """The same words, and a link with them loses and delays as the trace."""
    preset = PRESETS[name]
    assert preset.source is not None
    assert "--deadline 100ms" in preset.fit
    trace = read_files([find_trace(preset.source.trace)])
    measurement = NetworkMeasurement(trace, MeasurementOptions(deadline_s=0.1))
    assert settings_of(fitted_words(measurement)) == settings_of(preset.forward)
    link = LinkState(settings_of(preset.forward), 1, "link")
    link.start_flow(0, 0)
    period_ns = int(trace.sent_ns[-1]) // (len(trace) - 1)
    sent_ns = np.arange(16_000) * period_ns
    release_ns = np.array([link.decide(0, 100, at_ns).release_ns for at_ns in sent_ns.tolist()])
    delays_ms = (release_ns - sent_ns)[release_ns >= 0] / 1e6
    effective_ms = trace.delay_ns[measurement.outcomes.effective] / 1e6
    for share in (0.5, 0.9):
        expected = np.quantile(effective_ms, share)
        assert np.quantile(delays_ms, share) == pytest.approx(expected, rel=0.15)
    loss_rate = measurement.bursts.losses / len(trace)
    assert expected_loss(settings_of(preset.forward)).rate == pytest.approx(loss_rate, rel=0.02)


def test_like_stands_for_the_words_and_more_may_follow() -> None:
    forward = settings_of("like dsl mansd 4")
    assert words_of(forward) == f"{PRESETS['dsl'].forward} mansd 4"
    assert settings_of("like dsl", direction="reverse") == settings_of(PRESETS["dsl"].reverse)
    assert words_of(settings_of("loss 1% like satellite-geo ordered")) == "loss 1% delay 279ms ordered"
    assert parse(["like dsl", "like cable"]).presets == ("dsl", "cable")
    assert preset_names("loss 1% like dsl like './my file.toml'") == ("dsl", "./my file.toml")


def command_line(*arguments: str) -> tuple[LinkSettings, LinkSettings]:
    (spec,) = specs_of(parse_options(command_line_parser(), ["--explain", *arguments]))
    return spec.forward, spec.reverse


def test_each_direction_has_its_own_words_of_the_preset() -> None:
    dsl = of_preset(PRESETS["dsl"])
    with_cap = {direction: dsl[direction].model_copy(update={"mansd": 4}) for direction in DIRECTIONS}
    assert command_line("like", "dsl", "mansd", "4") == (with_cap["forward"], dsl["reverse"])
    assert command_line("--both", "like", "dsl", "mansd", "4") == tuple(with_cap.values())
    assert command_line("like", "dsl", "--reverse", "loss", "1%") == (dsl["forward"], settings_of("loss 1%"))
    assert command_line("--reverse", "like dsl mansd 4") == (LinkSettings(), with_cap["reverse"])
    assert command_line("--one-way", "like", "dsl") == (dsl["forward"], LinkSettings())


def test_a_file_of_links_has_presets_and_those_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "office.toml").write_text(OWN)
    links = tmp_path / "links.toml"
    link = '[[link]]\nname = "{}"\nlisten = ":0"\nto = ":9"\nforward = "{}"\n'
    links.write_text(
        link.format("a", "like ./office.toml mansd 2")
        + link.format("b", "like dsl")
        + 'reverse = "loss 2%"\n'
        + link.format("c", "like dsl")
        + "return_path = false\n"
    )
    own, both, one_way = load_links(links)
    assert words_of(own.forward) == "loss 1% delay 5ms mansd 2"
    assert words_of(own.reverse) == "delay 7ms"
    assert words_of(both.reverse) == "loss 2%"
    assert words_of(one_way.reverse) == ""
    links.write_text(link.format("a", "like zebra"))
    message = 'link.0.forward = "like zebra": like zebra: no preset zebra; noack-netem --presets lists them'
    with pytest.raises(CallerError) as error:
        load_links(links)
    assert str(error.value) == f"{links}: {message}"


def test_a_link_within_a_program_has_presets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("office.toml").write_text(OWN)
    with LossyUdp("127.0.0.1:9", "like ./office.toml mansd 2") as link:
        assert link.forward["words"] == "loss 1% delay 5ms mansd 2"
        assert link.reverse["words"] == "delay 7ms"
        link.change("like dsl", directions=("forward", "reverse"))
        assert [link.forward["words"], link.reverse["words"]] == [
            words_of(settings) for settings in of_preset(PRESETS["dsl"]).values()
        ]
    with LossyUdp("127.0.0.1:9", "like dsl", reverse="") as link:
        assert link.reverse["words"] == ""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("star-link", "no preset star-link; did you mean starlink?"),
        ("5g", "no preset 5g; did you mean 5g-arterial or 5g-rural or 5g-urban?"),
        ("wifi", "no preset wifi; did you mean wifi-busy or wifi-campus?"),
        ("zebra", "no preset zebra; noack-netem --presets lists them"),
        ("./office", "no preset ./office; the name of a preset's file ends in .toml"),
        ("absent.toml", "absent.toml: no such file"),
    ],
)
def test_a_wrong_name_names_the_near_ones(name: str, message: str) -> None:
    with pytest.raises(CallerError) as error:
        find_preset(name)
    assert str(error.value) == message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("loss 1%", "loss 200%"), "like FILE: forward: loss 200%: expected a percentage"),
        (("delay 7ms", "like dsl"), "like FILE: reverse: a preset cannot name another preset"),
        (("delay 7ms", "delay 7ms seed 3"), "like FILE: reverse: seed 3: belongs to the link"),
        (("is_guess = true", ""), "like FILE: FILE: source: missing; name the source"),
        (("is_guess", "is_gues"), "like FILE: FILE: is_gues = true: unknown key; did you mean is_guess?"),
    ],
)
def test_a_mistake_in_a_preset_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: tuple[str, str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path("office.toml")
    path.write_text(OWN.replace(*change))
    with pytest.raises(CallerError) as error:
        [settings_of(["like", str(path)], direction=direction) for direction in DIRECTIONS]
    assert str(error.value).replace(str(path), "FILE").startswith(message)
    assert "\n" not in str(error.value)


def test_the_list_has_name_words_and_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--presets"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert main(["--presets", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["presets"]
    assert [one["name"] for one in listed] == list(PRESETS)
    for preset in PRESETS.values():
        assert preset.name in text
        assert preset.sentence in text
    assert "delay 25ms rate 384kbit" in text
    assert "RFC 2488" in text


def test_an_explanation_shows_what_the_preset_stands_for(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--explain", "like", "satellite-geo", "mansd", "4"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "like satellite-geo: A geostationary satellite" in text
    assert "https://www.rfc-editor.org/rfc/rfc2488" in text
    assert "delays each packet by 279ms" in text
    assert main(["--explain", "--json", "like", "dsl"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["presets"][0]["forward"] == document["links"][0]["forward"]["words"]
    Path("office.toml").write_text(OWN)
    Path("links.toml").write_text(
        '[[link]]\nname = "a"\nlisten = ":0"\nto = ":9"\nwords = "like office.toml"\n'
    )
    assert main(["--explain", "--links", "links.toml"]) == 0
    assert "a guess: nobody has published these numbers" in capsys.readouterr().out
    assert load_preset(Path("office.toml")).is_guess
