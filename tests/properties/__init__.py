"""What `test_properties.py` throws at the ops, and how it judges what comes back."""
