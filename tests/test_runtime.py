"""How kernels are started and called: in fresh processes, in a host program's Taichi, after a fork, and directly."""

import json
import os
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

import diffpoint as dp
from diffpoint import _bridge
from diffpoint._launch import FastCall
from diffpoint._runtime import RUNTIME, available_threads

BACKEND = dp.runtime_info().backend  # taichi, or quadrants if DIFFPOINT_BACKEND is set to it
USE = "import torch, diffpoint as dp; d = lambda: dp.nearest(torch.zeros(1, 4, 3), torch.ones(1, 5, 3))\n"


def run(code: str, *options: str, **environment: str | None) -> subprocess.CompletedProcess[str]:
    """Runs USE and `code` in a Python process; variables that are None are removed from its environment."""
    command = [sys.executable, *options, "-c", USE + textwrap.dedent(code)]
    whole = {name: value for name, value in (os.environ | environment).items() if value is not None}
    return subprocess.run(command, capture_output=True, text=True, timeout=120, env=whole)


def printed(code: str, *options: str, **environment: str | None) -> str:
    done = run(code, *options, **environment)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout.strip()


def test_importing_starts_nothing_and_the_first_op_is_silent():
    code = """
        import sys
        assert not {"taichi", "quadrants"} & set(sys.modules)
        assert dp.runtime_info().owner == "nobody" and not dp.runtime_info().started
        d()
        print(dp.runtime_info().owner)
    """
    assert printed(code) == "diffpoint"


def test_threads_are_configured_before_the_start_and_refused_after():
    code = """
        import numpy
        dp.configure(threads=numpy.int64(1))
        d()
        print(dp.runtime_info().threads)
        try:
            dp.configure(threads=2)
        except RuntimeError as error:
            print(error)
    """
    threads, error = printed(code).splitlines()
    assert threads == "1"
    assert "call configure() before the first op" in error


def test_a_thread_count_below_one_is_refused():
    for threads in (0, True, 1.0):
        with pytest.raises(
            ValueError, match=r"^configure: 'threads' must be a positive integer or None; got"
        ):
            dp.configure(threads=threads)


@pytest.mark.parametrize("other", [name for name in ("taichi", "quadrants") if name != BACKEND])
@pytest.mark.parametrize("installed", [True, False])
def test_one_backend_is_chosen_and_started_once_whatever_else_is_imported(other, installed):
    """A program may use the other compiler itself. Where that is not installed, an empty module has its name."""
    if installed:
        pytest.importorskip(other)
    code = """
        import sys, types
        from diffpoint._runtime import RUNTIME, available_threads
        if INSTALLED:
            import OTHER
        else:
            sys.modules["OTHER"] = types.ModuleType("OTHER")
        d()
        first = RUNTIME.current_program()
        d()
        print(dp.runtime_info().backend, dp.runtime_info().owner, RUNTIME.current_program() is first)
    """.replace("INSTALLED", str(installed)).replace("OTHER", other)
    assert printed(code, DIFFPOINT_BACKEND=BACKEND).endswith(f"{BACKEND} diffpoint True")


def test_a_backend_that_does_not_exist_is_refused():
    assert (
        "DIFFPOINT_BACKEND must be 'taichi' or 'quadrants'; got 'cuda'"
        in run("d()", DIFFPOINT_BACKEND="cuda").stderr
    )


NOWHERE = {"HOME": None, "XDG_CACHE_HOME": None}
CACHED = "d(); print(dp.runtime_info().cache)"


@pytest.mark.skipif(os.name != "posix", reason="the home directory is in HOME on POSIX systems")
def test_without_a_home_in_the_environment_the_users_own_is_found():
    """Daemons and batch jobs have none; Taichi aborts the process."""
    environment = "import os; os.environ['HOME']"
    assert printed(CACHED, **NOWHERE) == "True"
    assert "KeyError: 'HOME'" in run(CACHED + "; " + environment, **NOWHERE).stderr  # it stays as it was


