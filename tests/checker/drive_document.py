"""A loop document that was written by hand: the speed loop of a drive with a PI controller in the PLC.

The drive sends its speed every 10 ms; it arrives 25 ms later, 5 ms after a transmission, at the controller's
tick: just before it or just after it. The controller integrates the last speed that it received, and its
voltage acts 1 ms after the tick. The speed is that above the set-point.
"""

import math
from typing import Any

Table = dict[str, Any]
STATES = ["speed", "current", "integral", "received", "voltage", "sent 1", "sent 2", "sent"]
START = {"speed": -100, "current": -0.2, "integral": -8.5, "received": -100, "voltage": -5.1}
"""At rest at a speed that is 100 rad/s lower."""
PERIOD_S = 0.01


def drive(losses: int, *, rate: float = 0.0, load: float = 0.0) -> Table:
    """Return the document.

    Args:
        losses: most speeds that are lost in a row.
        rate: r of the bounds, 1/s.
        load: largest load, in rad/s²; it changes at transmissions.
    """
    names = [*STATES, "f1", "f2", *(["load"] if load else [])]
    lost = [f"{j} lost" for j in range(losses + 1)]

    def row(**entries: float) -> list[float]:
        return [entries.get(name.replace(" ", "_"), 0) for name in names]

    def step(words: str, **rows: list[float]) -> Table:
        kept = {name: row(**{name.replace(" ", "_"): 1}) for name in names}
        kept |= {name.replace("_", " "): value for name, value in rows.items()}
        return {"words": words, "matrix": list(kept.values())}

    still = {name: row() for name in names}
    moving = still | {
        "speed": row(speed=-0.5, current=250, load=1),
        "current": row(speed=-50, current=-500, voltage=1000),
    }
    decay = math.floor(math.exp(-rate * PERIOD_S) * 1e15) / 1e15
    steps = {
        "motor": {"words": "the speed and the current move", "matrix": list(moving.values())},
        "send": step("the speed is sent", sent=row(speed=1)),
        "arrive": step("a speed arrives", received=row(sent_2=1)),
        "tick": step("the controller integrates", integral=row(integral=1, received=-0.01)),
        "act": step("its voltage acts", voltage=row(received=-0.024, integral=0.6)),
        "period": step(
            "a period is over", sent_2=row(sent_1=1), sent_1=row(sent=1), sent=row(), f1=row(f1=decay)
        ),
    }
    begin, wait, end = ({"exp": "motor", "seconds": s} for s in (0.005, 0.001, 0.004))
    jumps = {
        "early": ["send", begin, "arrive", "tick", wait, "act", end, "period"],
        "late": ["send", begin, "tick", wait, "act", "arrive", end, "period"],
        "lost": ["send", begin, "tick", wait, "act", end, "period"],
    }
    start = {name: row(**{name.replace(" ", "_"): 1}) for name in names}
    values = START | {"sent 1": -100, "sent 2": -100, "f1": 1, "f2": 1}
    return {
        "format": "noack-hybrid 1",
        "name": "drive",
        "coordinates": [
            {"name": name, "unit": "", **({"noise": True} if name == "load" else {})} for name in names
        ],
        "decaying": {"coordinate": "f1", "rate": rate},
        "constant": "f2",
        "rows": {"load": [row(load=1)], "largest load": [row(f2=load)]} if load else {},
        "facts": {"load": {"less": ["load"], "more": ["largest load"], "words": "the load"}} if load else {},
        "motions": {},
        "steps": steps,
        "locations": [
            {"name": name, "coordinates": STATES[:-1], "motion": None, "facts": []} for name in lost
        ],
        "edges": [
            {
                "name": f"{name}, {outcome}",
                "from": name,
                "to": lost[j + 1] if outcome == "lost" else lost[0],
                "clock": "zero",
                "facts": ["load"] if load else [],
                "jump": jump,
                "duration": PERIOD_S,
            }
            for j, name in enumerate(lost)
            for outcome, jump in jumps.items()
            if outcome != "lost" or j < losses
        ],
        "start": {
            "location": lost[0],
            "columns": [
                [*([0] if name == "load" else [values.get(name, 0)]), *(start[name][-1:] if load else [])]
                for name in names
            ],
            "facts": [],
        },
        "outputs": [
            {"name": "speed", "unit": "rad/s", "rows": [row(speed=1)], "in": lost, "during_edges": True}
        ],
    }
