"""The recorder: rows from all processes to the spool, and the claims that it checks meanwhile."""
