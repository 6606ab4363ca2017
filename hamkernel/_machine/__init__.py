"""The devices, memory and threads that there are."""
