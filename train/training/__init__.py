"""Training: the loop, checkpoints, validation and logs."""

TRAINING_VERSION = 1
"""Raise it when a change makes trainings end with other weights: experiments then do not reuse earlier runs."""
