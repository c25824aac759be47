"""What a GPU does: the layer's tests, times of the ops beside peers, training steps and a short training.

`python -m benchmarks gpu --minutes 8` needs torch with CUDA, triton, taichi and this checkout; what else is missing is
named and left out. It writes `gpu-<name>.json` and `.md` after each part, so that nothing is lost when the time is up.
"""

from __future__ import annotations

import functools
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import diffpoint as dp
from benchmarks import saved
from benchmarks.inputs import circle_of_cameras, pairs, surfaces
from benchmarks.peers import optional

_ROUNDS = 20
_ROOT = Path(__file__).parents[1]
# Of the time that is left at the start of a part, what it may use.
_SHARES = {"ops": 0.3, "steps": 0.3, "tests": 0.6, "training": 0.9}


def main(out: Path, *, minutes: float) -> int:
    """Runs every part within about `minutes`; returns the exit status."""
    if not torch.cuda.is_available():
        built = f"torch {torch.__version__} is built for CUDA {torch.version.cuda}"
        missing = "without CUDA" if torch.version.cuda is None else "and finds no GPU"
        print(f"gpu: skipped: {built if torch.version.cuda else f'torch {torch.__version__}'} {missing}")
        return 0
    parts = {"ops": _ops, "steps": _steps, "tests": _tests, "training": _training}
    path = out / f"gpu-{saved.file_stem(torch.cuda.get_device_name())}.json"
    return _measure(parts, _machine(), path, minutes=minutes)


def _measure(
    parts: dict[str, Callable[[float], Iterator[dict[str, Any]]]],
    machine: dict[str, Any],
    path: Path,
    *,
    minutes: float,
) -> int:
    """Runs parts, each until a time of its own, and saves after each; returns the exit status."""
    end = time.monotonic() + 60 * minutes
    results: dict[str, Any] = {"machine": machine}
    failed = False
    for part, measure in parts.items():
        left = end - time.monotonic()
        rows: list[dict[str, Any]] = []
        if left < 20:
            rows.append({"left out": "no time left"})
        print(f"--- {part}" + (": no time left" if rows else ""), flush=True)
        stop = time.monotonic() + left * _SHARES[part]
        try:
            for row in measure(stop) if not rows else ():
                rows.append(row)
                print("  " + ", ".join(f"{k} {v}" for k, v in row.items()), flush=True)
        except ImportError as error:
            rows.append({"left out": f"a package is missing: {error}"})
            print(f"  {rows[-1]['left out']}", flush=True)
        except Exception as error:  # one part that fails must not lose the others
            failed = True
            rows.append({"failed": f"{type(error).__name__}: {error}"[:2000]})
            print(f"  {rows[-1]['failed']}", flush=True)
        results[part] = rows
        saved.save(results, _page(results), path)
    print(f"Saved {path}, and .md beside it")
    parted = (row for part in parts for row in results[part])
    return 1 if failed or any("failed" in row for row in parted) else 0


def _machine() -> dict[str, Any]:
    major, minor = torch.cuda.get_device_capability()
    triton = optional("triton")
    try:
        here = saved.machine()
    except ImportError as error:  # without taichi there is nothing to compare with, but the GPU can be timed
        print(error)
        here = {"torch": torch.__version__}
    return here | {
        "gpu": torch.cuda.get_device_name(),
        "capability": f"{major}.{minor}",
        "memory_gib": round(torch.cuda.get_device_properties(0).total_memory / 2**30, 1),
        "triton": triton.__version__ if triton else None,
    }


Way = tuple[str, Callable[[], Any]]


def _ops(stop: float, device: str = "cuda", clouds: int = 80, points: int = 2048) -> Iterator[dict[str, Any]]:
    """Milliseconds of each op and its peers on the GPU, whole batch, and how far ours is from the CPU's result."""
    for op, size, mark, ours, peers, agreement in _races(device, clouds, points):
        if time.monotonic() > stop:
            yield {"left out": f"{op} and those after it: no time left"}
            return
        row: dict[str, Any] = {"op": op, "size": size, "mark_ms": mark}
        ways: list[Way] = [("diffpoint", ours), *peers]
        timed = [(name, functools.partial(_milliseconds, run)) for name, run in ways]
        for name, find in (*timed, ("differs", agreement)):
            try:
                row[name] = find()
            except Exception as error:  # a peer may lack a compiler, or memory; the CPU's result needs taichi
                row[name] = f"{type(error).__name__}: {(str(error).strip().splitlines() or [''])[0][:120]}"
        yield row


