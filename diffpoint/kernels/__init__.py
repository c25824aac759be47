"""Taichi kernels: no torch here. Each module has `build(real)`, which makes its kernels for one float type.

Every kernel ends in the argument `spread`. Its outer loop runs over `count * spread` and acts where the counter is a
multiple of `spread`: Taichi's default settings run a loop of up to 512 iterations on a single thread, so in a program
that started Taichi itself `spread` is 512, and 1 where diffpoint chose the settings.
"""