@pytest.mark.skipif(os.name != "posix", reason="the home directory is in HOME on POSIX systems")
def test_without_a_place_for_the_cache_there_is_none(tmp_path):
    """Where no folder can be made, Taichi crashes at the end of the process, even with its cache turned off."""
    file = tmp_path / "file"
    file.touch()
    assert printed(CACHED, HOME=str(file), XDG_CACHE_HOME=None) == "False"
    code = "dp.configure(cache=False); " + CACHED
    assert printed(code, HOME=str(file), XDG_CACHE_HOME=None) == "False"
    # No home on the list of users either: the stand-in, a folder that everybody can write to, keeps no kernels.
    code = "import os; os.path.expanduser = lambda path: path; " + CACHED
    assert printed(code, **NOWHERE, TMPDIR=str(tmp_path)) == "False"
    assert not list(tmp_path.rglob("*cache*"))


@pytest.mark.skipif(os.name != "posix", reason="the home directory is in HOME on POSIX systems")
def test_compiled_kernels_are_kept_for_the_next_process(tmp_path):
    def kernels() -> dict[Path, int]:
        return {
            path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.tic" if BACKEND == "taichi" else "*c")
        }

    assert printed(CACHED, HOME=str(tmp_path), XDG_CACHE_HOME=None) == "True"
    first = kernels()
    assert first
    assert printed(CACHED, HOME=str(tmp_path), XDG_CACHE_HOME=None) == "True"
    assert kernels() == first


def test_the_compilers_warnings_are_not_the_callers():
    code = """
        import io, sys, warnings
        sys.stdout = io.StringIO()  # as pytest and Jupyter replace it
        d()
        before = list(warnings.filters)
        dp.farthest_point_sample(torch.zeros(1, 3, 3), 2)
        assert warnings.filters == before
        print("fine", file=sys.__stdout__)
    """
    assert printed(code, "-W", "error") == "fine"


def test_threads_are_limited_by_the_cpu_quotas_of_containers(tmp_path):
    cores = available_threads(tmp_path, tmp_path / "none")
    assert cores >= 1
    membership = tmp_path / "membership"

    def threads(files: dict[str, str], groups: str) -> int:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text + "\n")
        membership.write_text(groups + "\n")
        return available_threads(root, membership)

    assert threads({"cpu.max": "max 100000"}, "0::/") == cores
    assert threads({"cpu.max": "100000 100000"}, "0::/") == 1
    assert threads({"cpu.max": "20000 100000"}, "0::/") == 1  # part of a core is one thread
    assert threads({"cpu.max": "110000 100000"}, "0::/") == min(2, cores)
    assert threads({"cpu.max": "99900000 100000"}, "0::/") == cores
    # The limit of a group holds for those below it, and it may be the host's path that is known.
    assert threads({"a/cpu.max": "50000 100000", "a/b/cpu.max": "max 100000"}, "0::/a/b") == 1
    assert threads({"cpu.max": "50000 100000"}, "0::/system.slice/docker-1234.scope") == 1
    assert threads({"b/cpu.max": "50000 100000", "cpu.max": "max 100000"}, "0::/a") == cores  # another group
    # Version 1
    version1 = "5:memory:/x\n4:cpu,cpuacct:/docker/1234\n1:name=systemd:/"
    half = {"cpu.cfs_quota_us": "50000", "cpu.cfs_period_us": "100000"}
    whole = {"cpu.cfs_quota_us": "-1", "cpu.cfs_period_us": "100000"}
    for folder in ("cpu", "cpu,cpuacct"):
        assert threads({f"{folder}/{name}": text for name, text in half.items()}, version1) == 1
        assert threads({f"{folder}/docker/1234/{name}": text for name, text in half.items()}, version1) == 1
        assert threads({f"{folder}/{name}": text for name, text in whole.items()}, version1) == cores
    assert threads({f"memory/{name}": text for name, text in half.items()}, version1) == cores
    assert threads({"cpu.max": "nonsense"}, "no group at all") == cores


HOST = """
    import contextlib, io, os, time
    import BACKEND as ti
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(arch=ti.cpu, log_level=ti.ERROR)
    field = ti.field(ti.f32, shape=3)
    field.fill(7)
""".replace("BACKEND", BACKEND)


