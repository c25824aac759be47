"""Front constraint or projection loss? A study on free clouds and in networks; start reading at study.py."""
