"""Studies: campaigns, capacity, design, new loops, the paper; comparison and archives of runs."""
