"""Tools of plants beside their equations: linear models and enclosures of them."""
