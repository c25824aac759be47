"""The command line: `python -m train data|fit|reconstruct|explore|evaluate|export|experiment|demo`."""

from __future__ import annotations

import os

# Idle OpenMP threads of torch spin after every operation and slow the next kernel by 1 to 2 ms; this has to
# be said before torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import dataclasses
import io
import itertools
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro
from tyro.conf import OmitSubcommandPrefixes, Positional, arg, subcommand
from tyro.constructors import PrimitiveConstructorSpec

from train.config import FitConfig, Profile, Recipe, fit_config_from_json, renamed_options, with_steps
from train.data_commands import Data
from train.errors import UserError
from train.experiments.registry import ABOUT_ALL, EXPERIMENTS, FORMER_NAMES
from train.methods import METHODS, get_method

# Torch and the kernels are imported by the commands, so that --help is fast.


def _numbers(words: list[str]) -> tuple[int, ...]:
    return tuple(int(number) for word in words for number in word.split(",") if number)


Numbers = Annotated[
    tuple[int, ...],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="INT,...",
        instance_from_str=_numbers,
        is_instance=lambda value: isinstance(value, tuple) and all(isinstance(n, int) for n in value),
        str_from_instance=lambda value: [",".join(map(str, value))],
    ),
]
"""Whole numbers, given as `1,2,4` or as `1 2 4`."""


Device = Annotated[
    Literal["auto", "cpu", "cuda"],
    arg(
        help="Where networks are computed: cuda is an NVIDIA GPU, auto one if there is one (or what DIFFPOINT_DEVICE "
        "says). It has no part in the configuration of a run."
    ),
]


def _use_device(wanted: str) -> Any:
    """The device of an option `--device`, with torch set up for it."""
    from train.device import describe, use_device

    device = use_device(wanted)
    if device.type != "cpu":
        print(f"computing on {describe(device)}", file=sys.stderr)
    return device


@dataclasses.dataclass
class Fit:
    data: tuple[Path, ...]
    """Root of a data tree (see the `data` command); several are put together."""
    out: Path
    """Directory of the run: configuration, metrics, checkpoints, TensorBoard events."""
    config: Annotated[FitConfig, arg(name="")]
    resume: bool = False
    """Continue the run in --out from its newest checkpoint, to the same bits."""
    steps: int | None = None
    """The same number of steps for every phase, ramps in proportion, for a quick trial."""
    device: Device = "auto"

    def run(self) -> int:
        from train.device import connect
        from train.training.trainer import fit

        config, device = self.config, _use_device(self.device)
        if self.steps is not None:
            if self.steps < 1:
                raise UserError(f"--steps must be at least 1; got {self.steps}")
            config = with_steps(config, self.steps)
        if not fit(self.data, self.out, config, resume=self.resume, device=device):
            print(f"stopped early and saved; continue with --resume --out {self.out}", file=sys.stderr)
            return 130
        if connect(device).is_main:
            print(
                f"trained; see {self.out}, or run: python -m train evaluate {self.out} --data {self.data[0]}"
            )
        return 0


_METHODS = "\n\n".join(f"    {name}: {method.summary}." for name, method in METHODS.items())
Fit.__doc__ = f"""Train an auto-encoder of shapes, then a generator: stage 1 on single views, stage 2 on joined views.

    Ctrl-C saves and stops. The defaults below are those of the profile, method and variant; put --profile, --system and
    --variant before --help to see others. Methods (--system):

{_METHODS}
    """


@dataclasses.dataclass
class Reconstruct:
    """Reconstruct one object from 1 to 24 pictures of it; no cameras needed.

    Writes DIR/reconstruction.ply, DIR/reconstruction.html, a page with the pictures and the cloud to turn, and
    DIR/explore.html, the page of the command `explore`.
    Pictures should show the object alone on white or on transparency, about three quarters of the frame.
    """

    model: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run's directory, a .safetensors file of one, or the word `pretrained`: the weights that come with this
    repository."""
    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...")]
    """Pictures of one object."""
    out: Path
    """Directory to write to."""
    groups: int | None = None
    """Groups of random codes to search; the run's own setting if not given."""
    steps: int | None = None
    """Gradient steps on the codes; the run's own setting if not given."""
    seed: int = 0
    """Draws the codes."""
    device: Device = "auto"

    def run(self) -> None:
        from train.evaluation.reconstruct import reconstruct_to_files

        reconstruct_to_files(
            self.model, self.images, self.out, groups=self.groups, steps=self.steps, seed=self.seed,
            device=_use_device(self.device),
        )  # fmt: skip


