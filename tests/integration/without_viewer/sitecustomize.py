"""Makes an interpreter that has this folder in PYTHONPATH one without the extra `viewer`.

Its package, and pandas, which pyarrow imports where it is installed, cost half of a short live run.
"""

import sys

sys.modules.update(dict.fromkeys(("rerun", "pandas")))  # type: ignore[arg-type]  # None: it is not there
