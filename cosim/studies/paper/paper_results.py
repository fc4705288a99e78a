"""The page's data: all draws, as in ``paper.json``, and the format of their numbers."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cosim.studies.campaign.metrics import quartiles
from cosim.studies.paper.paper_campaign import BASE, COLUMNS, MODES, EnsemblePart
from noack.core.linear_systems import Matrix, Vector

DIGITS = 5
"""Number of significant digits in the file."""

HORIZON_S = 40.0
"""Horizon of the campaign ``paper``; a time beyond it is written as "> 40"."""
_SMALL, _LARGE = 1e-3, 1e6
"""Numbers outside these limits are written with a power of ten."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

REPRESENTED = tuple(
    f"{mode}.{name}"
    for mode in MODES
    for name in ("events", "deliveries", "settled_5_s", "settled_1_s", "gap_min_s")
)
"""The measures by which the representative draw is chosen."""


@dataclass(frozen=True)
class Results:
    """All numbers of the page."""

    tables: Mapping[tuple[str, str], Matrix]
    """By table and variation: rows are draws, columns those of ``COLUMNS``. If an event does not
    happen within the horizon, its time is infinite; there is no NaN."""
    evidence: Mapping[str, Any]

    def column(self, name: str, variation: str = BASE, table: str = "draws") -> Vector:
        """Return a column, one entry per draw."""
        return np.asarray(self.tables[table, variation][:, COLUMNS[table].index(name)])

    def lost(self, mode: str, variation: str = BASE) -> Vector:
        """Return the share of the transmissions that the network lost, one entry per draw."""
        deliveries = self.column(f"{mode}.deliveries", variation)
        return 1 - deliveries / self.column(f"{mode}.events", variation)

    @property
    def variations(self) -> list[str]:
        """Names of the variations, the base first."""
        return [variation for table, variation in self.tables if table == "draws"]

    def count(self, variation: str = BASE, table: str = "draws") -> int:
        """Return the number of draws."""
        return len(self.tables[table, variation])

    @property
    def representative(self) -> int:
        """The draw nearest to the medians.

        Distance is the sum of squares of (value − median) / (upper − lower quartile).
        """
        distance = np.zeros(self.count())
        for name in REPRESENTED:
            values = self.column(name)
            low, middle, high = quartiles(values)
            if math.isfinite(high) and high > low:
                distance += ((values - middle) / (high - low)) ** 2
        return int(np.argmin(distance))


def results_of(
    parts: Iterable[tuple[EnsemblePart, Matrix]], evidence: Mapping[str, Any]
) -> Results:
    """Return the results, rounded to the digits of the file."""
    document = {
        "tables": [
            {"table": part.table, "variation": part.variation, "rows": rows.tolist()}
            for part, rows in parts
        ],
        "evidence": evidence,
    }
    return read_results(_rounded(document))


def dumps(results: Results) -> str:
    """Return the content of ``paper.json``: one draw per line, null for infinity."""
    tables = []
    for (table, variation), rows in results.tables.items():
        head = {"table": table, "variation": variation, "columns": COLUMNS[table]}
        lines = ",\n".join(json.dumps(_rounded(row.tolist())) for row in rows)
        tables.append(f'{json.dumps(head, ensure_ascii=False)[:-1]}, "rows": [\n{lines}\n]}}')
    evidence = json.dumps(_rounded(results.evidence), indent=1)
    return f'{{"tables": [\n{",".join(tables)}\n],\n"evidence": {evidence}}}\n'


def read_results(document: Mapping[str, Any]) -> Results:
    """Return the results in the content of ``paper.json``."""
    tables = {
        (table["table"], table["variation"]): np.array(
            [[math.inf if value is None else value for value in row] for row in table["rows"]],
            dtype=np.float64,
        )
        for table in document["tables"]
    }
    return Results(tables, document["evidence"])


def _rounded(value: Any) -> Any:
    """Return values as in the JSON file: rounded, integers without a point, null for infinity."""
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


def number(value: float, digits: int = 3) -> str:
    """Return a number as text: 0.0123, 517, 2.8 · 10³³."""
    if not math.isfinite(value):
        return f"> {HORIZON_S:g}"
    if value == round(value) and abs(value) < _LARGE:
        text = f"{value:,.0f}"
    elif _SMALL <= abs(value) < _LARGE:
        short = float(f"{value:.{digits}g}")
        text = f"{short:,.0f}" if abs(short) >= 10**digits else f"{short:g}"
    else:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        power = f"10{str(int(exponent)).translate(_RAISED)}"
        text = power if float(mantissa) == 1 else f"{float(mantissa):g} · {power}"
    return text.replace("-", "−")


def percent(value: float) -> str:
    """Return a share in percent; only exactly all or none is written as 100 % or 0 %."""
    text = f"{100 * value:.0f}"
    rounded = text in ("0", "100") and value not in (0.0, 1.0)
    return f"{100 * value:.1f} %" if rounded else f"{text} %"


def spread(values: Vector) -> str:
    """Return median and quartiles: 517 (493 … 547)."""
    low, middle, high = map(number, quartiles(values))
    return f"{middle} ({low} … {high})"
