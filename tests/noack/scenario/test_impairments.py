"""Settings of a link that depend on each other, or on files."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from noack.core.errors import CallerError
from noack.impairments.kinds.delay import Delay
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.impairments.loss_models.trace import TraceLoss
from noack.impairments.loss_prediction import read_files
from noack.protocol.record_tables import Fate
from tests.oracles.link import Link


def test_a_delay_that_depends_on_the_loss_state_needs_a_loss_with_states() -> None:
    before = [{"kind": "loss", "loss": {"model": "worst_case"}}]
    late = {"kind": "delay", "jitter_s": 0.1, "loss_correlation": 0.5}
    with pytest.raises(ValidationError, match=r"impairments\.1\.loss_correlation: needs a loss"):
        LinkSettings.model_validate_json(json.dumps({"impairments": [*before, late]}))
    loss = {"kind": "loss", "loss": {"model": "bernoulli", "probability": 0.1}}
    LinkSettings.model_validate_json(json.dumps({"impairments": [*before, loss, late]}))


@given(st.floats(0, 0.99), st.floats(1, 1000))
def test_means_determine_the_chain(loss: float, burst: float) -> None:
    """Bursts last 1/r on average, the loss rate is p/(p + r); refused exactly if p exceeds 1."""
    if loss / (1 - loss) > burst:
        with pytest.raises(ValidationError, match="needs longer bursts"):
            GilbertElliottLoss(mean_loss=loss, mean_burst=burst)
        return
    p, r = GilbertElliottLoss(mean_loss=loss, mean_burst=burst).transitions
    assert 1 / r == pytest.approx(burst)
    assert p / (p + r) == pytest.approx(loss)


def read_delay(folder: Path, **settings: Any) -> Delay:
    delay = Delay(distribution="empirical", **settings)
    (read,) = read_files(LinkSettings(impairments=(delay,)), folder).impairments
    assert isinstance(read, Delay)
    return read


@pytest.mark.parametrize("repeat", [True, False])
def test_a_trace_drops_the_packets_it_marks(repeat: bool, tmp_path: Path) -> None:
    (tmp_path / "trace.txt").write_text("0100 1\n11\t0\r\n")
    settings = LinkSettings(impairments=(LossOf(loss=TraceLoss(file="trace.txt", repeat=repeat)),))
    link = Link(read_files(settings, tmp_path), 0, "test")
    fates = [link.decide(0, 100, 0).fate for _ in range(20)]
    marks = [int(mark) for mark in "01001110"]
    assert fates == (marks * 3 if repeat else marks + [0] * 12)[:20]
    assert Fate.DROPPED == 1


def test_observed_delays_have_units_comments_and_signs(tmp_path: Path) -> None:
    (tmp_path / "delays.txt").write_text("# from a ping\n0.01\n12.5ms\n\n300 us\n-5ns\n1e-3\n")
    delay = read_delay(tmp_path, delay_s=0.02, file="delays.txt")
    assert delay.samples_s == pytest.approx((0.01, 0.0125, 3e-4, -5e-9, 1e-3), rel=1e-15)
    assert (delay.file, delay.longest_s) == (None, pytest.approx(0.0325))
    assert Delay(jitter_s=0.1, distribution="normal").shortest_s == 0.0
    assert delay.delay_s == 0.02


def test_a_tc_distribution_table_is_scaled_by_the_jitter(tmp_path: Path) -> None:
    (tmp_path / "some.dist").write_text("# a table\n -8192 -4096 0\n 8192 16384\n")
    delay = read_delay(tmp_path, delay_s=0.02, jitter_s=0.002, file="some.dist")
    assert delay.samples_s == pytest.approx((-0.002, -0.001, 0, 0.002, 0.004), rel=1e-15)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "cannot be read: No such file or directory"),
        (b"01x1", "has a 'x'; a trace is of 0 and 1, and white space"),
        (b"01\xff", "has a 'ÿ'; a trace is of 0 and 1"),
        (b" \n", "is empty; a trace has a 1 for each lost packet"),
    ],
)
def test_a_mistake_in_a_trace_gets_one_line(
    content: bytes | None, says: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "t").write_bytes(content)
    settings = LinkSettings(impairments=(LossOf(loss=TraceLoss(file="t")),))
    with pytest.raises(CallerError) as caught:
        read_files(settings, tmp_path, "l.toml: link.0.reverse")
    assert str(caught.value).startswith(
        f'l.toml: link.0.reverse.impairments.0.loss.file = "t": {says}'
    )


@pytest.mark.parametrize(
    ("name", "jitter_s", "content", "says"),
    [
        ("t", 0.0, None, "cannot be read: No such file or directory"),
        ("t", 0.0, "0.01\nslow\n", "line 2: slow: expected one delay, e.g. 0.0125 or 12.5ms"),
        ("t", 0.0, "0.01\n1h\n", "line 2: 1h: expected one delay"),
        ("t", 0.0, "# nothing\n0.01\n", "has 1 delays; expected 2 to 1000000"),
        ("t", 0.0, "0.01\n4000\n", "has a delay beyond 3600 s"),
        ("t", 0.001, "0.01\n0.02\n", "observed delays are taken as they are, and have no jitter"),
        ("t.dist", 0.0, "1 2 3", "a distribution table is scaled by the jitter, which is 0"),
        ("t.dist", 0.001, "1 2\n0.5", "line 2: 0.5: expected whole numbers, 8192 for 1"),
    ],
)
def test_a_mistake_in_a_delay_file_gets_one_line(
    name: str, jitter_s: float, content: str | None, says: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(CallerError) as caught:
        read_delay(tmp_path, jitter_s=jitter_s, file=name)
    assert str(caught.value).startswith(f"{name}: {says}")
