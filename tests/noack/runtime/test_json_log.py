"""Standard error as JSON Lines."""

import errno
import io
import json
import math
import sys
from pathlib import Path

import pytest

from noack.core.errors import ExitStatus
from noack.runtime.command_line import (
    LogFormat,
    log_event,
    log_format,
    print_to_stderr,
    report_failure,
    why_not_written,
)
from tests.helpers.command_line import invoke
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


def test_a_mistake_becomes_a_json_object() -> None:
    done = invoke("run", "nowhere", "--log-format", "jsonl")
    (line,) = objects(done.stderr)
    assert (done.exit_code, line["level"]) == (2, "error")
    assert line["message"].startswith("nowhere: no such file")


def test_a_failure_quotes_the_beginning_of_a_very_long_word(capsys: pytest.CaptureFixture[str]) -> None:
    message = f"--seed {'9' * 5000}: an integer is too large"
    report_failure(message, ExitStatus.CALLER, source="noack", as_json=True)
    output = capsys.readouterr()
    line = f"--seed {'9' * 77}... (5,000 characters): an integer is too large"
    assert output.err == f"noack: {line}\n"
    assert json.loads(output.out)["error"] == line
    path = "/folder" * 60
    report_failure(path, ExitStatus.CALLER, source="noack", as_json=False)
    assert capsys.readouterr().err == f"noack: {path}\n"


def test_an_error_about_a_file_names_the_file() -> None:
    error = OSError(errno.ENAMETOOLONG, "", "a/file")
    assert why_not_written(error) == "a/file: File name too long"
    assert why_not_written(OSError(errno.ENOSPC, "")) == "cannot write: No space left on device"
