"""The colours of a run, in its view and in its report: one colour, one meaning everywhere.

All stand out from a light and from a dark background, 3 to 1, and the first five from each other
for colour-blind eyes as well; a test computes both. What they show also differs in width, dash or
shape.
"""

Colour = tuple[int, int, int]

PLANT: Colour = (155, 142, 159)
SENSOR: Colour = (51, 93, 213)
CONTROLLER: Colour = (255, 86, 10)
THRESHOLD: Colour = (193, 43, 105)
CERTIFIED: Colour = (51, 162, 78)
FORCED: Colour = (222, 90, 218)
BOUND: Colour = (180, 100, 40)
NETWORK: Colour = CERTIFIED
DROPPED: Colour = THRESHOLD
SERIES: tuple[Colour, ...] = (
    SENSOR,
    CONTROLLER,
    CERTIFIED,
    FORCED,
    BOUND,
    (12, 161, 180),
    PLANT,
)
"""For what has no colour of its own."""
PROCESSES: dict[str, Colour] = {
    "plant": PLANT,
    "sensor": SENSOR,
    "netem": NETWORK,
    "controller": CONTROLLER,
}
