"""How a field is found from data."""
