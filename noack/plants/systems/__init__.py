"""The systems behind the plants: integrated equations, an FMU; and their support code."""