def _milliseconds(run: Callable[[], Any]) -> float:
    """Median time of a call, from an idle GPU to the end of its work: waits and launches count."""
    for _ in range(3):
        run()
    times = []
    for _ in range(_ROUNDS):
        _finish()
        begin = time.perf_counter()
        run()
        _finish()
        times.append(1e3 * (time.perf_counter() - begin))
        if sum(times) > 3000:
            break
    return round(statistics.median(times), 4)


def _finish() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _races(
    device: str, clouds: int, points: int
) -> Iterator[tuple[str, str, float | None, Callable, list[Way], Callable[[], str]]]:
    """Name, size, time to reach in milliseconds, our call, calls of peers, and how much ours differs from the CPU."""
    a, b = (x.to(device) for x in pairs(clouds, points, points))
    a_few, b_few = a[:4].cpu(), b[:4].cpu()

    def chamfer(x: Tensor = a, y: Tensor = b) -> Tensor:
        return sum(dp.chamfer_distance(x, y, squared=False))

    def with_gradient(loss: Callable[[Tensor, Tensor], Tensor], x: Tensor = a, y: Tensor = b) -> tuple:
        x, y = x.detach().requires_grad_(), y.detach().requires_grad_()
        return torch.autograd.grad(loss(x, y).sum(), (x, y))

    def by_cdist(x: Tensor = a, y: Tensor = b) -> Tensor:
        d = torch.cdist(x, y)
        return d.min(-1).values.mean(-1) + d.min(-2).values.mean(-1)

    def by_keops(x: Tensor = a, y: Tensor = b) -> Tensor:
        lazy = keops.LazyTensor
        d = ((lazy(x[:, :, None]) - lazy(y[:, None])) ** 2).sum(-1)
        return d.min(2).sqrt().mean((1, 2)) + d.min(1).sqrt().mean((1, 2))

    keops = optional("pykeops.torch")
    peers: list[Way] = [("torch.cdist", by_cdist)] + ([("pykeops", by_keops)] if keops else [])
    size = f"{clouds} x {points} x {points}"
    yield (
        "chamfer", size, 0.6, chamfer, peers,
        lambda: _apart(chamfer(a[:4], b[:4]), chamfer(a_few, b_few)),
    )  # fmt: skip
    yield (
        "chamfer, with gradients", size, 1.0, lambda: with_gradient(chamfer),
        [("torch.cdist", lambda: with_gradient(by_cdist))],
        lambda: _apart(with_gradient(chamfer, a[:4], b[:4])[0], with_gradient(chamfer, a_few, b_few)[0]),
    )  # fmt: skip

    x, y = (x.to(device) for x in pairs(2 * clouds, points, points))

    def emd(x: Tensor = x, y: Tensor = y) -> Tensor:
        return dp.earth_mover_distance(x, y, tolerance=0.005).cost

    geomloss = optional("geomloss")
    sinkhorn: list[Way] = []
    if geomloss:
        loss = geomloss.SamplesLoss("sinkhorn", p=1, blur=0.005, backend="tensorized")
        sinkhorn = [("geomloss sinkhorn, 8 of 160", lambda: loss(x[:8], y[:8]))]
    yield (
        "earth mover's distance, error at most 0.5 %", f"{2 * clouds} x {points}", 25.0, emd, sinkhorn,
        lambda: _apart(emd(x[:4], y[:4]), emd(x[:4].cpu(), y[:4].cpu())),
    )  # fmt: skip

    cloud = surfaces(clouds, points).to(device)
    for side, mark in ((56, 0.1), (224, 0.15)):
        camera = circle_of_cameras(clouds, side).to(device)

        def splat(cloud: Tensor = cloud, camera: dp.PinholeCamera = camera, radius: float = 0.0) -> Tensor:
            return dp.splat_depth(cloud, camera, radius=radius).depth

        def compare(splat: Callable = splat, camera: dp.PinholeCamera = camera) -> str:
            return _apart(splat(), splat(cloud.cpu(), camera.to("cpu")))

        yield f"splat, {side} x {side}", f"{clouds} x {points}", mark, splat, [], compare
    camera = circle_of_cameras(clouds, 56).to(device)  # of the size of the maps in training
    depth = dp.splat_depth(surfaces(clouds, 2 * points, seed=2).to(device), camera, radius=1.0).depth
    for distance in ("chamfer", "emd"):

        def front(
            cloud: Tensor = cloud, camera: Any = camera, depth: Tensor = depth, distance: Any = distance
        ) -> Tensor:
            cloud = cloud.detach().requires_grad_()
            loss = dp.front_terms(cloud, camera, depth, distance=distance).loss.sum()
            return torch.autograd.grad(loss, cloud)[0]

        def compare_front(front: Callable = front, camera: Any = camera, depth: Tensor = depth) -> str:
            return _apart(front(), front(cloud.cpu(), camera.to("cpu"), depth.cpu()))

        name = f"front constraint by {distance}, with gradient"
        yield name, f"{clouds} x {points}", None, front, [], compare_front

    def farthest(cloud: Tensor = cloud) -> Tensor:
        return dp.farthest_point_sample(cloud, points // 4)

    yield (
        f"farthest points, {points} -> {points // 4}", f"{clouds} x {points}", 1.5, farthest, [],
        lambda: _apart(farthest(), farthest(cloud.cpu())),
    )  # fmt: skip


def _apart(here: Tensor, there: Tensor) -> str:
    """Largest difference of the GPU's result from the CPU's, relative to the largest value, and how many differ."""
    here, there = here.detach().cpu().double(), there.detach().double()
    same = (here == there) | (here.isinf() & there.isinf())
    scale = there[there.isfinite()].abs().max().clamp(min=1e-30)
    difference = (here - there).abs()[~same] / scale
    worst = float(difference.max()) if difference.numel() else 0.0
    return f"{worst:.1e} ({int((~same).sum())} of {same.numel()})"


def _steps(stop: float) -> Iterator[dict[str, Any]]:
    """Training steps of the profiles, and where their time goes."""
    from benchmarks import training

    for row in training.measure(device=torch.device("cuda", torch.cuda.current_device())):
        yield row
        if time.monotonic() > stop:
            return


def _tests(stop: float) -> Iterator[dict[str, Any]]:
    """The layer's tests, on CUDA tensors where they are about these."""
    files = [f"tests/test_{name}.py" for name in ("cuda_kernels", "cuda_transport", "operators", "device")]
    command = [sys.executable, "-m", "pytest", *files, "-q"]
    command += ["-p", "no:cacheprovider", "-W", "ignore::DeprecationWarning"]
    yield _run("tests", command, stop)


def _training(stop: float) -> Iterator[dict[str, Any]]:
    """A short training of the full profile on data made here, and its evaluation."""
    seconds = stop - time.monotonic()
    run, data = "gpu-run", "gpu-data"
    train = [sys.executable, "-m", "train"]
    yield _run("data", [*train, "data", "procedural", "--out", data, "--shapes", "120"], stop)
    steps = max(20, int(seconds * 2))  # of about 60 ms, in a third of the time, both stages together
    fit = [*train, "fit", "--data", data, "--out", run, "--profile", "full", "--device", "cuda"]
    fit += ["--steps", str(steps)]
    yield _run("fit", fit, stop)
    yield _run("evaluate", [*train, "evaluate", run, "--data", data, "--device", "cuda"], stop)
    evaluation = _ROOT / run / "evaluation.json"
    if evaluation.exists():
        yield {"views": json.loads(evaluation.read_text())["views"]}


def _run(name: str, command: list[str], stop: float) -> dict[str, Any]:
    """A command's exit status, time and last lines."""
    begin = time.monotonic()
    try:
        done = subprocess.run(
            command, cwd=_ROOT, capture_output=True, text=True, timeout=max(5.0, stop - begin)
        )
        status, output = done.returncode, done.stdout + done.stderr
    except subprocess.TimeoutExpired as error:
        status = -1
        output = f"stopped after {error.timeout:.0f} s: " + str(error.stdout or "")[-1000:]
    row: dict[str, Any] = {"run": name, "seconds": round(time.monotonic() - begin, 1), "status": status}
    row["failed" if status > 0 else "output"] = output[-3000:]
    return row


def _page(results: dict[str, Any]) -> str:
    here = results["machine"]
    lines = [f"# {here['gpu']}, torch {here['torch']}, triton {here['triton']}", ""]
    lines += ["Milliseconds for the whole batch, from an idle GPU to the end of the work; medians.", ""]
    for row in results.get("ops", []):
        if "op" in row:
            times = "; ".join(f"{k} {v}" for k, v in row.items() if k not in ("op", "size", "mark_ms"))
            lines.append(f"- {row['op']} ({row['size']}): {times}; to reach: {row['mark_ms']}")
        else:
            lines.append(f"- {row}")
    for part in ("steps", "tests", "training"):
        lines += ["", f"## {part}", ""]
        for row in results.get(part, []):
            lines.append("- " + ", ".join(f"{k} {str(v)[-600:]}" for k, v in row.items()))
    return "\n".join(lines) + "\n"
