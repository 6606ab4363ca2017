"""Logged runs: states at times, their checks, their smoothed paths, and rows of both."""
