"""Simulation: trajectories of any vector field."""
