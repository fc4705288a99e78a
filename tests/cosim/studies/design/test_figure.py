"""The trade-off figure without a trade-off."""

from pathlib import Path

from typer.testing import CliRunner

from cosim.cli import app


def test_a_loop_with_only_diverging_runs_gives_one_line(mass: Path, tmp_path: Path) -> None:
    """Values beyond 1e100 count as diverged."""
    page = tmp_path / "page.html"
    result = CliRunner().invoke(app, [
        "design", str(mass), "--settling", "9", "--quantile", "0.5", "--draws", "20",
        "--weights", "identity", "--set", "plant.initial_state=[1e300, 0.0]", "--page", str(page),
    ])  # fmt: skip
    assert result.exit_code == 1
    assert result.stderr.startswith("noack: no design meets the limits; the closest has a settling")
    assert result.stderr.count("\n") == 1
    assert "<svg" in page.read_text()
