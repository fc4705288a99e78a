"""Live control of a relay: statistics, changes while it runs, a view in the terminal."""
