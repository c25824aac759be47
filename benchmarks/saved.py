"""Files of a run: `<machine>.json` with every number, `<machine>.md` with the tables."""

from __future__ import annotations

import json
import os
import platform
from pathlib import Path
from typing import Any

import torch

import diffpoint


def machine() -> dict[str, Any]:
    """The machine and versions that the times were measured with."""
    info = diffpoint.runtime_info()
    return {
        "processor": info.processor,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
        "backend": f"{info.backend} {info.version}",
        "threads": info.threads,
    }


def title(here: dict[str, Any]) -> str:
    return f"{here['processor']}, {here['cores']} cores, torch {here['torch']}, {here['backend']}"


def path_for(folder: Path, here: dict[str, Any]) -> Path:
    """The results of this machine, named by its processor and cores."""
    stem = file_stem(f"{here['processor']} {here['cores']} cores")
    return folder / f"{stem}.json"


def file_stem(name: str) -> str:
    """A name as that of a file.

    Example:
        >>> file_stem("AMD EPYC 2 cores")
        'amd-epyc-2-cores'
    """
    return "".join(ch if ch.isalnum() else "-" for ch in name).lower()


def load(folder: Path, here: dict[str, Any]) -> dict[str, Any]:
    """The last results of this machine; empty before the first."""
    path = path_for(folder, here)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def save(results: dict[str, Any], page: str, path: Path) -> None:
    """Writes the JSON, and the page of tables beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, json.dumps(results, indent=1) + "\n")
    write(path.with_suffix(".md"), page)


def write(path: Path, text: str) -> None:
    """Atomically: an interrupted run leaves the old file or the new one."""
    unfinished = path.with_name(path.name + ".new")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)
