"""Unpacks wheels without pip, which a stock board may lack (PEP 427).

The wheel's bytes were verified before, against the signed manifest and so against the lock.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path, PurePosixPath

from deploy.installer.errors import UserError

_LIBRARIES = ("purelib", "platlib")


def unpack_wheel(data: bytes, name: str, site: Path) -> None:
    """Write a wheel's packages into `site`. Raises UserError for names that leave it or meet.

    Scripts, headers and data files have no use on the board and stay out.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as wheel:
            for member in wheel.infolist():
                if not member.is_dir():
                    place = _place(member.filename, name)
                    if place is not None:
                        _write(site / place, wheel.read(member), name)
    except (zipfile.BadZipFile, EOFError, NotImplementedError) as error:
        raise UserError(f"{name} is not a wheel: {error}") from None


def _place(path: str, wheel: str) -> PurePosixPath | None:
    """Where a member goes below site-packages; None where it does not go there."""
    parts = PurePosixPath(path).parts
    if not parts or path.startswith("/") or "\\" in path or ".." in parts:
        raise UserError(f"{wheel} would write outside of its folder: {path}")
    if not parts[0].endswith(".data"):
        return PurePosixPath(*parts)
    if len(parts) > 2 and parts[1] in _LIBRARIES:
        return PurePosixPath(*parts[2:])
    return None


def _write(path: Path, data: bytes, wheel: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(str(path), "xb") as stream:
            stream.write(data)
    except (FileExistsError, NotADirectoryError):
        raise UserError(
            f"{wheel} holds a file that another wheel holds, too: {path.name}"
        ) from None
