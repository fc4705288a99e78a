"""The relay's engines: sockets and the rules of links, compiled if possible, else plain Python."""
