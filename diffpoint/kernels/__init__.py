"""Taichi kernels, without torch. Each module has `build(real)`, which makes its kernels for one float type.

The last argument of every kernel is `spread`. Its outer loop has `count * spread` iterations, of which only every
`spread`-th does work: with Taichi's default settings a loop of up to 512 iterations runs on one thread, so `spread`
is 512 in a program that started Taichi itself, and 1 if diffpoint started it with other settings.
"""
