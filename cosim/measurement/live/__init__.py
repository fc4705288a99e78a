"""The live prober: numbered datagrams between two hosts, one way or to and fro."""
