"""Many independent jobs over processes, with a progress bar; one that dies takes no other with it."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from tqdm import tqdm

Job = TypeVar("Job")
_JOBS_WORTH_A_PROCESS = 8


def run_all(
    function: Callable[[Job], Any], jobs: Sequence[Job], *, processes: int | None, desc: str, unit: str
) -> Iterator[tuple[Job, Any]]:
    """Yield (job, result) as jobs end. `function` must return its failures; a crash yields an `OSError`.

    Args:
        function: a module-level function of one picklable job.
        processes: at most this many; None means one per core, and only this one for a handful of jobs.
    """
    wanted = processes or min(os.cpu_count() or 1, -(-len(jobs) // _JOBS_WORTH_A_PROCESS))
    with tqdm(total=len(jobs), desc=desc, unit=unit) as bar:
        if wanted <= 1:
            results = ((job, function(job)) for job in jobs)
        else:
            results = _in_pool(function, jobs, wanted)
        for job, result in results:
            bar.update()
            yield job, result


def _in_pool(
    function: Callable[[Job], Any], jobs: Sequence[Job], processes: int
) -> Iterator[tuple[Job, Any]]:
    """A crash breaks the whole pool of processes: the jobs left over then run one at a time, each in its own."""
    # Not forked: a child of a process with torch's or Taichi's threads can hang.
    context = multiprocessing.get_context("spawn")
    left = dict.fromkeys(range(len(jobs)))
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        futures = {pool.submit(function, job): number for number, job in enumerate(jobs)}
        try:
            for future in as_completed(futures):
                result = future.result()
                del left[futures[future]]
                yield jobs[futures[future]], result
            return
        except BrokenProcessPool:
            pass
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    for number in left:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            try:
                yield jobs[number], pool.submit(function, jobs[number]).result()
            except BrokenProcessPool:
                yield jobs[number], OSError("the process that worked on it crashed or ran out of memory")
