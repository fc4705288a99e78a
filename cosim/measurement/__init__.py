"""What a measured network (:mod:`netem.measurement`) means for a scenario, and the page about it.

1. ``run_trace.py``: the packet trace of a run.
2. ``certificate_time.py``: when a scenario's certificate would have been void.
3. ``measurement_outputs.py``: tables, figures, page and JSON; ``network_section.py``: a
   ``[network]`` section that reproduces the network.
"""
