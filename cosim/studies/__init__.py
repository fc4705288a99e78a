"""Studies over many runs: campaigns, trigger design, the paper reproduced."""
