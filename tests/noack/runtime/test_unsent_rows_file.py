"""The file of rows that a process on another host keeps: one per run, private, readable when damaged."""

import json
import stat
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given
from hypothesis import strategies as st

from netem.core.errors import NoackError
from noack.runtime.unsent_rows_file import KeptFile, KeptHead, read_kept

HEAD = KeptHead(run="0001", process="sensor", secret="s")


def kept(folder: Path, head: KeptHead = HEAD) -> KeptFile:
    file = KeptFile(folder, head)
    file.append("sensor_measurement", json.dumps({"first": 7}).encode(), b"rows\n{}")
    file.append("notices", json.dumps({"first": 0}).encode(), b"{}")
    file.keep_report({"ended": "horizon"})
    return file


def test_what_was_kept_is_read_again(tmp_path: Path) -> None:
    file = kept(tmp_path / "runs" / "one")
    assert file.path == tmp_path / "runs" / "one" / "sensor.spool"
    assert stat.S_IMODE(file.path.stat().st_mode) == 0o600
    head, parts = read_kept(file.path)
    assert head == HEAD
    found = [(part.table, part.first, content) for part, content in parts]
    assert found[:2] == [("sensor_measurement", 7, b"rows\n{}"), ("notices_sensor", 0, b"{}")]
    table, _, report = found[2]
    assert table == "report"
    assert json.loads(report) == {"ended": "horizon", "process": "sensor"}


def test_what_two_runs_with_one_directory_keep_stays_apart(tmp_path: Path) -> None:
    """Runs of two recorders that began in one second, with processes on one host."""
    nothing = KeptFile(tmp_path / "run", HEAD)
    assert not (tmp_path / "run").exists()  # nothing is left of a run that kept nothing
    del nothing
    kept(tmp_path / "run")
    other = kept(tmp_path / "run", HEAD.model_copy(update={"run": "0002"}))
    assert other.path.name == "sensor-0002.spool"
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"sensor.spool", "sensor-0002.spool"}


@given(st.integers(0, 400), st.binary(max_size=8), st.booleans())
def test_a_damaged_file_gives_whole_parts_or_an_error(at: int, junk: bytes, truncated: bool) -> None:
    with TemporaryDirectory() as folder:
        path = kept(Path(folder)).path
        whole = path.read_bytes()
        path.write_bytes(whole[:at] + junk + (b"" if truncated else whole[at + len(junk) :]))
        with suppress(NoackError):
            _, parts = read_kept(path)
            for part, content in parts:
                assert len(content) == part.bytes
