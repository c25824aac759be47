"""Paths, and atomic writes: a reader sees the old file or the whole new one, never half of it."""

from __future__ import annotations

import errno
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from train.errors import UserError

DISK_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS})
"""Errors after which no other file can be written either: the disk is full or read-only."""


def as_paths(paths: str | Path | Sequence[str | Path]) -> list[Path]:
    """One path or several, as a list."""
    return [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]


def require_writable(target: str | Path) -> None:
    """Refuses a file that could not be written, before the hours of work that lead to it; makes nothing.

    Raises:
        UserError: it is a directory, or nothing may be written where its folder is or would be made.
    """
    target = Path(target)
    if target.is_dir():
        raise UserError(f"{target} is a directory where a file is to be written; choose another --out")
    folder = next(each for each in target.absolute().parents if each.exists())
    if not folder.is_dir():
        raise UserError(f"{folder} is a file, not a directory; choose another --out")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UserError(
            f"nothing may be written to {folder}; choose another --out, or change its permissions"
        )


@contextmanager
def replacing(target: str | Path) -> Iterator[Path]:
    """Yields a temporary path beside `target`; what is written there becomes `target` on success.

    The path may be made a file, which replaces an old one in one step, or a directory, whose target must be new.
    """
    target = Path(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        remove(temporary)


def write_text(target: str | Path, text: str) -> None:
    """Writes a text file atomically; names of files that are no UTF-8 keep their bytes."""
    with replacing(target) as temporary:
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape")


def kept(path: str | Path, key: Any, make: Callable[[], Any]) -> Any:
    """What was kept at `path` under the same key; else made now, and kept. Both are plain JSON values."""
    path = Path(path)
    if path.exists():
        saved = json.loads(path.read_text())
        if saved["key"] == key:
            return saved["result"]
    result = make()
    write_text(path, json.dumps({"key": key, "result": result}) + "\n")
    return result


def remove(path: str | Path) -> None:
    """Deletes a file or a directory tree, if it is there."""
    path = Path(path)
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
