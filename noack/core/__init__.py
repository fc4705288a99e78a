"""Clock, random streams, linear systems, errors."""
