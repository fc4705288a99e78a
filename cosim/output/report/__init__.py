"""The report of a run: figures, and a page that holds them."""

import logging

# Where it can keep no cache, matplotlib says so at every run; nobody could do anything with that.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
