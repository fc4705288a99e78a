"""The controller: owns the model x_c and the control input."""
