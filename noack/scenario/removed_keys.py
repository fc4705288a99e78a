"""Keys and kinds that earlier builds had: a file that uses one is told the plain way instead."""

from collections.abc import Mapping

REMOVED: Mapping[str, str] = {
    "claims": "`noack campaign` writes every metric of each draw; compare them in a program",
    "claims_at": "`noack campaign` writes every metric of each draw; compare them in a program",
    "metrics.count_from_s": "all updates of a run count",
    "controller.kind = program": "use python: a class of your own; docs/wire.md has the datagrams",
    "plant.system.kind = vehicle": "write its equations as a class: plant.system.kind = python",
    "model.name = single_track_lane": "give model.A and model.B",
    "clocks.relative_rate_ppm": "let chrony or PTP discipline the clocks of all hosts",
    "recovery.rejoin_within_s": "a process that dies ends the run, whose record is complete up to then",
}
"""The plain way by what was removed: a key with dots (``table.key``), or the kind of a table
(``table.kind = value``). Numbers of entries in lists are left out: ``network.impairments.kind``."""


def plain_way(key: str, value: object) -> str | None:
    """Return what to do instead of an unknown key, or of an unknown kind; None if it never existed.

    Args:
        key: the whole key. It may lie within other tables than in :data:`REMOVED`, as those of an
            entry of ``[[loops]]``.
        value: its value. If this is a table, the keys in it are looked up, too.
    """
    name = ".".join(part for part in key.split(".") if not part.isdecimal())
    inner = value if isinstance(value, Mapping) else ()
    for candidate in (name, f"{name} = {value}", *(f"{name}.{part}" for part in inner)):
        for removed, instead in REMOVED.items():
            if f".{candidate}".endswith(f".{removed}"):
                return f"was removed; {instead}"
    return None
