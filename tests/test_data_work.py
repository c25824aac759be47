"""Jobs over processes, from the scripts that people write."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

_SCRIPT = """
import math
print("begun")
from train.data.work import run_all
found = sorted(run_all(math.sqrt, [1, 4, 9], processes=2, desc="roots", unit="root", progress=False))
print(found, __file__ == __import__("sys").argv[0], __spec__)
"""


def test_a_script_without_a_main_guard_is_run_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(_SCRIPT)
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[1],
        env={"PYTHONPATH": str(Path(__file__).parents[1])}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["begun", "[(1, 1.0), (4, 2.0), (9, 3.0)] True None"]
