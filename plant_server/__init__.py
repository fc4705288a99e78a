"""The plant: owns the true state x."""
