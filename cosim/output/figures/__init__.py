"""Figures: described once, and drawn by matplotlib or, on the lab page, in the browser."""
