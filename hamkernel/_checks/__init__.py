"""The test of a kernel of the user's own."""
