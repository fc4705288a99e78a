"""Support code of systems whose equations are compiled: the integrator, the cache."""
