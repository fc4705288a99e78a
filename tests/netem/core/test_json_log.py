"""Standard error as JSON Lines."""

import io
import math
import sys
from pathlib import Path

import pytest

from netem.core.command_line import LogFormat, log_event, log_format, print_to_stderr, report_failure
from netem.core.errors import ExitStatus
from tests.helpers.json_log import objects


def standard_error(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def test_each_line_of_the_log_becomes_a_json_object(monkeypatch: pytest.MonkeyPatch) -> None:
    error = standard_error(monkeypatch)
    with log_format(LogFormat.JSONL):
        print_to_stderr("noack: warning: no disk")
        print_to_stderr("noack netem: ready")
        print("a plain", "\x1b[31mline\x1b[0m\n\nand one\tmore", file=sys.stderr)
        report_failure("wrong\ntwice", ExitStatus.CALLER, source="noack netem", as_json=False)
    print_to_stderr("text again")
    *lines, last = error.getvalue().splitlines()
    assert last == "text again"
    lines = [(line["level"], line["source"], line["message"]) for line in objects("\n".join(lines))]
    assert lines == [
        ("warning", "noack", "no disk"),
        ("info", "noack netem", "ready"),
        ("info", "noack", "a plain line"),
        ("info", "noack", r"and one\tmore"),
        ("error", "noack netem", "wrong"),
        ("error", "noack netem", "twice"),
    ]


def test_an_event_has_its_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    error = standard_error(monkeypatch)
    assert not log_event("info", "noack", "text", event="progress")
    with log_format(LogFormat.JSONL):
        assert log_event("info", "noack", "m", event="progress", x=math.inf, n=3, p=Path("a"))
        (line,) = objects(error.getvalue())
        error.close()  # as a closed pipe, it is ignored
        assert log_event("info", "noack", "m")
    assert (line["event"], line["x"], line["n"], line["p"]) == ("progress", None, 3, "a")
