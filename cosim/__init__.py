"""What sees the whole run: launching, recording, viewing, the command line."""

import os

_ENVIRONMENT = {
    # The processes of a run compute on one thread. What shall repeat their arithmetic bit for bit
    # must, too: with more, the exponential of a large matrix is rounded differently.
    "OPENBLAS_NUM_THREADS": "1",
    # pyarrow shares freed memory with the other libraries: a run's end needs 20 MiB less.
    "ARROW_DEFAULT_MEMORY_POOL": "system",
}
# Each library looks once, at its import. A variable that is set again leaves no room for a
# process's title.
for _name, _value in _ENVIRONMENT.items():
    if os.environ.get(_name) != _value:
        os.environ[_name] = _value
