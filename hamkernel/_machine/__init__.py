"""Devices, memory and threads, and batches of small matrices that do not stall."""
