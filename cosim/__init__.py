"""What sees the whole run: launching, recording, viewing, the command line."""

import os

# The processes of a run compute on one thread. What shall repeat their arithmetic bit for bit must,
# too: with more, the exponential of a large matrix is rounded differently. numpy looks once, at
# its import. A variable that is set again leaves no room for a process's title.
if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
