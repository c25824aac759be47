"""Inputs and checks of `test_properties.py`."""
