"""The one import of the kernel compiler: Taichi, or its maintained fork where Taichi has no wheel."""

import os

if os.environ.get("DIFFPOINT_BACKEND") == "quadrants":
    import quadrants as ti
else:
    try:
        import taichi as ti
    except ImportError:
        import quadrants as ti

__all__ = ["ti"]
