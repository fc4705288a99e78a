"""The report of a run: figures, and a page that holds them."""
