"""Validation losses in closed form."""
