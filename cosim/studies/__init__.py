"""Studies: campaigns, design, new loops, the paper; comparison of runs."""
