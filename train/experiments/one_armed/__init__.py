"""A chair with one arm: is the other one invented? Start reading at measure.py."""
