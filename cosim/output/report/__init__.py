"""The report of a run: figures, and an HTML page with them."""

import logging

# If matplotlib cannot write its cache, it warns in every run; the warning is of no use here.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
