"""What moves a plant: equations that are integrated, an FMU; and what they need."""
