"""Captures: both sides of a link as a pcapng file, with each datagram's fate as its comment."""