def test_a_host_programs_taichi_is_used_and_left_alone():
    code = """
        result = d()
        assert result.squared_distance.tolist() == [[3.0] * 4], result
        assert dp.runtime_info().owner == "host"
        print(field.to_numpy().tolist())
    """
    assert printed(textwrap.dedent(HOST) + textwrap.dedent(code)).endswith("[7.0, 7.0, 7.0]")


def test_a_host_that_starts_taichi_after_us_gets_right_results_too():
    code = """
        assert d().squared_distance.tolist() == [[3.0] * 4]
        print(d().squared_distance.tolist(), dp.runtime_info().owner, field.to_numpy().tolist())
    """
    first = "assert d().index.tolist() == [[0] * 4]\n"
    assert printed(first + textwrap.dedent(HOST) + textwrap.dedent(code)).endswith("host [7.0, 7.0, 7.0]")


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads the CPU time of threads from /proc")
def test_kernels_are_parallel_in_a_host_programs_taichi():
    """80 clouds are fewer than the 512 iterations that Taichi's default settings keep on one thread."""
    code = """
        def ticks():
            # CPU time of each thread in hundredths of a second.
            stat = {t: open(f"/proc/self/task/{t}/stat").read() for t in os.listdir("/proc/self/task")}
            return {t: int(line.rsplit(")", 1)[1].split()[11]) for t, line in stat.items()}

        clouds = torch.rand(80, 4000, 3)
        dp.farthest_point_sample(clouds, 2)
        before = ticks()
        dp.farthest_point_sample(clouds, 1000)
        busy = sorted((t - before.get(name, 0) for name, t in ticks().items()), reverse=True)
        print("parallel" if len(os.sched_getaffinity(0)) < 2 or busy[1] > 0.25 * busy[0] else f"serial {busy}")
    """
    assert printed(textwrap.dedent(HOST) + textwrap.dedent(code)).splitlines()[-1] == "parallel"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_forked_child_gets_an_error_instead_of_a_hang():
    code = """
        import os, sys, warnings
        warnings.simplefilter("ignore")
        d()
        child = os.fork()
        if child == 0:
            try:
                d()
            except RuntimeError as error:
                print(error, flush=True)
                os._exit(3)
            os._exit(0)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    output = printed(code)
    assert output.endswith("\n3")
    assert "forked after Taichi had started" in output
    assert "spawn" in output


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_a_child_forked_before_the_start_works():
    code = """
        import os, warnings
        warnings.simplefilter("ignore")
        child = os.fork()
        if child == 0:
            os._exit(0 if d().index.tolist() == [[0] * 4] else 1)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
    """
    assert printed(code) == "0"


LOADER = """
    import torch, diffpoint as dp
    from torch.utils.data import DataLoader, Dataset

    class Distances(Dataset):
        def __len__(self):
            return 4

        def __getitem__(self, i):
            return dp.nearest(torch.zeros(4, 3), torch.full((5, 3), float(i))).squared_distance

    if __name__ == "__main__":
        Distances()[0]  # an op before the workers start: what a training program does
        loader = DataLoader(Distances(), num_workers=1, multiprocessing_context="METHOD")
        print(torch.cat(list(loader))[:, 0].tolist())
