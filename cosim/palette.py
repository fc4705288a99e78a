"""The colours of a run, in its view and in its report: one colour, one meaning everywhere.

All are readable on a light and on a dark background, and where two of them are hard to tell apart
for a colour-blind eye, what is drawn also differs in width, dash or marker.
"""

Colour = tuple[int, int, int]

PLANT: Colour = (150, 150, 158)
SENSOR: Colour = (38, 132, 255)
CONTROLLER: Colour = (255, 128, 14)
NETWORK: Colour = (40, 165, 90)
THRESHOLD: Colour = (225, 60, 75)
FORCED: Colour = (200, 70, 200)
DROPPED: Colour = (225, 60, 75)
BOUND: Colour = (150, 110, 80)
CERTIFIED: Colour = (40, 165, 90)
SERIES: tuple[Colour, ...] = (
    (38, 132, 255),
    (255, 128, 14),
    (40, 165, 90),
    (200, 70, 200),
    (150, 110, 80),
    (20, 175, 190),
    (150, 150, 158),
)
"""For what has no colour of its own."""
PROCESSES: dict[str, Colour] = {
    "plant": PLANT,
    "sensor": SENSOR,
    "netem": NETWORK,
    "controller": CONTROLLER,
}