@dataclasses.dataclass
class Explore:
    """Write a page on which one drags through the codes of an image and sees what it leaves open; no cameras needed.

    The page stands alone: it needs neither a server nor a network connection. With several images of one object it also
    shows the shape on which they agree. Pictures as for `reconstruct`.
    """

    model: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run's directory, a .safetensors file of one, or the word `pretrained`."""
    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...")]
    """Pictures of one object."""
    out: Path
    """The page, an .html file."""
    seed: int = 0
    """Draws the codes."""
    device: Device = "auto"

    def run(self) -> None:
        from train.evaluation.reconstruct import explore_to_file

        device = _use_device(self.device)
        explore_to_file(self.model, self.images, self.out, seed=self.seed, device=device)


@dataclasses.dataclass
class Export:
    """Write the best weights of a run to one file, which can be used wherever a RUN is expected."""

    model: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run's directory, a .safetensors file of one, or the word `pretrained`."""
    out: Path
    """The file; its name ends in .safetensors."""
    half: bool = False
    """Keep 16 bits of each number: half the size, and nearly the same predictions."""

    def run(self) -> None:
        from train.evaluation.runs import export_weights

        export_weights(self.model, self.out, half=self.half)
        print(f"wrote {self.out}, {self.out.stat().st_size / 1e6:.1f} MB")


@dataclasses.dataclass
class Evaluate:
    """Score a run on held-out shapes, together with two retrieval baselines; writes evaluation.json.

    Distances are un-squared and x100. F at 1%: the F-score with a threshold of 0.01 world units, 1 % of an object's
    size. EMD: after both clouds are thinned to the size of one prediction.
    """

    model: Annotated[Positional[Path], arg(metavar="RUN")]
    """A run's directory, a .safetensors file of one, or the word `pretrained`."""
    data: Path
    """Root of a data tree."""
    split: Literal["train", "val", "test"] = "test"
    """Split to score."""
    seeds: Numbers = (0, 1, 2)
    """Seeds of codes and choice of views; the figures are means over them."""
    views: Numbers = (1, 2, 4, 8)
    """Numbers of views, as 1,2,4,8 or apart."""
    limit: int | None = None
    """Score at most that many shapes."""
    framed: bool = False
    """Show the network every object as photographs are framed: in the middle, as large as the frame allows."""
    out: Path | None = None
    """Where to write; RUN/evaluation.json if not given."""
    device: Device = "auto"

    def run(self) -> None:
        from train.evaluation.evaluate import evaluate

        evaluate(
            self.model,
            self.data,
            split=self.split,
            seeds=self.seeds,
            views=self.views,
            limit=self.limit,
            framed=self.framed,
            out=self.out,
            device=_use_device(self.device),
        )


def _about_experiments() -> str:
    everything = EXPERIMENTS | ABOUT_ALL
    lines = "\n\n".join(
        f"{name}: {words}{'' if words[-1] in '?)' else '.'}" for name, words in everything.items()
    )
    return f"""Run one experiment; writes NAME.json, NAME.md and NAME.png into --out.

    Trains what it needs, once for all experiments that write to the same place; a stopped experiment continues.

    {lines.replace(chr(10), chr(10) + "    ")}

    front-vs-projection: besides trees, --data takes meshes as `data meshes` does; --limit counts shapes of each kind,
    at most 3.
    """


def _experiment_name(words: list[str]) -> str:
    return FORMER_NAMES.get(words[0], words[0])


