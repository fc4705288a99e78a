"""The benchmarks, one subject in each file; what they measure with is in the folder above."""
