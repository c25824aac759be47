"""`python -m benchmarks`: every op beside its peers, interleaved, medians; writes benchmarks/results/."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported


def main() -> None:
    from benchmarks.harness import machine, run, save, table
    from benchmarks.races import races

    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", default="", metavar="WORD", help="only the ops whose name holds this word")
    parser.add_argument("--seconds", type=float, default=4.0, help="time for each race (default: 4)")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "results", help="where results go"
    )
    arguments = parser.parse_args()

    print(", ".join(f"{key} {value}" for key, value in machine().items()), flush=True)
    rows = []
    for race in races():
        if arguments.only in race.op:
            rows += run(race, seconds=arguments.seconds)
            print(table(rows[-1 - len(race.peers) :]).splitlines()[-1], flush=True)
    if not rows:
        parser.error(f"no op holds {arguments.only!r} in its name")
    if arguments.only:
        print("Not saved: a part of the table is no table.")
    else:
        print(f"Saved {save(rows, arguments.out)}")


if __name__ == "__main__":
    main()
