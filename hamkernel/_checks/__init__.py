"""The test of a user's own kernel."""
