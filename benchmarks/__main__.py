"""`python -m benchmarks`: times of every op and its peers, run in turns, medians; writes benchmarks/results/.

Parts: races (with each op's extra memory), memory (its growth), dispatch (of torch operators), sweep (over the number
of points), lone (large clouds on one thread and on all), train (a training step), gpu (ops and training steps on a GPU
within --minutes, and tests of the kernels there; files of its own; skipped where there is no GPU). `publish` puts the
tables of the last run into README.md and docs/performance.md.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported

PARTS = ("races", "memory", "dispatch", "sweep", "lone", "train")


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help="what to run (default: every part)")
    parser.add_argument("--only", default="", metavar="WORD", help="only races whose op contains this word")
    parser.add_argument("--seconds", type=float, default=2.0, help="time for each race (default: 2)")
    parser.add_argument("--quick", action="store_true", help="few runs in two or three minutes, not saved")
    parser.add_argument("--minutes", type=float, default=8.0, help="gpu: time for everything (default: 8)")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results", help="where results go"
    )
    arguments = parser.parse_args()
    every = [*PARTS] if arguments.quick else [*PARTS, "gpu"]
    parts: list[str] = arguments.parts or (["races"] if arguments.only else every)
    if unknown := set(parts) - {*PARTS, "publish", "gpu"}:
        names = ", ".join(PARTS)
        parser.error(f"no such part: {', '.join(sorted(unknown))} (parts: {names}, gpu; or publish)")
    warnings.filterwarnings("ignore", category=UserWarning, module="numba")

    if parts == ["publish"]:
        from benchmarks.publish import publish

        return publish(arguments.out)
    status = 0
    if "gpu" in parts:
        from benchmarks import gpu

        status = gpu.main(arguments.out, minutes=arguments.minutes)
        parts = [part for part in parts if part != "gpu"]
    return max(status, _measure(parts, arguments)) if parts else status


def _measure(parts: list[str], arguments: argparse.Namespace) -> int:
    from benchmarks import saved
    from benchmarks.sweep import figure
    from benchmarks.tables import page

    here = saved.machine()
    path = saved.path_for(arguments.out, here)
    partial = bool(arguments.only or arguments.quick)
    results: dict[str, Any] = {} if partial else saved.load(arguments.out, here)
    results |= {"machine": here, "interrupted": False, **{part: [] for part in parts}}
    print(saved.title(here), flush=True)
    failures: list[str] = []
    try:
        for part in parts:
            print(f"--- {part}", flush=True)
            for row in _rows(part, arguments, failures):  # row by row, so that Ctrl-C keeps the rows so far
                results[part].append(row)
    except KeyboardInterrupt:
        results["interrupted"] = True
        path = path.with_name(path.stem + ".interrupted.json")
        print("\ninterrupted; what was measured so far:")
    print("\n" + page(results))
    if partial:
        print("Not saved, because of --only or --quick.")
    else:
        saved.save(results, page(results), path)
        if results.get("sweep"):
            figure(results["sweep"], saved.title(here), path.with_suffix(".png"))
        print(f"Saved {path}, and .md beside it")
    for failure in failures:
        print(f"FAILED: {failure}")
    return 1 if failures else 0


def _rows(part: str, arguments: argparse.Namespace, failures: list[str]) -> Iterator[dict[str, Any]]:
    from benchmarks import dispatch, lone, memory, sweep

    quick = arguments.quick
    if part == "races":
        yield from _race_rows(arguments, failures)
    elif part == "memory":
        yield from memory.measure("growth")
    elif part == "dispatch":
        yield from dispatch.measure()
    elif part == "sweep":
        yield from sweep.measure(longest=0.5 if quick else 4.0)
    elif part == "lone":
        yield from lone.measure(seconds=0.0 if quick else 1.0)
    elif part == "train":
        try:
            from benchmarks import training
        except ImportError as error:
            print(f"  skipped: {error} (extra [train])")
            return
        yield from training.measure(quick=quick)


def _race_rows(arguments: argparse.Namespace, failures: list[str]) -> Iterator[dict[str, Any]]:
    from benchmarks import memory
    from benchmarks.harness import Disagreement, run
    from benchmarks.races import races
    from benchmarks.tables import race_line

    extra = {} if arguments.quick else memory.of_races(arguments.only)
    found = False
    for race in races():
        if arguments.only not in race.op:
            continue
        found = True
        try:
            rows = run(race, seconds=0.0 if arguments.quick else arguments.seconds)
        except Disagreement as error:
            failures.append(str(error))
            continue
        rows[0]["extra_mb"] = extra.get(f"{race.op} {race.size} {race.direction}")
        print(" | ".join(race_line(rows)), flush=True)
        yield from rows
    if not found:
        failures.append(f"no op has {arguments.only!r} in its name")


if __name__ == "__main__":
    sys.exit(main())
