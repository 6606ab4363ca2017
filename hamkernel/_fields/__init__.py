"""Learned vector fields and their potentials."""
