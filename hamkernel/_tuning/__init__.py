"""Hyperparameters by the gradient of a validation loss."""