"""


def load(tmp_path: Path, method: str) -> subprocess.CompletedProcess[str]:
    program = tmp_path / "program.py"  # spawned workers import it
    program.write_text(textwrap.dedent(LOADER).replace("METHOD", method))
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, str(program)]
    return subprocess.run(command, capture_output=True, text=True, timeout=240, env=environment)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_forked_loader_workers_tell_the_user_what_to_do(tmp_path):
    done = load(tmp_path, "fork")
    assert done.returncode == 1
    assert "RuntimeError: diffpoint: this process was forked after Taichi had started" in done.stderr
    assert "multiprocessing_context='spawn'" in done.stderr


def test_spawned_loader_workers_work(tmp_path):
    done = load(tmp_path, "spawn")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[0.0, 3.0, 12.0, 27.0]"


def test_four_python_threads_at_once():
    code = """
        from concurrent.futures import ThreadPoolExecutor
        a, b = torch.rand(3, 50, 3), torch.rand(3, 70, 3)
        alone = dp.nearest(a, b).index
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda _: dp.nearest(a, b).index, range(40)))
        print(all(torch.equal(alone, r) for r in results))
    """
    assert printed(code) == "True"


@pytest.mark.timeout(900)  # where nothing is cached, every kernel is compiled
def test_one_thread_and_two_give_the_same_bits():
    """Of every op, forward and backward; each process also runs every op twice."""
    script = Path(__file__).parent / "same_bits.py"
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}

    def digest(threads: str) -> dict[str, str]:
        command = [sys.executable, str(script), threads]
        done = subprocess.run(command, capture_output=True, text=True, timeout=450, env=environment)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    with ThreadPoolExecutor(2) as pool:  # most of the time each compiles, on one core
        digests = list(pool.map(digest, ("1", "2")))
    assert digests[0] == digests[1]
    functions = {name for name in dp.__all__ if name[0].islower()} - {
        "check_pending",
        "configure",
        "runtime_info",
    }
    assert set(digests[0]) == functions


CAMERA = dp.PinholeCamera.look_at((0, 0, -2), focal_px=8.0, height=6, width=7)


def arguments(count: int) -> tuple:
    points = torch.rand(2 * count * 3, generator=torch.Generator().manual_seed(0)) - 0.5
    projection = CAMERA.projection.expand(2, 3, 4).reshape(-1)
    outputs = torch.zeros(2 * count * 2), torch.zeros(2 * count), torch.zeros(2)
    return points, projection, *outputs, 1, count, 1


def test_the_first_call_and_later_ones_agree_with_taichis():
    dp.project(torch.zeros(1, 1, 3), CAMERA)  # starts the kernels
    call = RUNTIME.call("reproject", "project", "f32")
    for count in (5, 40, 0):
        ours, theirs = arguments(count), arguments(count)
        call(RUNTIME.current_program(), ours)
        RUNTIME.kernel("reproject", "f32").project(*theirs)
        for x, y in zip(ours, theirs, strict=True):
            assert torch.equal(torch.as_tensor(x), torch.as_tensor(y))
    if BACKEND == "taichi":
        assert call.program is RUNTIME.current_program(), "Taichi's own call was used throughout"


def test_arguments_of_another_type_are_left_to_taichi():
    dp.project(torch.zeros(1, 1, 3), CAMERA)
    call = RUNTIME.call("reproject", "project", "f32")
    call(RUNTIME.current_program(), arguments(5))
    points, *others = arguments(5)
    for wrong in (points.double(), points.view(-1, 3), points[::2]):
        with pytest.raises(Exception, match=r"(?i)dtype|dimension|contiguous"):
            call(RUNTIME.current_program(), (wrong, *others))
    call(RUNTIME.current_program(), arguments(5))


@pytest.mark.parametrize("step", ["preparation", "arguments", "launch"])
def test_where_taichis_inside_differs_its_own_call_is_used(step):
    dp.project(torch.zeros(1, 1, 3), CAMERA)
    program = RUNTIME.current_program()
    call = FastCall(RUNTIME.kernel("reproject", "f32").project)
    if step != "preparation":
        call(program, arguments(5))
    if step == "arguments":
        call.compiled = object()  # has no make_launch_context
    elif step == "launch":
        call.code = None  # launch_kernel does not take this
    else:
        program = object()  # has no compile_kernel
    for count in (5, 40):
        ours, theirs = arguments(count), arguments(count)
        call(program, ours)
        RUNTIME.kernel("reproject", "f32").project(*theirs)
        for x, y in zip(ours[2:5], theirs[2:5], strict=True):
            assert x.any()
            assert torch.equal(x, y)
    assert not call.compatible


def test_a_strided_output_is_refused_by_name():
    points, projection, pixels, depth, total, *_ = arguments(5)
    with pytest.raises(ValueError, match=r"'depth' of the kernel reproject\.project must be contiguous"):
        strided = depth.repeat(2)[::2]
        _bridge.launch(
            "reproject", "project", torch.float32, points, projection, pixels, strided, total, 1, 5
        )
    _bridge.launch("reproject", "project", torch.float32, points, projection, pixels, depth, total, 1, 5)
    assert depth.all()
