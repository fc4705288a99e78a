"""The shells' side: UDP sockets, the real-time loop, the zenoh control plane, telemetry."""
