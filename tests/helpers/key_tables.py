"""What every table of keys has: all keys of the schema, and no others."""

from noack.proof.elaborate.keys import KeyTable
from tests.helpers.schema_keys import SCHEMA_KEYS


def missing_keys(table: KeyTable) -> list[str]:
    """Return the keys of the schema that are not in a table."""
    return [key for key in SCHEMA_KEYS if not table.rows_of(key)]


def unknown_keys(table: KeyTable) -> list[str]:
    """Return the keys of a table that are not in the schema."""
    return [name for name in table.rows if not any(_is_named(key, name) for key in SCHEMA_KEYS)]


def _is_named(key: str, name: str) -> bool:
    inner = name.removesuffix(".*")
    return key == inner or (name != inner and key.startswith(f"{inner}."))


def faulty_rows(table: KeyTable) -> list[str]:
    """Return the keys with a row of no known use, without a reason, or that stand in two equal places."""
    faulty = []
    for name, rows in table.rows.items():
        uses = [(row.use, row.of) for row in rows]
        is_known = all(row.use in ("used", "irrelevant", "refused") for row in rows)
        is_explained = all((row.reason == "") == (row.use == "used") for row in rows)
        is_one = len(rows) == 1 or all(row.use == "refused" for row in rows)
        if not (is_known and is_explained and is_one and len(set(uses)) == len(uses)):
            faulty.append(name)
    return faulty
