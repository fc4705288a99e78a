"""The sensor: owns the model x_s and the trigger."""