@dataclasses.dataclass
class Experiment:
    name: Annotated[
        Positional[str],
        PrimitiveConstructorSpec(
            nargs=1,
            metavar="NAME",
            choices=(*EXPERIMENTS, *ABOUT_ALL, *FORMER_NAMES),
            instance_from_str=_experiment_name,
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
        ),
    ]
    """Which one."""
    out: Path
    """Directory to write to."""
    data: tuple[Path, ...] = ()
    """Root of a data tree; several are put together for training, and the first one's test split is measured (collapse:
    each on its own)."""
    profile: Literal["full", "cpu", "smoke"] = "cpu"
    """Size of the networks, and how long they are trained."""
    recipe: Recipe = "paper"
    """How our method is trained, see `fit`. Files of the recipe of whole shapes are named whole-shapes-NAME."""
    seeds: int = 3
    """Trainings of each system; for agreement, choices of codes and views."""
    limit: int | None = None
    """Use at most that many test shapes."""
    steps: int | None = None
    """The same number of steps for every phase, for a quick look."""
    processes: int | None = None
    """Trainings or measurements at once, with one core each; as many as there are cores if not given, on a GPU one."""
    category: str = "chair"
    """What single-category is about."""
    pictures: Path | None = None
    """photos: a folder with a folder of pictures for each object."""
    run_: Annotated[Path | None, arg(name="run")] = None
    """agreement, coverage, photos: the run it is about, a .safetensors file of one, or the word `pretrained`; networks
    are trained if not given."""
    views: int = 8
    """agreement: views per shape."""
    device: Device = "auto"

    def run(self) -> None:
        from diffpoint import runtime_info
        from train.experiments.run import Study, print_status, run_all, run_experiment, write_page

        device = _use_device(self.device)
        usual = 1 if device.type == "cuda" else runtime_info().threads
        processes = usual if self.processes is None else self.processes
        study = Study(
            self.data, self.out, self.profile, self.seeds, self.limit, self.steps, processes=processes,
            category=self.category, pictures=self.pictures, run=self.run_, views=self.views, recipe=self.recipe,
            device=device,
        )  # fmt: skip
        if self.name == "list":
            print_status(study)
        elif self.name == "all":
            run_all(study)
        elif self.name == "page":
            print(f"wrote {write_page(self.out)}")
        else:
            run_experiment(self.name, study)


Experiment.__doc__ = _about_experiments()


@dataclasses.dataclass
class Demo:
    """The whole chain on generated shapes: data, training, evaluation, reconstruction, and a page that shows it."""

    out: Path = Path("demo")
    """Directory to write to; ends with report.html."""
    device: Device = "auto"

    def run(self) -> None:
        from train.demo import demo

        demo(self.out, device=_use_device(self.device))


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; a user's mistake becomes one line on stderr and exit code 2."""
    # Daemons close their outputs, for which Python has None; libraries ask it whether it is a terminal.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    # As stderr is: a name of a file may have letters it cannot print.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            command = _parse(renamed_options(sys.argv[1:] if arguments is None else arguments))
            return command.run() or 0
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # who reads our output, such as `head`, has seen enough
        _drop_output()
        return 128 + 13  # as a shell reports SIGPIPE
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except OSError as error:  # no permission, no space, a name that is too long: the system's words are clear
        print(f"error: {error}", file=sys.stderr)
        _drop_output()
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _drop_output() -> None:
    """Sends what is still to be printed nowhere, if it cannot be printed: Python would complain at its end."""
    try:
        sys.stdout.flush()
    except OSError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _parse(arguments: list[str]) -> Any:
    # The methods' recipes import torch: only `fit` waits for that.
    config = _fit_defaults(arguments) if arguments[:1] == ["fit"] else tyro.MISSING
    fit = Fit(data=tyro.MISSING, out=tyro.MISSING, config=config)
    kinds = (
        Annotated[Data, subcommand("data")]
        | Annotated[Fit, subcommand("fit", default=fit)]
        | Annotated[Reconstruct, subcommand("reconstruct")]
        | Annotated[Explore, subcommand("explore")]
        | Annotated[Evaluate, subcommand("evaluate")]
        | Annotated[Export, subcommand("export")]
        | Annotated[Experiment, subcommand("experiment")]
        | Annotated[Demo, subcommand("demo")]
    )
    return tyro.cli(
        OmitSubcommandPrefixes[kinds],  # type: ignore[arg-type]
        args=arguments,
        prog="python -m train",
        description="Learn to turn one image and a random code into a shape, and several images into one.",
    )


def _fit_defaults(arguments: list[str]) -> FitConfig:
    """The configuration that the other options of `fit` change: the resumed run's, or the profile's."""
    given = dict(itertools.pairwise(arguments))
    given |= dict(a.split("=", 1) for a in arguments if a.startswith("--") and "=" in a)
    saved = Path(given.get("--out", "")) / "config.json"
    if "--resume" in arguments and saved.is_file():
        return fit_config_from_json(saved.read_text(), where=str(saved))
    profile = given.get("--profile", "cpu")
    method = get_method(given.get("--system", "ours"))
    variant = given.get("--variant", "standard")
    # A variant is a model of the paper.
    recipe = given.get("--recipe", method.recipes[0] if variant == "standard" else "paper")
    config = method.recipe(profile if profile in get_args(Profile) else "cpu")
    return method.variant(method.with_recipe(config, recipe), variant)


if __name__ == "__main__":
    sys.exit(main())
