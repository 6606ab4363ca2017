"""Learned fields in files."""
