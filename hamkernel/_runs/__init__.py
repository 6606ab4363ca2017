"""Logged runs: states at times, their checks and their smoothed paths."""
