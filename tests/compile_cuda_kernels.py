"""Compiles kernels for CUDA without a GPU: python tests/compile_cuda_kernels.py LAUNCHES.json

LAUNCHES.json holds a list of launches: module and name of the kernel, type or value of each argument, and options.
Triton brings the assembler, so that what it makes is machine code for the architectures below. In a process of its
own, because the interpreter replaces the kernels in one where it is on.
"""

import importlib
import json
import sys
from pathlib import Path

from triton import compile as compile_kernel
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

ARCHITECTURES = (80, 90)  # A100, H100


def main() -> None:
    for launch in json.loads(Path(sys.argv[1]).read_text()):
        kernel = getattr(importlib.import_module(launch["module"]), launch["kernel"])
        given = {
            p.name: "i32" if value == 1 and p.do_not_specialize else value
            for p, value in zip(kernel.params, launch["arguments"], strict=True)
        }
        constants = {
            p.name: given[p.name]
            for p in kernel.params
            if p.is_constexpr or not isinstance(given[p.name], str)
        }
        signature = {name: "constexpr" if name in constants else value for name, value in given.items()}
        for architecture in ARCHITECTURES:
            compiled = compile_kernel(
                ASTSource(kernel, signature=signature, constexprs=constants),
                target=GPUTarget("cuda", architecture, 32),
                options=launch["options"],
            )
            print(launch["kernel"], architecture, len(compiled.asm["cubin"]), compiled.metadata.shared)


if __name__ == "__main__":
    main()
