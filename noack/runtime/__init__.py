"""A process in a run: its UDP sockets, real-time loop, control plane (zenoh) and telemetry."""
