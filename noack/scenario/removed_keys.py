"""Keys and kinds that earlier builds had: a file that uses one is told the plain way instead."""

from collections.abc import Mapping
from fnmatch import fnmatchcase

REMOVED: Mapping[str, str] = {
    "claims": "`noack campaign` writes every metric of each draw; compare them in a program",
    "claims_at": "`noack campaign` writes every metric of each draw; compare them in a program",
    "loops": 'in a campaign, the key "loops.0.count" is the number of loops',
    "metrics.cost_of_*": "the metric cost is the mean of all loops, cost_worst the largest",
    "metrics.shown = cost_of_*": "the metric cost is the mean of all loops, cost_worst the largest",
    "metrics.count_from_s": "all updates of a run count",
    "controller.kind = program": "use python: a class of your own; docs/wire.md has the datagrams",
    "plant.system.kind = vehicle": "write its equations as a class: plant.system.kind = python",
    "model.name = single_track_lane": "give model.A and model.B",
    "clocks.relative_rate_ppm": "let chrony or PTP discipline the clocks of all hosts",
    "recovery.rejoin_within_s": "a process that dies ends the run, whose record is complete up to then",
}
"""The plain way by what was removed: a key with dots (``table.key``), or the kind of a table
(``table.kind = value``). Numbers of entries in lists are left out: ``network.impairments.kind``.
A ``*`` is any text."""


def removed_key(key: str, value: object) -> tuple[str, object, str] | None:
    """Return what was removed: its key, its value, and what to do instead; None if it never existed.

    Args:
        key: a whole key that is unknown, or of which the value is an unknown kind. It may lie within
            other tables than in :data:`REMOVED`, as those of an entry of ``[[loops]]``.
        value: its value. If this is a table, the keys in it are looked up, too.
    """
    inner = value if isinstance(value, Mapping) else {}
    candidates = [(key, value), *((f"{key}.{part}", inner[part]) for part in inner)]
    for place, of_place in candidates:
        name = ".".join(part for part in place.split(".") if not part.isdecimal())
        for removed, instead in REMOVED.items():
            pattern = f"*.{removed}"
            if fnmatchcase(f".{name}", pattern) or fnmatchcase(f".{name} = {of_place}", pattern):
                return place, of_place, instead
    return None
