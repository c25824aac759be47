"""Every table and figure of the paper as one command: `python -m train experiment NAME`."""
