"""What the page is made from: all draws, as they stand in ``paper.json``."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.studies.paper.paper_conditions import BASE, CONDITIONS
from cosim.studies.paper.paper_ensemble import COLUMNS, EnsemblePart, Row
from noack.core.linear_systems import Matrix, Vector

DIGITS = 5
"""Significant digits that are kept."""

REPRESENTED = tuple(
    f"{mode}.{name}"
    for mode in ("model", "zoh")
    for name in ("events", "deliveries", "settled_5_s", "settled_1_s", "gap_min_s")
)
"""By these the representative draw is near the medians."""


@dataclass(frozen=True)
class Results:
    """Everything that the page says."""

    tables: Mapping[tuple[str, str], Matrix]
    """By table and condition: rows are draws, columns those of ``COLUMNS``; NaN has no place here,
    infinite is what does not happen within the horizon."""
    evidence: Mapping[str, Any]

    def column(self, name: str, condition: str = BASE.name, table: str = "draws") -> Vector:
        """A column, one entry per draw."""
        return np.asarray(self.tables[table, condition][:, COLUMNS[table].index(name)])

    def lost(self, mode: str, condition: str = BASE.name) -> Vector:
        """Share of the transmissions that the network lost."""
        deliveries, events = (
            self.column(f"{mode}.{name}", condition) for name in ("deliveries", "events")
        )
        return 1 - deliveries / events

    def count(self, condition: str = BASE.name, table: str = "draws") -> int:
        """Number of draws."""
        return len(self.tables[table, condition])

    @property
    def representative(self) -> int:
        """The draw nearest to the medians.

        Distance is the sum of squares of (value − median) / (upper − lower quartile).
        """
        distance = np.zeros(self.count())
        for name in REPRESENTED:
            values = self.column(name)
            low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), method="inverted_cdf")
            if math.isfinite(high) and high > low:
                distance += ((values - middle) / (high - low)) ** 2
        return int(np.argmin(distance))


def results_of(
    parts: Iterable[tuple[EnsemblePart, list[Row]]], evidence: Mapping[str, Any]
) -> Results:
    """Results, with as many digits as the file keeps."""
    document = {
        "tables": [
            {"table": part.table, "condition": part.condition.name, "rows": rows}
            for part, rows in parts
        ],
        "evidence": evidence,
    }
    return _read(_rounded(document))


def load_results(path: Path) -> Results:
    """Read ``paper.json``."""
    return _read(json.loads(path.read_text(encoding="utf-8")))


def dumps(results: Results) -> str:
    """The content of ``paper.json``: one draw per line; null is what does not happen."""
    tables = []
    for (table, condition), rows in results.tables.items():
        (settings,) = [c.settings for c in CONDITIONS if c.name == condition]
        head = {
            "table": table, "condition": condition, "settings": settings, "columns": COLUMNS[table]
        }  # fmt: skip
        lines = ",\n".join(json.dumps(_rounded(row.tolist())) for row in rows)
        tables.append(f'{json.dumps(head)[:-1]}, "rows": [\n{lines}\n]}}')
    evidence = json.dumps(_rounded(results.evidence), indent=1)
    return f'{{"tables": [\n{",".join(tables)}\n],\n"evidence": {evidence}}}\n'


def _read(document: Mapping[str, Any]) -> Results:
    tables = {
        (table["table"], table["condition"]): np.array(
            [[math.inf if value is None else value for value in row] for row in table["rows"]],
            dtype=np.float64,
        )
        for table in document["tables"]
    }
    return Results(tables, document["evidence"])


def _rounded(value: Any) -> Any:
    """Values as JSON holds them: few digits, whole numbers without a point, null for infinite."""
    if isinstance(value, Mapping):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(entry) for entry in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if not math.isfinite(value):
        return None
    short = float(f"{value:.{DIGITS}g}")
    return int(short) if short == round(short) and abs(short) < 10**DIGITS else short
