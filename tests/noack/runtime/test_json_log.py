"""Standard error as JSON Lines."""

import io
import json
import math
import sys
import threading
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cosim.cli import app
from netem.__main__ import main
from noack.core.errors import ExitStatus
from noack.runtime.command_line import (
    JsonLog,
    LogFormat,
    failed,
    log_event,
    log_format,
    print_to_stderr,
)

Object = dict[str, Any]


def objects(text: str) -> list[Object]:
    found = [json.loads(line) for line in text.splitlines()]
    for one in found:
        assert {"time", "level", "source", "message"} <= one.keys()
        assert one["time"].endswith("Z")
    return found


def standard_error(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def test_lines_become_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    error = standard_error(monkeypatch)
    with log_format(LogFormat.JSONL):
        print_to_stderr("noack: warning: no disk")
        print_to_stderr("noack netem: ready")
        print("a plain", "\x1b[31mline\x1b[0m\n\nand one\tmore", file=sys.stderr)
        failed("wrong\ntwice", ExitStatus.CALLER, who="noack netem", as_json=False)
    print_to_stderr("text again")
    *lines, last = error.getvalue().splitlines()
    assert last == "text again"
    found = [(one["level"], one["source"], one["message"]) for one in objects("\n".join(lines))]
    assert found == [
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
    (found,) = objects(error.getvalue())
    assert (found["event"], found["x"], found["n"], found["p"]) == ("progress", None, 3, "a")


def test_threads_do_not_mix_their_lines() -> None:
    error = io.StringIO()
    stream = JsonLog(error)

    def write(name: str) -> None:
        for _ in range(50):
            for part in (name, name, "\n"):
                stream.write(part)

    threads = [threading.Thread(target=write, args=(name,)) for name in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    messages = [one["message"] for one in objects(error.getvalue())]
    assert sorted(messages) == ["aa"] * 50 + ["bb"] * 50 + ["cc"] * 50


def test_a_closed_pipe_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stderr", Closed())
    with log_format(LogFormat.JSONL):
        print_to_stderr("noack: warning: no reader")
        assert log_event("info", "noack", "m")


def test_a_mistake_is_an_object() -> None:
    done = CliRunner().invoke(app, ["run", "nowhere", "--log-format", "jsonl"])
    (found,) = objects(done.stderr)
    assert (done.exit_code, found["level"]) == (2, "error")
    assert found["message"].startswith("nowhere: no such file")


def test_an_emulator_logs_json_lines(capfd: pytest.CaptureFixture[str]) -> None:
    words = ["--listen", "192.0.2.1:9", "--to", "127.0.0.1:9", "loss", "5%"]
    assert main([*words, "--log-format", "jsonl"]) == ExitStatus.CALLER
    (found,) = objects(capfd.readouterr().err)
    assert (found["level"], found["source"]) == ("error", "noack netem")
