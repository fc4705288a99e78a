"""Captures that were misread, by the command: each has its right numbers."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.helpers.command_line import invoke

CASES = Path(__file__).parents[2] / "cases"


def measured(name: str, *words: str) -> dict[str, Any]:
    result = invoke("measure", CASES / name, *words, "--json")
    assert result.exit_code == 0, result.output
    return dict(json.loads(result.stdout))


@pytest.mark.parametrize(
    ("name", "words", "lost", "longest"),
    [
        ("keepalive8.pcap.gz", "--sequence-at 111:1", 3, 2),
        ("count14.pcap.gz", "--sequence-at 2:2 --bits 14", 9, 4),
        ("count1_255.pcap.gz", "--sequence-at 12:1 --numbers 1..255", 37, 1),
        ("iperf2_end.pcap.gz", "--sequence-at 0:4", 5, 3),
    ],
)
def test_a_capture_is_measured(name: str, words: str, lost: int, longest: int) -> None:
    document = measured(name, *words.split())
    assert document["lost"] == document["effective_losses"] == lost
    assert document["longest"]["losses"] == longest
    assert not document["losses_ambiguous"]


def test_the_end_of_a_stream_of_iperf2_costs_no_delays() -> None:
    document = measured("iperf2_end.pcap.gz", "--sequence-at", "0:4", "--deadline", "50ms")
    assert document["packets"] == 501
    assert document["delays_unknown"] is None
    assert 0 < document["jitter_s"]["last_s"] <= document["jitter_s"]["largest_s"] < 1e-3


def test_a_counter_of_several_receivers_is_refused() -> None:
    result = invoke("measure", CASES / "shared_counter8.pcap.gz", "--sequence-at", "12:1")
    assert result.exit_code == 2
    assert "96 % of the numbers at 12:1 are missing: they count more than this flow" in result.stderr


@pytest.mark.filterwarnings("error")
def test_one_datagram_at_both_ends_is_measured() -> None:
    document = measured("both_ends_1.pcapng")
    assert (document["packets"], document["lost"]) == (1, 0)


def test_the_terminal_begins_with_the_sentence_of_the_page(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    words = ("--sequence-at", "0:4", "--out", page)
    lines = invoke("measure", CASES / "iperf2_end.pcap.gz", *words).stdout.splitlines()
    assert lines[0].endswith("iperf2_end.pcap.gz: at most 3 lost in a row")
    sentence = "At most 3 packets in a row were not effectively delivered."
    assert lines[1] == sentence
    assert sentence in page.read_text()
