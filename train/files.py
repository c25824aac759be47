"""Writing so that a reader never sees half a file."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Yields a temporary path beside `target`; what is written there becomes `target` on success.

    The path may be made a file, which replaces an old one in one step, or a directory, whose target must be new.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        remove(temporary)


def write_text(target: Path, text: str) -> None:
    """Writes a text file atomically."""
    with replacing(target) as temporary:
        temporary.write_text(text)


def kept(path: Path, key: Any, make: Callable[[], Any]) -> Any:
    """What was kept at `path` under the same key; else made now, and kept. Both are plain JSON values."""
    if path.exists():
        saved = json.loads(path.read_text())
        if saved["key"] == key:
            return saved["result"]
    result = make()
    write_text(path, json.dumps({"key": key, "result": result}) + "\n")
    return result


def remove(path: Path) -> None:
    """Deletes a file or a directory tree, if it is there."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
