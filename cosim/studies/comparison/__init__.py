"""Two or more runs beside each other: numbers, settings, curves."""
