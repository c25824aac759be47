"""Data: shapes on disk, and the ways to make them (procedural families, meshes)."""

from train.data.tree import Shape, ShapeError, ShapeTree

__all__ = ["Shape", "ShapeError", "ShapeTree"]
