"""Tables of results as CSV, and the files of library and command line."""

import csv
import io
from pathlib import Path
from typing import Any

import pytest

import noack
from cosim.output.run_tables import summary_tables
from cosim.output.table_files import save_tables
from netem.core.errors import CallerError
from netem.output import result_tables
from tests.helpers.command_line import invoke


def rows_of(path: Path) -> list[list[str]]:
    return list(csv.reader(io.StringIO(path.read_text())))


def test_units_move_to_the_heads() -> None:
    table = result_tables.ResultTable("t", "c", ("", "time", "mixed"), [
        ("a", "0.5 s", "1 s"), ("b", "12 s", "2 ms"), ("c", "−1.25 s", "-"),
    ])  # fmt: skip
    assert result_tables.as_csv(table) == ",time [s],mixed\na,0.5,1 s\nb,12,2 ms\nc,-1.25,\n"
    rows = result_tables.ResultTable(
        "t", "c", result_tables.KEY_VALUE, [("delay", "3 ms"), ("lost", "3 (60 %)")]
    )
    assert result_tables.as_csv(rows) == "quantity,value\ndelay [ms],3\nlost,3 (60 %)\n"


def test_tables_of_a_run_have_its_numbers(tmp_path: Path) -> None:
    simulated = noack.simulate(noack.load("lane_following", {"horizon_s": 4.0}))
    save_tables(summary_tables(simulated.summary), tmp_path)
    numbers, (loop,) = dict(rows_of(tmp_path / "numbers.csv")), simulated.summary.loops
    assert numbers["transmissions"] == str(loop.events)
    assert float(numbers["shortest inter-event time [s]"]) == pytest.approx(loop.inter_event_min_s, abs=5e-4)
    assert len(rows_of(tmp_path / "claims.csv")) == 1 + len(simulated.claims)


def test_the_library_writes_the_tables_of_the_command_line(tmp_path: Path) -> None:
    grid: dict[str, Any] = {
        "name": "losses", "scenario": "double_integrator", "draws": 2,
        "settings": {"horizon_s": 1.0},
        "axes": [{"name": "loss", "key": "network.loss.probability", "values": [0.2, 0.8]}],
    }  # fmt: skip
    margin = noack.margin("lane_periodic", most_mansd=1, period=False)
    for result, name in (
        (margin, "margin"), (noack.campaign(grid, workers=1), "campaign"),
        (noack.certify("double_integrator", search=False), "certificates"),
        (noack.simulate(noack.load("double_integrator", {"horizon_s": 0.1})), "numbers"),
    ):  # fmt: skip
        files = noack.save_tables(result, tmp_path / name)
        assert files[0].name == f"{name}.csv"
    result = invoke("margin", "lane_periodic", "--most", "1", "--no-period", "--tables", tmp_path)
    assert result.exit_code == 0, result.output
    own = tmp_path / "margin" / "margin.csv"
    assert own.read_bytes() == (tmp_path / "margin.csv").read_bytes()
    with pytest.raises(CallerError, match="str: has no tables"):
        noack.save_tables("lane_following", tmp_path)  # type: ignore[arg-type]
